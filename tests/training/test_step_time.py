"""Time that steps wait for examples: recorded, shown and told."""

import dataclasses
import time

import pytest

from tests.training.stub import LineDataset
from tests.training.stub_run import CONFIG, run
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.training.records import read_records
from tflane_jax.training.step_time import StepTime


class Slow(LineDataset):
    def example(self, index):
        time.sleep(0.2)
        return super().example(index)


def waiting(folder):
    return [record["waiting"] for record in read_records(folder / "metrics.jsonl") if record["split"] == "train"]


@pytest.mark.parametrize("dataset", [pytest.param(Slow, marks=pytest.mark.slow), LineDataset])
def test_a_training_that_waits_for_examples_says_so_once(dataset, tmp_path, capsys):
    config = dataclasses.replace(CONFIG, steps=8)
    arrays = Streamed(dataset(), StreamingConfig(threads=1, ahead=2))
    run(tmp_path / "run", config=config, arrays=arrays, progress=True)
    (first, second), told = waiting(tmp_path / "run"), capsys.readouterr().err
    assert 0 <= min(first, second) <= max(first, second) <= 1
    if dataset is Slow:
        assert second > 0.5
        assert told.count("training waits for examples, which 1 threads load: raise data.loading.threads") == 1
        assert f"waiting={second:.0%}" in told
    else:
        assert "training waits" not in told


def test_a_record_has_the_time_since_the_one_before():
    times = StepTime(seconds=100.0)
    times.add(2.0, waited=0.5)
    times.add(2.0, waited=1.5)
    assert times.record() == {"seconds": 104.0, "waiting": 0.5}
    assert times.shown() == ", waiting=50%"
    times.add(10.0, waited=2.0)
    assert times.record() == {"seconds": 114.0, "waiting": 0.2}
    assert times.shown() == ""
    assert times.own == 14.0
    assert times.record()["waiting"] == 0.0


def test_only_what_workers_load_and_a_second_of_waiting_is_told():
    times, arrays = StepTime(), Streamed(LineDataset(), StreamingConfig(threads=3, processes=2))
    times.add(1.0, waited=0.9)
    times.record()
    assert times.notices(5, arrays) == []
    times.add(2.0, waited=1.0)
    times.record()
    assert times.notices(10, {"x": 0}) == []
    (said,) = times.notices(10, arrays)
    assert said.startswith("step 10: 50% of the time, training waits for examples, which 3 threads in each of 2 proc")
    assert times.notices(15, arrays) == []
