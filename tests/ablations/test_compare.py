"""Comparisons whose trainings run in processes of their own."""

import dataclasses
import json
import re
import signal
import time

import pytest

from tests.models.cases import BASELINE
from tflane_jax.ablations import workers
from tflane_jax.ablations.compare import compare
from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.workers import Worker, worker_threads
from tflane_jax.config import EvaluationConfig, RunConfig, WorldData, load_config
from tflane_jax.errors import UserError
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.provenance import read_provenance
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
    job = Job(CONFIG, tmp_path / "runs" / "seed_0")
    with Worker([]) as worker:
        worker.begin(job)
        worker._process.kill()
        worker._process.join()
        done = worker.poll()
        assert worker.job is None
    assert done is not None
    assert done.job is job
    assert re.search(r"seed_0 failed: its messages are in .*seed_0\.log", str(done.failure))
    assert "killed by SIGKILL" in str(done.failure)
    assert "killed by SIGKILL" in job.log.read_text()


def test_a_configuration_that_cannot_be_sent_is_an_error_and_leaves_the_worker_free(tmp_path):
    """Regression: the comparison waited for its end for ever."""

    class Local(type(CONFIG.task.model)):
        pass

    task = dataclasses.replace(CONFIG.task, model=Local(**vars(CONFIG.task.model)))
    with Worker([]) as worker:
        with pytest.raises(
            UserError, match=r"cannot be sent to a worker .*: define own classes and functions at the top"
        ):
            worker.begin(Job(dataclasses.replace(CONFIG, task=task), tmp_path / "seed_0"))
        assert worker.job is None


def test_runs_that_are_trained_anew_count_from_their_beginning(tmp_path, monkeypatch):
    """Regression: the bar showed the steps of the runs that were to be deleted."""
    jobs = [Job(CONFIG, tmp_path / name, retrain=True) for name in ("other", "same")]
    starts = {"other": "overwrite", "same": "resume"}
    monkeypatch.setattr(Job, "start", lambda job: starts[job.folder.name])
    monkeypatch.setattr(Job, "step", lambda job: 2)
    anew = {job.place for job in jobs if job.start() == "overwrite"}
    for begun in (jobs[1:], jobs):
        assert workers._not_begun(anew, begun) == anew
    assert workers._steps(jobs, anew) == 2
    starts["other"] = "new"
    assert workers._not_begun(anew, jobs) == set()
    assert workers._steps(jobs, set()) == 4


def test_all_workers_are_told_to_end_before_one_is_waited_for(tmp_path, monkeypatch):
    ended = []

    class Fake(Worker):
        def _begin_process(self):
            pass

        def end(self):
            ended.append("told")

        def __exit__(self, *_):
            ended.append("waited for")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(workers, "Worker", Fake)
    monkeypatch.setattr(workers, "_build", interrupted)
    jobs = [Job(CONFIG, tmp_path / name) for name in ("one", "other")]
    with pytest.raises(KeyboardInterrupt):
        workers.train_all(jobs, parallel=2)
    assert ended == ["told", "told", "waited for", "waited for"]


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["tracing the update step", "compiling the update step"])
def test_workers_tell_their_stage_and_end_at_once(tmp_path, monkeypatch, stage):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    job = Job(CONFIG, tmp_path / "runs" / "seed_0")
    with Worker([]) as worker:
        worker.begin(job)
        while worker.stage != f" ({stage})":
            assert worker.poll() is None
        asked = time.perf_counter()
    assert time.perf_counter() - asked < 10  # left with a job, it is told to stop
    assert worker._process.exitcode == 128 + signal.SIGTERM
    assert stage in job.log.read_text()
    assert "Traceback" not in job.log.read_text()
    assert not (job.folder / "checkpoints").exists()


@pytest.mark.slow
def test_two_workers_train_all_runs_and_name_the_one_that_failed(tmp_path, monkeypatch):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    other = dataclasses.replace(BASELINE, decoder=dataclasses.replace(BASELINE.decoder, queries=5))
    configs = {"one": CONFIG, "other": dataclasses.replace(CONFIG, task=LaneGraphTask(other))}
    out = tmp_path / "comparison"
    compare(configs, (0, 1, 2), out, parallel=2)
    scores = json.loads((out / "scores.json").read_text())
    assert {name: len(values) for name, values in scores.items()} == {"one": 3, "other": 3}
    assert len(list(out.glob("*/seed_*/config.json"))) == len(list(out.glob("*/seed_*.log"))) == 6
    (start,) = read_provenance(out / "one" / "seed_0")
    assert start["threads"] == worker_threads(2)

    # Scores that are gone, as after a change of the code, are measured by the workers.
    (out / "one" / "seed_1.scores.json").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(LaneGraphTask, "evaluate", None)  # of this process
        compare(configs, (0, 1, 2), out, parallel=2)
    assert json.loads((out / "scores.json").read_text()) == scores

    broken = {"one": dataclasses.replace(CONFIG, optim=OptimConfig(warmup_steps=1000))}
    with pytest.raises(UserError, match=r"one: optim\.warmup_steps is 1000"):
        compare(broken, (0, 1), tmp_path / "broken", parallel=2)
    assert not (tmp_path / "broken").exists()


@pytest.mark.parametrize(("name", "named"), [("camera/toponet_r50", True), ("camera/toponet", False)])
def test_rows_whose_best_checkpoint_is_chosen_by_test_examples_are_named(name, named, tmp_path, monkeypatch, capsys):
    def planned(*_, **__):
        raise UserError("planned")

    monkeypatch.setattr("tflane_jax.ablations.compare.plan_jobs", planned)
    with pytest.raises(UserError, match="planned"):
        compare({"host": load_config(name)}, [0], tmp_path)
    assert ("host: the best checkpoint is chosen by the test examples" in capsys.readouterr().err) == named
