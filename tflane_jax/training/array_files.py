"""Named arrays on disk, as orbax writes them, with one short error where the system refuses.

Orbax is imported in the functions that need it, because its import takes about a second.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict


def save_arrays(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays by path ("encoder/kernel") into a new folder; raises OSError."""
    import orbax.checkpoint as ocp

    try:
        with _quiet_if_it_fails(), _checkpointer() as writer:
            writer.save(folder.absolute(), args=ocp.args.PyTreeSave(unflatten_dict(arrays, sep="/")))
    except Exception as error:  # those of orbax and tensorstore for a full disk are no OSError
        cause = system_error(error)
        raise cause if isinstance(cause, OSError) else OSError(first_line(error)) from error


@contextlib.contextmanager
def _quiet_if_it_fails() -> Iterator[None]:
    """Drop what the threads of orbax and tensorstore print of a failed write: a traceback for every array.

    The caller gets the error itself. Some threads print after that, so the hook of a failed write stays.
    """
    show = sys.unraisablehook

    def hook(found: Any) -> None:
        if str(found.exc_value) != "Event loop is closed":
            show(found)

    def wanted(record: logging.LogRecord) -> bool:
        return "_SignalingThread" not in record.getMessage()

    logger = logging.getLogger("absl")
    logger.addFilter(wanted)
    sys.unraisablehook = hook
    try:
        yield
    finally:
        logger.removeFilter(wanted)
    sys.unraisablehook = show


def system_error(error: Exception) -> Exception:
    """Return an error of tensorstore as that of the system, where its text, a chain of all causes, names one."""
    code = re.search(r"\[os_error_code='(\d+)'\]", str(error))
    return error if code is None else OSError(int(code[1]), os.strerror(int(code[1])))


def _checkpointer() -> Any:
    """Return orbax's reader and writer, for this process alone: it would wait for others that train with it."""
    import orbax.checkpoint as ocp

    if jax.process_count() == 1:
        return ocp.Checkpointer(ocp.PyTreeCheckpointHandler())
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process_{me}"
    )
    return ocp.Checkpointer(ocp.PyTreeCheckpointHandler(multiprocessing_options=alone), multiprocessing_options=alone)


def load_arrays(folder: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a folder by path; raises what orbax and tensorstore raise for a damaged one."""
    import orbax.checkpoint as ocp

    with _checkpointer() as reader:
        names = reader.metadata(folder.absolute()).item_metadata.tree
        _check_memory([(leaf.shape, np.dtype(leaf.dtype)) for leaf in jax.tree.leaves(names)])
        as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), names)
        return flat(reader.restore(folder.absolute(), args=ocp.args.PyTreeRestore(restore_args=as_numpy)))


def _check_memory(arrays: Sequence[tuple[Sequence[int], np.dtype]]) -> None:
    """Raise ValueError for arrays that this machine cannot hold: allocating them would end the process."""
    needed = sum(math.prod(shape) * dtype.itemsize for shape, dtype in arrays)
    try:
        page, pages = (os.sysconf(name) for name in ("SC_PAGE_SIZE", "SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # this system does not tell
        return
    if page > 0 and pages > 0 and needed > (there := page * pages):
        raise ValueError(f"its arrays claim {needed / 2**30:.3g} GiB, this machine has {there / 2**30:.3g}")


def first_line(error: Exception) -> str:
    """Return the first line of an error's text, its class where it has none."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__


def flat(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the leaves of nested dicts by path; empty dicts vanish."""
    return flatten_dict(tree, sep="/")  # pyright: ignore[reportReturnType]
