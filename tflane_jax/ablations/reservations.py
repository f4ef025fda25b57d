"""Which process trains a run, where several share a folder: on one machine, or on several with a network drive.

A reservation is a file beside the run's folder that only one process can create. Its holder renews the file's time
while it trains. A reservation is void when its process is gone (on the same machine) or when it has not been renewed
for three minutes by the clock of the waiting process, so that the machines' clocks need not agree.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
import uuid
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError

RENEW_SECONDS = 20.0
VOID_SECONDS = 180.0


class Reservations:
    """The reservations of this process; a thread renews them inside the block, and its end releases them."""

    def __init__(self) -> None:
        self._me = {"machine": _machine(), "process": os.getpid(), "token": uuid.uuid4().hex}
        self._held: set[Path] = set()
        self._seen: dict[Path, tuple[int, float]] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._renew, daemon=True)

    def __enter__(self) -> Reservations:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        for run in list(self._held):
            self.release(run)

    def take(self, run: Path) -> bool:
        """Reserve a run, given by its folder, for this process; return False if another process holds it."""
        if run in self._held:
            return True
        path = _path(run)
        found = _content(path)
        if self._is_void(path):
            _set_aside(path, found)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot write to {path.parent}: {error.strerror or error}") from error
        try:
            with open(path, "x", encoding="utf-8") as file:
                json.dump(self._me, file)
        except FileExistsError:
            return False
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror or error}") from error
        self._held.add(run)
        return True

    def release(self, run: Path) -> None:
        """Let other processes have a run; no-op for one that is not held."""
        if run in self._held:
            self._held.discard(run)
            if _read(_path(run)) == self._me:  # not so if this process slept until its reservation was void
                _path(run).unlink(missing_ok=True)

    def _is_void(self, path: Path) -> bool:
        try:
            changed = path.stat().st_mtime_ns
        except OSError:
            return False
        found = _read(path)
        if found and found["machine"] == self._me["machine"] and not _lives(found["process"]):
            return True
        first = self._seen.setdefault(path, (changed, time.monotonic()))
        if first[0] != changed:
            self._seen[path] = first = (changed, time.monotonic())
        return time.monotonic() - first[1] > VOID_SECONDS

    def _renew(self) -> None:
        while not self._over.wait(RENEW_SECONDS):
            for run in list(self._held):
                with contextlib.suppress(OSError):
                    if _read(_path(run)) == self._me:  # not so if this process slept until its reservation was void
                        os.utime(_path(run))


def _machine() -> list[str]:
    """Return what identifies the machine, and within it the container, in which a process number has its meaning."""
    names = [socket.gethostname()]
    with contextlib.suppress(OSError):
        names += [Path("/proc/sys/kernel/random/boot_id").read_text().strip(), os.readlink("/proc/self/ns/pid")]
    return names


def _path(run: Path) -> Path:
    return run.with_name(f"{run.name}.reserved")


def _read(path: Path) -> dict[str, Any]:
    """Return who holds a reservation; empty if there is none, or its writer was stopped half-way."""
    with contextlib.suppress(OSError, ValueError):
        found = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(found, dict) and found.keys() >= {"machine", "process", "token"}:
            return found
    return {}


def _lives(process: Any) -> bool:
    if os.name != "posix":  # elsewhere, signal 0 would end the process
        return True
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError, ValueError, TypeError):
        return True
    return True


def _content(path: Path) -> tuple[bytes, int] | None:
    """Return what a reservation says and when it was renewed; None if there is none."""
    with contextlib.suppress(OSError):
        return path.read_bytes(), path.stat().st_mtime_ns
    return None


def _set_aside(path: Path, void: tuple[bytes, int] | None) -> None:
    """Remove a reservation that was found void.

    Another process may have removed it since and reserved the run: its file is put back.
    """
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    with contextlib.suppress(OSError):
        os.rename(path, aside)
        if _content(aside) != void:
            with contextlib.suppress(FileExistsError):  # a third process has reserved the run meanwhile
                os.link(aside, path)
        aside.unlink()
