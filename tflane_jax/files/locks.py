"""Locks of open files, which the system releases when the file is closed or the process that holds one is killed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


def take(
    file: int | IO[Any], *, shared: bool = False, wait: bool = False, tell: Callable[[str], object] | None = None
) -> bool:
    """Lock an open file; return whether no other process holds it.

    Where there are no locks, on Windows and on some network file systems, every process is told that none does.

    Args:
        file: it, or its number.
        shared: whether others may hold it in this way at the same time.
        wait: until it is free.
        tell: called with the reason where the file system has no locks.
    """
    if fcntl is None:
        return True
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, kind if wait else kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if tell is not None:
            tell(error.strerror or str(error))
    return True


def is_at(file: int, path: Path) -> bool:
    """Return whether an open file, given by its number, is still the one that a path names."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False
