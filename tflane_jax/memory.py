"""Freed memory is kept for the next step, and given back after a training.

To be called first in a process: see `keep_freed_memory`.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable

# Parameters of glibc's mallopt: sizes from which memory is given back and mapped apart, and the number of heaps.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_KEPT = 2**30


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks of up to 1 GiB, in one heap.

    Every call of a compiled program allocates its temporary memory anew. By default glibc maps blocks of this size from
    the system each time, and the system clears every page: a seventh of the time of an LSTR training step. Heaps of
    threads other than the first cannot hold more than 64 MiB and would still do so: a third of a step of a small host
    with 64 queries. Threads of XLA allocate seldom, so that one heap for all costs nothing measurable.

    Must come before any thread, JAX's backend among them: glibc takes the number of heaps when a second thread first
    allocates, and ignores later changes without a word.
    """
    if (mallopt := _of_glibc("mallopt")) is None:
        return
    mallopt(_M_MMAP_THRESHOLD, _KEPT)
    mallopt(_M_TRIM_THRESHOLD, _KEPT)
    mallopt(_M_ARENA_MAX, 1)


def give_back_freed_memory() -> None:
    """Give what `keep_freed_memory` kept back to the system.

    To be called between trainings of one process: the data of the next one may not fit into the gaps that those of the
    last one left, and then lie above them.
    """
    gc.collect()
    if (trim := _of_glibc("malloc_trim")) is not None:
        trim(0)


def _of_glibc(name: str) -> Callable[..., int] | None:
    if sys.platform != "linux":
        return None
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError):  # a C library without it, such as musl
        return None
