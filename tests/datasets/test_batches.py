"""The order of examples and its hand-over to the device."""

import itertools

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.datasets.batches import batch_indices, batches, first_example
from tflane_jax.errors import UserError


@settings(max_examples=30)
@given(st.integers(1, 12), st.integers(1, 30), st.integers(0, 5))
def test_every_epoch_is_a_permutation(examples, batch_size, seed):
    epochs = 3
    steps = -(-epochs * examples // batch_size)
    order = np.concatenate([batch_indices(seed, step, examples, batch_size) for step in range(steps)])
    for epoch in range(epochs):
        assert sorted(order[epoch * examples : (epoch + 1) * examples]) == list(range(examples))


def test_order_differs_by_seed_and_epoch():
    orders = [tuple(batch_indices(seed, step, 50, 50)) for seed in (0, 1) for step in (0, 1)]
    assert len(set(orders)) == 4


@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_batches_hold_the_examples_of_their_step(seeds):
    arrays = {"a": np.arange(7), "b": np.arange(14.0, dtype=np.float32).reshape(7, 2)}
    for step, each in zip(range(2, 5), batches(arrays, seeds, range(2, 5), 3), strict=True):
        for seed, batch in zip(seeds, each, strict=True):
            order = batch_indices(seed, step, 7, 3)
            assert isinstance(batch["a"], jax.Array)
            np.testing.assert_array_equal(batch["a"], order)
            np.testing.assert_array_equal(batch["b"][:, 1], 2 * order + 1)


@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_examples_are_prepared_by_seed_step_and_place(seeds):
    def prepare(example, key):
        return {"a": example["a"] + 100 * key[0] + 10_000 * key[1] + 1_000_000 * key[2]}

    arrays = {"a": np.arange(7)}
    for step, each in zip(range(2, 5), batches(arrays, seeds, range(2, 5), 3, prepare), strict=True):
        for seed, batch in zip(seeds, each, strict=True):
            expected = batch_indices(seed, step, 7, 3) + 100 * seed + 10_000 * step + 1_000_000 * np.arange(3)
            np.testing.assert_array_equal(batch["a"], expected)


def test_no_steps_no_batches():
    assert list(batches({"a": np.arange(3)}, (0,), range(0), 2)) == []


def test_no_examples_are_an_error():
    with pytest.raises(UserError, match="there are no examples"):
        first_example({"a": np.zeros((0, 3))})


def test_an_error_while_gathering_reaches_the_caller():
    bad = {"a": np.arange(5), "b": np.arange(2)}
    with pytest.raises(IndexError):
        list(itertools.islice(batches(bad, (0,), range(10), 2), 10))
