"""Prediction of a dataset: its order and padding, streams with memory, and what runs while a caller reads."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.evaluation import predict
from tflane_jax.evaluation.predict import predicted_batches, predictions, undivided_notices

FACTOR = jnp.float32(2.0)


@dataclass(frozen=True)
class Times:
    """Predicts a number times the parameter; as a stream, the sum of all numbers so far times the parameter."""

    streams: bool = False

    def predict(self, params, example):
        return params * example["number"]

    def start(self):
        return jnp.float32(0.0)

    def step(self, params, memory, example):
        return memory + example["number"], params * (memory + example["number"])


def numbers(count):
    return {"number": np.arange(1.0, count + 1.0, dtype=np.float32)}


@pytest.mark.parametrize("streams", [False, True])
@pytest.mark.parametrize(("count", "batch_size"), [(0, 2), (1, 1), (1, 4), (5, 2), (6, 3)])
def test_all_examples_are_predicted_once_in_order(count, batch_size, streams):
    found = list(predictions(Times(streams), FACTOR, numbers(count), batch_size))
    assert [index for indices, _ in found for index in indices] == list(range(count))
    assert all(len(answers) == len(indices) <= batch_size for indices, answers in found)
    given = numbers(count)["number"]
    expected = 2.0 * (np.cumsum(given) if streams else given)
    np.testing.assert_array_equal(np.concatenate([*(answers for _, answers in found), []]), expected)


@pytest.mark.parametrize("streams", [False, True])
def test_the_next_batch_runs_while_the_caller_reads_one(streams, monkeypatch):
    started, run = [], predict._run_compiled
    monkeypatch.setattr(predict, "_run_compiled", lambda *given: (started.append(given[-1]), run(*given))[1])
    read = predicted_batches(Times(streams), FACTOR, numbers(5), 2)
    ahead = [(batch["number"].tolist(), len(started)) for _, batch, _ in read]
    # The last batch is filled up with copies of the last example.
    assert ahead == [([1.0, 2.0], 2), ([3.0, 4.0], 3), ([5.0, 5.0], 3)]


@pytest.mark.parametrize(
    ("devices", "batch_size", "best"), [(1, 16, None), (8, 16, None), (32, 16, 32), (3, 16, 18), (2, 1, 2)]
)
def test_devices_that_an_evaluation_does_not_use_are_told_of(devices, batch_size, best, monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: devices)
    assert undivided_notices(Times(streams=True), batch_size) == []
    notices = undivided_notices(Times(), batch_size)
    assert len(notices) == (best is not None)
    said = f"{devices} devices cannot share batches of {batch_size} (evaluation.batch_size), so that"
    for notice in notices:
        assert notice == f"{said} one predicts everything: batches of {best} would use all"
    monkeypatch.setattr(predict, "process_count", lambda: 2)
    for notice in undivided_notices(Times(), batch_size):
        assert notice == f"{said} each process predicts everything on one device: batches of {best} would use all"
