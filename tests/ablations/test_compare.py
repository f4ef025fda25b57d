"""Comparisons whose trainings run in processes of their own."""

import dataclasses
import json

import pytest

from tests.models.cases import BASELINE
from tflane_jax.ablations.compare import Job, _Worker, compare
from tflane_jax.config import EvaluationConfig, RunConfig, WorldData
from tflane_jax.errors import UserError
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig
from tflane_jax.world.simulate import WorldConfig

CONFIG = RunConfig(
    LaneGraphTask(BASELINE),
    WorldData(1, 1, 1, WorldConfig(keyframes=2)),
    OptimConfig(warmup_steps=0),
    TrainingConfig(steps=2, batch_size=1),
    EvaluationConfig(pictures=0),
)


def test_a_worker_that_is_killed_is_named_by_its_run(tmp_path):
    with _Worker(0, 1) as worker:
        worker.begin(Job(CONFIG, tmp_path / "runs" / "seed_0"))
        worker._process.kill()
        worker._process.join()
        with pytest.raises(UserError, match=r"seed_0 failed: its messages are in .*seed_0\.log"):
            worker.check()


@pytest.mark.slow
def test_two_workers_train_all_runs_and_name_the_one_that_failed(tmp_path, monkeypatch):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    other = dataclasses.replace(BASELINE, decoder=dataclasses.replace(BASELINE.decoder, queries=5))
    configs = {"one": CONFIG, "other": dataclasses.replace(CONFIG, task=LaneGraphTask(other))}
    out = tmp_path / "comparison"
    compare(configs, (0, 1, 2), out, jobs=2)
    scores = json.loads((out / "scores.json").read_text())
    assert {name: len(values) for name, values in scores.items()} == {"one": 3, "other": 3}
    assert len(list(out.glob("*/seed_*/config.json"))) == len(list(out.glob("*/seed_*.log"))) == 6

    broken = {"one": dataclasses.replace(CONFIG, optim=OptimConfig(warmup_steps=1000))}
    with pytest.raises(UserError, match=r"seed_0 failed: its messages are in .*seed_0\.log"):
        compare(broken, (0, 1), tmp_path / "broken", jobs=2)
    assert "optim.warmup_steps is 1000" in (tmp_path / "broken" / "one" / "seed_0.log").read_text()
