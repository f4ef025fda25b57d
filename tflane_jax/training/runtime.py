"""Process-wide settings of JAX, made once by the program that owns the process (command line, test)."""

from __future__ import annotations

import ctypes
import sys

import jax

# Parameters of glibc's mallopt: sizes from which memory is mapped apart, and given back.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT = 2**30


def configure_jax() -> None:
    """Make silent broadcasting between ranks an error, and keep freed memory for the next step."""
    jax.config.update("jax_numpy_rank_promotion", "raise")
    _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Let glibc keep freed blocks of up to 1 GiB.

    Every call of a compiled program allocates its temporary memory anew. By default glibc maps blocks of this size from
    the system each time, and the system clears every page: a seventh of the time of an LSTR training step.
    """
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # a C library without it, such as musl
        return
    mallopt(_M_MMAP_THRESHOLD, _KEPT)
    mallopt(_M_TRIM_THRESHOLD, _KEPT)
