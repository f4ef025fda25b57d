"""Reservations of runs: one holder at a time, and none that outlives its process."""

import json
import os
import subprocess
import sys
import threading
import time

import pytest

from tflane_jax.ablations import reservations
from tflane_jax.ablations.reservations import Reservations
from tflane_jax.errors import UserError


def reserved(run):
    return run.with_name(f"{run.name}.reserved")


def test_a_run_is_held_by_one_until_it_is_released(tmp_path):
    run = tmp_path / "model" / "seed_0"
    with Reservations() as first, Reservations() as second:
        assert first.take(run)
        assert first.take(run)  # again by the same process
        assert not second.take(run)
        second.release(run)  # not its own
        assert reserved(run).exists()
        first.release(run)
        assert not reserved(run).exists()
        assert second.take(run)
    assert not reserved(run).exists()


def test_of_many_at_once_one_gets_it(tmp_path):
    run, got, ready = tmp_path / "seed_0", [], threading.Barrier(8)
    every = [Reservations() for _ in range(8)]

    def take(one):
        ready.wait()
        got.append(one.take(run))

    threads = [threading.Thread(target=take, args=(one,)) for one in every]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(got) == [False] * 7 + [True]


def test_the_reservation_of_a_dead_process_is_void(tmp_path):
    run = tmp_path / "seed_0"
    code = f"""
import os
from pathlib import Path
from tflane_jax.ablations.reservations import Reservations
assert Reservations().take(Path({str(run)!r}))
os.kill(os.getpid(), 9)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    assert reserved(run).exists()
    with Reservations() as other:
        assert other.take(run)


@pytest.mark.skipif(os.name != "posix", reason="elsewhere a dead process cannot be told")
def test_who_finds_a_void_reservation_late_leaves_the_new_one(tmp_path, monkeypatch):
    """Two processes find a reservation void; the first reserves the run before the second removes what it found."""
    run, slow, fast = tmp_path / "seed_0", Reservations(), Reservations()
    reserved(run).write_text(json.dumps(slow._me | {"process": dead_process()}))
    set_aside = reservations._set_aside

    def later(path, void):
        monkeypatch.setattr(reservations, "_set_aside", set_aside)
        assert fast.take(run)
        set_aside(path, void)

    monkeypatch.setattr(reservations, "_set_aside", later)
    assert not slow.take(run)
    assert json.loads(reserved(run).read_text()) == fast._me
    assert [path.name for path in tmp_path.iterdir()] == [reserved(run).name]


def dead_process() -> int:
    """Return the number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.parametrize("content", ["another machine", ""])
def test_what_is_not_renewed_is_void_after_a_while(tmp_path, monkeypatch, content):
    """Another machine's process cannot be looked at, and a file cut short has no process."""
    run, now = tmp_path / "seed_0", [1000.0]
    monkeypatch.setattr(reservations.time, "monotonic", lambda: now[0])
    if content:
        with Reservations() as first:
            first._me["machine"] = [content]
            assert first.take(run)
            kept = reserved(run).read_bytes()
        reserved(run).write_bytes(kept)
    else:
        reserved(run).touch()
    with Reservations() as other:
        assert not other.take(run)
        now[0] += 0.9 * reservations.VOID_SECONDS
        os.utime(reserved(run), ns=(1, 1))  # renewed; whatever its clock says
        assert not other.take(run)
        now[0] += 0.9 * reservations.VOID_SECONDS
        assert not other.take(run)
        now[0] += 0.2 * reservations.VOID_SECONDS
        assert other.take(run)


def test_held_reservations_are_renewed(tmp_path, monkeypatch):
    monkeypatch.setattr(reservations, "RENEW_SECONDS", 0.01)
    run = tmp_path / "seed_0"
    with Reservations() as one:
        assert one.take(run)
        os.utime(reserved(run), ns=(1, 1))
        for _ in range(500):
            if reserved(run).stat().st_mtime_ns > 1:
                break
            threading.Event().wait(0.01)
        assert reserved(run).stat().st_mtime_ns > 1


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot write"):
        Reservations().take(tmp_path / "file" / "seed_0")


def test_a_process_that_slept_does_not_renew_the_reservation_of_its_successor(tmp_path, monkeypatch):
    run = tmp_path / "seed_0"
    monkeypatch.setattr(reservations, "RENEW_SECONDS", 0.01)
    with Reservations() as sleeper:
        sleeper.take(run)
        reserved(run).unlink()  # it was void, and another process took the run
        assert Reservations().take(run)
        os.utime(reserved(run), (1.0, 1.0))
        time.sleep(0.1)
        assert reserved(run).stat().st_mtime == 1.0
