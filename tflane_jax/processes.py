"""Several processes that train one model, on one machine or on many: joining them, and what only the first one does.

All processes run the same program on the same data; each feeds its own devices (`devices`). Only the first one reads
and writes the run folder. What it finds there, the others are told, also if it is an error. A process on its own is the
first of one, and nothing here costs it anything.
"""

from __future__ import annotations

import contextlib
import contextvars
import json
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from tflane_jax.errors import UserError

T = TypeVar("T")
AGREE_EVERY = 10
"""Steps between two looks of several processes at whether any of them is to stop."""

_apart = contextvars.ContextVar("apart", default=False)


def join(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Join this process to the others; call it before JAX is used.

    Args:
        coordinator: host:port of the first process. None, together with the others: JAX asks the cluster (Slurm, Open
            MPI, Kubernetes, Cloud TPU).
        processes: how many there are.
        process: number of this one, from 0.

    Raises:
        UserError: one of the three is missing or out of range, no cluster is found, or the others do not come.
    """
    given = (coordinator, processes, process)
    if any(value is None for value in given) and any(value is not None for value in given):
        raise UserError("--coordinator, --processes and --process belong together: give all three")
    if processes is not None and process is not None and not 0 <= process < processes:
        raise UserError(f"--process {process} is none of {processes}: they are numbered from 0")
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"the processes of this training cannot be joined: {str(error).splitlines()[0]}") from error


def count() -> int:
    """Return the number of processes that work together; 1 inside `apart`."""
    return 1 if _apart.get() else jax.process_count()


def is_first() -> bool:
    """Return whether this process reads and writes the run folder."""
    return jax.process_index() == 0


@contextlib.contextmanager
def apart() -> Iterator[None]:
    """Let this process work on its own inside the block, with its first device: the others do not run it."""
    token = _apart.set(True)
    try:
        yield
    finally:
        _apart.reset(token)


def from_first(make: Callable[[], T]) -> T:
    """Call `make` in the first process and return its result, plain JSON, in all; a UserError is raised in all."""
    if count() == 1:
        return make()
    answer: dict[str, Any] = {}
    error: UserError | None = None
    if is_first():
        try:
            answer = {"value": make()}
        except UserError as caught:
            answer, error = {"error": str(caught)}, caught
    answer = json.loads(_told(json.dumps(answer).encode()))
    if "error" in answer:
        raise error or UserError(answer["error"])
    return answer["value"]


def arrays_from_first(make: Callable[[], T], like: T) -> T:
    """Call `make` in the first process and return its tree of arrays in all; a UserError is raised in all.

    Args:
        make: returns the arrays.
        like: a tree of the same structure, shapes and types.
    """
    if count() == 1:
        return make()
    held = like

    def hold() -> None:
        nonlocal held
        held = make()

    from_first(hold)
    return _broadcast(held)


def stop_signal(signal: int | None, step: int) -> int | None:
    """Return the signal by which the training is to stop after `step`, as seen by this process, or agreed by several.

    Several processes look every `AGREE_EVERY` steps, so that none waits for another at every step.
    """
    if count() == 1:
        return signal
    if step % AGREE_EVERY:
        return None
    from jax.experimental import multihost_utils

    asked = int(np.max(multihost_utils.process_allgather(np.int32(signal or 0))))
    return asked or None


def _told(text: bytes) -> bytes:
    """Return the first process's text in all."""
    size = int(_broadcast(np.int32(len(text))))
    padded = np.zeros(size, np.uint8)
    if is_first():
        padded[:] = np.frombuffer(text, np.uint8)
    return np.asarray(_broadcast(padded)).tobytes()


def _broadcast(tree: Any) -> Any:
    from jax.experimental import multihost_utils

    is_key = [jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in jax.tree.leaves(tree)]
    leaves, treedef = jax.tree.flatten(tree)
    plain = [jax.random.key_data(leaf) if key else leaf for leaf, key in zip(leaves, is_key, strict=True)]
    found = multihost_utils.broadcast_one_to_all([np.asarray(leaf) for leaf in plain])
    whole = [jax.random.wrap_key_data(leaf) if key else leaf for leaf, key in zip(found, is_key, strict=True)]
    return jax.tree.unflatten(treedef, whole)
