"""Turns of processes that measure one GPU: they compile at the same time, and one of them runs at a time."""

from __future__ import annotations

import contextlib
import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path

_FILE = Path(tempfile.gettempdir()) / "tflane_gpu_benchmarks.lock"


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Wait until no other benchmark of this machine is inside this block."""
    with _FILE.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
