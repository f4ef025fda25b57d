"""Streamed examples equal those in memory, for any number of workers."""

import dataclasses
import threading
import time
from functools import partial

import jax
import numpy as np
import pytest

from tests.fakes import BrokenDataset, DeadlyDataset, FakeConfig, FakeDataset
from tflane_jax.datasets import streaming
from tflane_jax.datasets.batches import (
    batch_indices,
    batches,
    chosen_examples,
    first_example,
    in_workers,
    ordered_batches,
)
from tflane_jax.datasets.loading import keep, load_arrays
from tflane_jax.datasets.streaming import InOrder, Request, Streamed, StreamingConfig
from tflane_jax.errors import UserError

PARTS = ("lanes", "traffic_elements")
SIZE, BATCH = 7, 3


def streamed(*, dataset=None, **workers) -> Streamed:
    config = StreamingConfig(**{"threads": 2, "ahead": 4} | workers)
    return Streamed(dataset or FakeDataset(FakeConfig(SIZE)), config, partial(keep, parts=PARTS))


def in_memory():
    return load_arrays(FakeDataset(FakeConfig(SIZE)), parts=PARTS, progress=False)


def shifted(example, key):
    """Augment an example by its seed, step and place in the batch."""
    seed, step, place = key
    lanes = example.lanes.replace(points=example.lanes.points + np.float32(100 * seed + 10 * step + place))
    return example.replace(lanes=lanes)


def assert_same(left, right):
    assert jax.tree.structure(left) == jax.tree.structure(right)
    jax.tree.map(np.testing.assert_array_equal, left, right)


@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
@pytest.mark.parametrize("threads", [0, 1, 4])
def test_batches_are_those_of_arrays_in_memory(seeds, threads):
    steps = range(3, 7)
    ours = batches(streamed(threads=threads), seeds, steps, BATCH, shifted)
    for batch, expected in zip(ours, batches(in_memory(), seeds, steps, BATCH, shifted), strict=True):
        assert_same(batch, expected)


@pytest.mark.slow
def test_processes_change_nothing():
    ours = batches(streamed(processes=2), (4,), range(4), BATCH, shifted)
    for batch, expected in zip(ours, batches(in_memory(), (4,), range(4), BATCH, shifted), strict=True):
        assert_same(batch, expected)


@pytest.mark.parametrize("make", [streamed, in_memory])
def test_processes_of_a_run_share_every_batch(make):
    def rows(share):
        return list(batches(make(), (4,), range(2), 4, shifted, share=share))

    whole, parts = rows((0, 1)), [rows((0, 2)), rows((1, 2))]
    for step in range(2):
        both = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(part[step] for part in parts))
        assert_same(both, jax.device_get(whole[step]))
    with pytest.raises(ValueError, match="3 processes cannot share batches of 4"):
        rows((0, 3))


@pytest.mark.parametrize("make", [streamed, lambda: in_workers(in_memory(), StreamingConfig(threads=2))])
def test_an_epoch_goes_on_where_it_was_left(make):
    """Steps of 3 of 7 examples: the third step ends an epoch and begins the next."""
    whole = list(batches(in_memory(), (4,), range(6), BATCH, shifted))
    for first in (1, 2, 5):
        for batch, expected in zip(batches(make(), (4,), range(first, 6), BATCH, shifted), whole[first:], strict=True):
            assert_same(batch, expected)


def test_workers_augment_examples_in_memory():
    arrays, threads = in_memory(), set()

    def watched(example, key):
        threads.add(threading.current_thread().name)
        return shifted(example, key)

    fed = list(batches(in_workers(arrays, StreamingConfig(threads=2, processes=3)), (4,), range(4), BATCH, watched))
    assert not [name for name in threads if name.startswith(("MainThread", "batches"))]
    for batch, expected in zip(fed, batches(arrays, (4,), range(4), BATCH, shifted), strict=True):
        assert_same(batch, expected)
    assert in_workers(arrays, StreamingConfig(threads=0)) is arrays


def test_examples_in_memory_are_augmented_without_grain_too(monkeypatch):
    arrays = in_memory()
    monkeypatch.setattr("tflane_jax.datasets.batches.find_spec", lambda name: None)
    assert in_workers(arrays, StreamingConfig(threads=2)) is arrays


class Counting(FakeDataset):
    """Notes which examples are asked for."""

    def __init__(self, size: int = SIZE):
        super().__init__(FakeConfig(size))
        self.asked = []

    def example(self, index):
        self.asked.append(index)
        return super().example(index)


def test_a_process_loads_its_own_rows_only():
    datasets = [Counting(12) for _ in range(3)]
    for index, dataset in enumerate(datasets):
        list(batches(streamed(dataset=dataset), (4,), range(2), 6, share=(index, 3)))
    of_epoch = [index for dataset in datasets for index in dataset.asked]
    assert sorted(of_epoch) == list(range(12))
    assert [len(dataset.asked) for dataset in datasets] == [4, 4, 4]
    assert set(datasets[0].asked) == {*batch_indices(4, 0, 12, 6)[:2], *batch_indices(4, 1, 12, 6)[:2]}


def test_an_evaluation_goes_through_all_examples_in_order():
    ours, expected = (list(ordered_batches(arrays, BATCH)) for arrays in (streamed(), in_memory()))
    assert [indices for indices, _ in ours] == [range(0, 3), range(3, 6), range(6, 7)]
    for (_, batch), (_, other) in zip(ours, expected, strict=True):
        assert_same(batch, other)


@pytest.mark.parametrize("make", [streamed, in_memory])
def test_processes_of_an_evaluation_load_their_own_rows(make):
    whole = list(ordered_batches(make(), 4))
    for index in range(2):
        for (indices, batch), (expected, part) in zip(whole, ordered_batches(make(), 4, (index, 2)), strict=True):
            assert indices == expected
            assert_same(jax.tree.map(lambda leaf, i=index: leaf[2 * i : 2 * i + 2], batch), part)
    asked = Counting(SIZE)
    list(ordered_batches(streamed(dataset=asked), 4, (1, 2)))
    assert sorted(asked.asked) == [2, 3, 6, 6]


@pytest.mark.parametrize("size", [0, -1])
def test_batches_of_nothing_are_refused(size):
    """Regression: a negative size gave no batch, and so an evaluation of nothing."""
    with pytest.raises(UserError, match=f"batches of {size} examples hold none"):
        next(ordered_batches(in_memory(), size))


def test_one_example_gives_the_shapes():
    assert_same(first_example(streamed()), first_example(in_memory()))
    assert_same(chosen_examples(streamed(), [5, 0]), chosen_examples(in_memory(), [5, 0]))


@pytest.mark.parametrize("threads", [0, 2])
def test_an_error_in_a_worker_reaches_the_caller(threads):
    broken = Streamed(BrokenDataset(FakeConfig(4)), StreamingConfig(threads=threads))
    with pytest.raises(RuntimeError, match=r"broken\n\(raised by example 2 of fake\)"):
        list(broken.stream(lambda number: Request(number, (0, 0, number)), 4))


@pytest.mark.parametrize("threads", [0, 2])
def test_a_file_that_a_worker_cannot_read_is_named(threads, tmp_path):
    class Lost(FakeDataset):
        def example(self, index):
            return super().example(index) if index < 2 else (tmp_path / "lost.bin").read_bytes()

    lost = Streamed(Lost(FakeConfig(4)), StreamingConfig(threads=threads))
    with pytest.raises(UserError, match=r"fake: cannot read example 2: .*lost\.bin"):
        list(lost.stream(lambda number: Request(number, (0, 0, number)), 4))


@pytest.mark.slow
def test_a_process_that_dies_is_reported():
    source = Streamed(DeadlyDataset(FakeConfig(4)), StreamingConfig(threads=1, processes=1))
    with pytest.raises(UserError, match=r"fake: a process that loads examples died: .*data\.loading\.processes"):
        list(source.stream(InOrder(4), 4))


def test_unneeded_parts_are_not_loaded():
    dataset = Counting()
    feed = streamed(dataset=dataset, ahead=4).stream(lambda n: Request(n % SIZE, (0, 0, n)), 1000)
    next(feed)
    feed.close()
    assert len(dataset.asked) <= 4 + 3
    deadline = time.monotonic() + 5.0
    while any("grain" in thread.name for thread in threading.enumerate()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not [thread.name for thread in threading.enumerate() if "grain" in thread.name]


@pytest.mark.parametrize(
    ("cores", "given", "expected"),
    [
        (1, {}, (1, 16)),
        (2, {}, (1, 16)),
        (8, {}, (7, 16)),
        (64, {}, (63, 126)),
        (64, {"processes": 8}, (7, 16)),
        (4, {"processes": 8}, (1, 16)),
        (64, {"threads": 4}, (4, 16)),
        (64, {"threads": 0, "ahead": 5}, (0, 5)),
    ],
)
def test_workers_are_as_many_as_the_cores_of_this_process_less_one(cores, given, expected, monkeypatch):
    monkeypatch.setattr(streaming, "own_cores", lambda environment: cores)
    assert StreamingConfig(**given).workers() == expected


@pytest.mark.parametrize("change", [{"threads": -1}, {"processes": -1}, {"ahead": 0}])
def test_invalid_settings_are_named(change):
    source = dataclasses.replace(streamed(), config=StreamingConfig(**change))
    with pytest.raises(UserError, match=f"{next(iter(change))}="):
        next(source.stream(lambda number: Request(number, (0, 0, number)), 4))
