"""Which job a worker takes next, beside other workers and other processes."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.table_plan import seed_by_seed
from tflane_jax.ablations.training_queue import LOOK_SECONDS, Queue, choose
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.run_folder import claimed

TASKS = [LaneGraphTask(TopoNetConfig(), clip=clip) for clip in (1, 2, 3)]


def job(model, seed):
    config = RunConfig(TASKS[model])
    return Job(replace(config, training=replace(config.training, seeds=(seed,))), Path(f"{model}/{seed}"))


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_every_model_gets_a_seed_before_any_gets_the_next(workers):
    waiting = [job(model, seed) for seed in (3, 4) for model in range(3)]
    compiled = [set() for _ in range(workers)]
    seeds = []
    for turn in range(6):
        mine = compiled[turn % workers]
        others = set().union(*(tasks for tasks in compiled if tasks is not mine))
        chosen = choose(waiting, mine, others)
        waiting.remove(chosen)
        mine.add(chosen.config.task)
        seeds += chosen.config.training.seeds
    assert seeds == [3, 3, 3, 4, 4, 4]


def test_a_run_that_one_table_has_recorded_and_another_needs_is_trained():
    needed = job(0, 0)
    recorded = replace(needed, recorded=SimpleNamespace())
    for plan in ({"a": [recorded], "b": [needed]}, {"a": [needed], "b": [recorded]}):
        assert [each.recorded for each in seed_by_seed(plan)] == [None]
    assert seed_by_seed({"a": [recorded]}) == [recorded]


def test_a_worker_prefers_what_it_has_compiled_then_what_nobody_has():
    waiting = [job(model, 0) for model in range(3)] + [job(0, 1)]
    assert choose(waiting, {TASKS[2]}, {TASKS[0]}) is waiting[2]
    assert choose(waiting, set(), {TASKS[0]}) is waiting[1]
    assert choose(waiting, set(), set(TASKS)) is waiting[0]


class Everything:
    """Reservations of which another process holds some."""

    def __init__(self, taken):
        self.taken, self.released = set(taken), []

    def take(self, run):
        return run not in self.taken

    def release(self, run):
        self.released.append(run)


def test_jobs_of_other_processes_are_waited_for(monkeypatch):
    """They are looked at again: one was finished there, the other was given up."""
    jobs, complete, now = [job(model, 0) for model in range(3)], set(), [0.0]
    monkeypatch.setattr("tflane_jax.ablations.training_queue.time.monotonic", lambda: now[0])
    reservations = Everything([jobs[0].folder, jobs[1].folder])
    queue = Queue(jobs, reservations, lambda each: each.folder in complete)
    assert queue.take() is jobs[2]
    assert queue.take() is None
    assert (len(queue), list(queue.elsewhere)) == (2, jobs[:2])
    complete.add(jobs[0].folder)
    reservations.taken.clear()
    assert queue.take() is None  # not yet looked at
    now[0] += 2 * LOOK_SECONDS
    assert queue.take() is jobs[1]
    assert len(queue) == 0
    queue.done(jobs[1])
    assert reservations.released == [jobs[1].folder]


def test_a_job_that_another_process_has_just_finished_is_not_trained_again():
    jobs, complete = [job(0, 0), job(1, 0)], []
    reservations = Everything([])
    queue = Queue(jobs, reservations, lambda each: each.folder in complete)
    complete.append(jobs[0].folder)
    assert queue.take() is jobs[1]
    assert reservations.released == [jobs[0].folder]


def starting_from(other, model, seed):
    made = job(model, seed)
    return replace(
        made, config=replace(made.config, training=replace(made.config.training, init_from=str(other.folder)))
    )


def test_a_run_waits_for_the_one_that_it_starts_from():
    """A row before its host, two workers: the second takes another job, then none until the host is done."""
    host, other = job(0, 0), job(2, 0)
    row = starting_from(host, 1, 0)
    queue = Queue([row, host, other], Everything([]), lambda each: False)
    assert [queue.take(), queue.take()] == [host, other]
    queue.done(other)
    assert queue.take() is None
    assert len(queue) == 1
    queue.done(host)
    assert queue.take() is row


def test_a_run_waits_for_one_that_another_process_trains(monkeypatch):
    now, complete = [0.0], set()
    monkeypatch.setattr("tflane_jax.ablations.training_queue.time.monotonic", lambda: now[0])
    host = job(0, 0)
    row = starting_from(host, 1, 0)
    queue = Queue([row, host], Everything([host.folder]), lambda each: each.folder in complete)
    assert queue.take() is None
    complete.add(host.folder)
    now[0] += 2 * LOOK_SECONDS
    assert queue.take() is row


def test_no_run_starts_from_one_that_failed():
    """Nor do two runs that start from one another wait for ever."""
    host = job(0, 0)
    row = starting_from(host, 1, 0)
    queue = Queue([host, row], Everything([]), lambda each: False)
    queue.check_origins(queue.take())
    queue.done(host)  # not complete
    with pytest.raises(UserError, match="the run that it starts from, is not complete"):
        queue.check_origins(queue.take())
    circle = [starting_from(row, 0, 0), row]
    queue = Queue(circle, Everything([]), lambda each: False)
    for _ in circle:
        taken = queue.take()
        with pytest.raises(UserError, match="is not complete"):
            queue.check_origins(taken)
        queue.done(taken)
    assert len(queue) == 0


def test_a_run_that_a_process_still_trains_is_waited_for(tmp_path, monkeypatch):
    """Its reservation is void, as after a kill, but its lock is held."""
    now = [0.0]
    monkeypatch.setattr("tflane_jax.ablations.training_queue.time.monotonic", lambda: now[0])
    run, reservations = replace(job(0, 0), folder=tmp_path), Everything([])
    queue = Queue([run], reservations, lambda each: False)
    (tmp_path / "config.json").touch()
    with claimed(tmp_path, "resume"):
        assert queue.take() is None
        assert list(queue.elsewhere) == [run]
        assert reservations.released == [tmp_path]
    now[0] += 2 * LOOK_SECONDS
    assert queue.take() is run


def test_a_run_knows_the_one_that_it_starts_from_by_any_path():
    """`--out runs/x` beside an absolute training.init_from: a host that was stopped half-way is no host yet."""
    host, row = job(0, 0), job(1, 0)
    training = replace(row.config.training, init_from=str(Path.cwd() / host.folder))
    row = replace(row, config=replace(row.config, training=training))
    queue = Queue([host, row], Everything([]), lambda each: False)
    assert queue.take() is host
    assert queue.take() is None
    with pytest.raises(UserError, match="is not complete"):
        queue.check_origins(row)


def test_a_complete_run_is_trained_again_if_the_one_that_it_starts_from_was():
    """--retrain with another setting of the host: the row has not changed, and is of the old host."""
    host = job(0, 0)
    row = starting_from(host, 1, 0)
    last = starting_from(row, 2, 0)
    complete = {row.folder, last.folder}
    queue = Queue([last, row, host], Everything([]), lambda each: each.folder in complete)
    for taken, spoiled in ((host, row), (row, last), (last, None)):
        assert queue.take() is taken
        assert queue.take() is None
        complete.add(taken.folder)
        complete.discard(spoiled and spoiled.folder)
        queue.done(taken)
    assert len(queue) == 0
    # One that the host's training did not change is left alone.
    complete = {row.folder}
    queue = Queue([row, host], Everything([]), lambda each: each.folder in complete)
    complete.add(queue.take().folder)
    queue.done(host)
    assert queue.take() is None
    assert len(queue) == 0
