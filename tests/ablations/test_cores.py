"""Cores of workers: shared equally, and not with other commands."""

import multiprocessing

import pytest

from tflane_jax.ablations.cores import cores_each, cores_of_workers
from tflane_jax.ablations.workers import worker_threads
from tflane_jax.errors import UserError
from tflane_jax.training.provenance import thread_setting


@pytest.fixture(autouse=True)
def _four_cores(monkeypatch, tmp_path):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(10, 14)), raising=False)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))


@pytest.mark.parametrize(("available", "parallel", "each"), [(8, 2, 4), (3, 2, 1), (2, 5, 1), (4, 1, 4)])
def test_all_workers_have_the_same_number_of_cores(monkeypatch, available, parallel, each):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(10, 10 + available)), raising=False)
    assert cores_each(parallel) == each
    assert worker_threads(parallel) == thread_setting(each)
    with cores_of_workers(parallel, each) as cores:
        assert [len(some) for some in cores] == [each] * parallel
    used = [core for some in cores for core in some]
    assert len(set(used)) == min(len(used), available)


def test_each_training_can_be_given_a_number_of_cores():
    with cores_of_workers(2, cores_each(2, 1)) as cores:
        assert cores == [[10], [11]]
    assert worker_threads(1, 1) == worker_threads(4) == worker_threads(2, 1)
    assert worker_threads(1, 4) == worker_threads(1)
    with pytest.raises(UserError, match="--cores 5: a training can have 1 to 4 cores here"):
        worker_threads(1, 5)


def test_commands_at_the_same_time_have_different_cores(capsys):
    with cores_of_workers(1, 1) as first, cores_of_workers(2, 1) as second:
        assert (first, second) == ([[10]], [[11], [12]])
        assert capsys.readouterr().err == ""
        with cores_of_workers(1, 2) as third:
            assert third == [[13, 10]]
        assert "1 of 2 cores are those of other trainings on this machine" in capsys.readouterr().err
    with cores_of_workers(1, 1) as later:
        assert later == [[10]]


def _hold(folder, pipe):
    import os
    import tempfile

    tempfile.gettempdir = lambda: folder
    os.sched_getaffinity = lambda _: {10, 11}
    with cores_of_workers(1, 1) as cores:
        pipe.send(cores)
        pipe.recv()


@pytest.mark.slow
def test_a_command_that_was_killed_leaves_its_core(tmp_path):
    context = multiprocessing.get_context("spawn")
    pipe, far = context.Pipe()
    process = context.Process(target=_hold, args=(str(tmp_path), far), daemon=True)
    process.start()
    assert pipe.recv() == [[10]]
    with cores_of_workers(1, 1) as cores:
        assert cores == [[11]]
    process.kill()
    process.join()
    with cores_of_workers(1, 1) as cores:
        assert cores == [[10]]


def test_no_workers_and_no_pinning():
    with cores_of_workers(0, 1) as cores:
        assert cores == []
    with cores_of_workers(2, 0) as cores:
        assert cores == [[], []]
