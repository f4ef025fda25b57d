"""Settings of malloc: a training keeps freed memory for its next step, and returns it at the end."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's mallopt: sizes to give back, and to map apart
_KEPT = 2**31 - 1  # the most that mallopt takes
_TUNABLES, _HUGE_PAGES = "GLIBC_TUNABLES", "glibc.malloc.hugetlb"


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks, up to 2 GiB of them.

    Every call of a compiled program allocates its temporary memory anew. By default glibc maps blocks of this size from
    the system each time, and the system clears every page: a seventh of the time of an LSTR training step, which frees
    more than 1 GiB.

    Heaps of threads other than the first cannot hold more than 64 MiB, and would still do so: a third of a step of a
    small host with 64 queries. The first heap should stay free of gaps: compiling leaves a hundred thousand, and
    searching them for blocks took 38 of 205 ms of a step of LaneSegNet. Programs therefore run in the thread that calls
    them (`training.runtime`) and are compiled in another one, with a heap of its own (`startup.compiled`).
    """
    if (mallopt := _of_glibc("mallopt")) is None:
        return
    mallopt(_M_MMAP_THRESHOLD, _KEPT)
    mallopt(_M_TRIM_THRESHOLD, _KEPT)


def give_back_freed_memory() -> None:
    """Give what `keep_freed_memory` kept back to the system.

    To be called between trainings of one process: the data of the next one may not fit into the gaps that those of the
    last one left, and then lie above them.
    """
    gc.collect()
    if (trim := _of_glibc("malloc_trim")) is not None:
        trim(0)


@contextlib.contextmanager
def huge_pages_for_children() -> Iterator[None]:
    """Processes that start inside the block request huge pages (2 MiB), if the system grants them on request.

    A step writes all of its temporary memory, some 80 MiB for a small host, and with pages of 4 KiB finding them costs
    2 to 8 % of its time. glibc reads the setting when a process starts: too late for this one.
    """
    before = os.environ.get(_TUNABLES)
    if _HUGE_PAGES not in (before or ""):
        os.environ[_TUNABLES] = ":".join(filter(None, (before, f"{_HUGE_PAGES}=1")))
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_TUNABLES, None)
        else:
            os.environ[_TUNABLES] = before


def _of_glibc(name: str) -> Callable[..., int] | None:
    if sys.platform != "linux":
        return None
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError):  # a C library without it, such as musl
        return None
