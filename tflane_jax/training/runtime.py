"""Process-wide settings of JAX, made in one place and once, by whoever owns the process (the command line, a test)."""

from __future__ import annotations

import ctypes
import sys

import jax

# Parameters of glibc's mallopt: sizes from which memory is mapped apart, and given back.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT = 2**30


def configure_jax() -> None:
    """Let arrays of different rank never broadcast silently, and keep the memory of one step for the next."""
    jax.config.update("jax_numpy_rank_promotion", "raise")
    _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Let glibc hold on to freed memory of up to 1 GiB a piece.

    Every run of a compiled program allocates its temporary memory anew. By default glibc maps pieces of this size from
    the system each time, which then clears every page: a seventh of the time of an LSTR training step.
    """
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # a C library without it, musl say
        return
    mallopt(_M_MMAP_THRESHOLD, _KEPT)
    mallopt(_M_TRIM_THRESHOLD, _KEPT)
