"""Turns of processes that measure one GPU: they compile at the same time, and one of them runs at a time."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tflane_jax.files.locks import take

_FILE = Path(tempfile.gettempdir()) / "tflane_gpu_benchmarks.lock"


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Wait until no other benchmark of this machine is inside this block."""
    with _FILE.open("w") as file:
        take(file, wait=True)
        yield
