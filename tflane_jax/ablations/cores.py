"""Which cores a worker has, so that commands that train on one machine at the same time do not share them.

Cores that a command has are locked by files in the folder for temporary files, each user's own. The system drops a lock
with the process that holds it.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tflane_jax.errors import UserError
from tflane_jax.files.locks import take
from tflane_jax.progress import write


def cores_each(parallel: int, cores: int | None = None) -> int:
    """Return how many cores each worker has: all have the same number, so that results do not depend on the worker.

    Args:
        parallel: workers at a time.
        cores: of each worker; None shares all cores equally.

    Returns:
        The number; 0 where the system does not pin processes to cores.

    Raises:
        UserError: a number that cannot be had here.
    """
    if not hasattr(os, "sched_getaffinity"):
        if cores is not None:
            raise UserError(
                f"--cores {cores}: this system does not tell a process which cores to use; leave it out: recorded runs "
                "are taken whatever their cores were"
            )
        return 0
    every = len(os.sched_getaffinity(0))
    if cores is not None and not 1 <= cores <= every:
        raise UserError(f"--cores {cores}: a training can have 1 to {every} cores here")
    return cores or max(every // parallel, 1)


@contextlib.contextmanager
def cores_of_workers(workers: int, each: int) -> Iterator[list[list[int]]]:
    """Give the cores of every worker; inside the block, no other command takes them unless it finds too few.

    Args:
        workers: that work at a time.
        each: cores of each, from `cores_each`; with 0, all lists are empty.
    """
    every = sorted(os.sched_getaffinity(0)) if each else []
    wanted = min(workers * each, len(every))
    with contextlib.ExitStack() as held:
        mine: list[int] = []
        for core in every:
            if len(mine) < wanted and _is_free(core, held):
                mine.append(core)
        if missing := wanted - len(mine):
            write(f"{missing} of {wanted} cores are those of other trainings on this machine: each will be slower")
            mine += [core for core in every if core not in mine][:missing]
        yield [[mine[(slot * each + i) % wanted] for i in range(each)] for slot in range(workers)]


def _is_free(core: int, held: contextlib.ExitStack) -> bool:
    """Lock a core until `held` ends; return False if another command has it."""
    try:
        folder = Path(tempfile.gettempdir()) / f"tflane_jax-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        lock = os.open(folder / f"core_{core}.lock", os.O_CREAT | os.O_RDWR, 0o600)
        held.callback(os.close, lock)
    except (AttributeError, OSError):  # Windows, or a folder that is another user's: commands do not know of each other
        return True
    return take(lock)
