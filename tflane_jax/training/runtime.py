"""Process-wide settings of JAX, made once by the program that owns the process (command line, test)."""

from __future__ import annotations

import contextlib
import gc
import inspect
import warnings
from pathlib import Path
from typing import Any

import jax

from tflane_jax import accelerators
from tflane_jax.datasets.cache import cache_root
from tflane_jax.errors import UserError
from tflane_jax.memory import keep_freed_memory
from tflane_jax.progress import write

_UNREADABLE = "Error reading persistent compilation cache entry"  # the beginning of a warning of JAX's
_PROGRAMS = 2 * 2**30  # bytes of kept programs


def configure_jax(*, keep_programs: bool = True) -> None:
    """Make silent broadcasting between ranks an error, keep freed memory and compiled programs, trace faster.

    On GPUs, cuBLAS computes matrix products, see `accelerators.disable_triton_gemm`.

    Args:
        keep_programs: keep compiled programs for the next process, in the folder `programs` of the cache (TFLANE_CACHE)
            or where JAX_COMPILATION_CACHE_DIR says. JAX_ENABLE_COMPILATION_CACHE=false keeps none.

    Raises:
        UserError: JAX computes in 64 bits.
    """
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise UserError("JAX_ENABLE_X64 is set, but models here compute in 32 bits: unset it, or set it to 0")
    accelerators.disable_triton_gemm()
    jax.config.update("jax_numpy_rank_promotion", "raise")
    # The heap of the calling thread keeps the memory of a step, see `keep_freed_memory`.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    keep_freed_memory()
    # Tracing makes millions of objects and little garbage: collecting at the default rate takes a tenth of its time.
    gc.set_threshold(100_000, 50, 100)
    if keep_programs and jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        _keep_programs(cache_root() / "programs")
    if keep_programs and warnings.showwarning is not _show_or_replace:
        global _show
        _show, warnings.showwarning = warnings.showwarning, _show_or_replace


def _keep_programs(folder: Path) -> None:
    """Let JAX keep compiled programs in a folder; the oldest are dropped where they are more than 2 GiB."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = [file for file in folder.iterdir() if file.is_file()]  # XLA keeps a folder there, on GPUs
        files = sorted(((file.stat(), file) for file in files), key=lambda pair: -pair[0].st_mtime)
        total = 0
        for found, file in files:
            total += found.st_size
            if total > _PROGRAMS:
                file.unlink(missing_ok=True)
    except OSError:  # a home that cannot be written, or another process drops files: every process compiles anew
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


_show = warnings.showwarning


def _show_or_replace(message: Warning | str, *arguments: Any, **named: Any) -> None:
    """Show a warning; delete the kept program that it is about, if JAX cannot read it.

    A process that was killed, or a disk that was full, leaves half a program. JAX then compiles, but writes no file
    where there is one, so that every later start would compile too.
    """
    if not str(message).startswith(_UNREADABLE):
        _show(message, *arguments, **named)
        return
    frame = inspect.currentframe()
    while frame is not None and "cache_key" not in frame.f_locals:  # JAX's function that reads
        frame = frame.f_back
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if frame is None or folder is None:
        _show(message, *arguments, **named)
        return
    for file in Path(folder).glob(f"{frame.f_locals['cache_key']}*"):
        with contextlib.suppress(OSError):
            file.unlink()
            write(f"{file} was damaged: the program is compiled and kept anew")
