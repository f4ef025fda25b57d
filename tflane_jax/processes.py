"""Several processes that train one model, on one machine or on many: joining them, and what only the first one does.

All processes run the same program on the same data; each feeds its own devices (`devices`). Only the first one reads
and writes the run folder. What it finds there, the others are told, also if it is an error. What goes wrong in one
process alone, before the first step, all are told too (`agreed`); later, that process ends at once (`leaving`), and the
others, which wait for it, are ended by JAX. A process on its own is the first of one, and nothing here costs it
anything.
"""

from __future__ import annotations

import contextlib
import contextvars
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from tflane_jax.accelerators import devices_of_task
from tflane_jax.errors import UserError

T = TypeVar("T")
AGREE_EVERY = 10
"""Steps between two looks of several processes at whether any of them is to stop."""

HEARTBEAT_SECONDS = 30
"""After so long without a sign of one process, JAX ends the others."""

_apart = contextvars.ContextVar("apart", default=False)


class AgreedError(UserError):
    """An error that all processes raise."""


def join(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Join this process to the others; call it before JAX is used.

    A process that is given its place uses all devices that it sees, one that asks the cluster its own
    (`accelerators.devices_of_task`); JAX_LOCAL_DEVICE_IDS says otherwise.

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
    ask = coordinator is None  # the cluster
    own = devices_of_task(os.environ) if ask and "JAX_LOCAL_DEVICE_IDS" not in os.environ else None
    try:
        jax.distributed.initialize(
            coordinator,
            processes,
            process,
            own,
            cluster_detection_method=None if ask else "deactivate",
            heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
        )
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
    """Call `make` in the first process and return its result, plain JSON, in all; an error is raised in all."""
    if count() == 1:
        return make()
    answer: dict[str, Any] = {}
    error: Exception | None = None
    if is_first():
        try:
            answer = {"value": make()}
        except Exception as caught:
            answer, error = {"error": _in_words(caught)}, caught
    answer = json.loads(_told(json.dumps(answer).encode()))
    if "error" in answer:
        raise _own(error) or AgreedError(answer["error"])
    return answer["value"]


@contextlib.contextmanager
def agreed() -> Iterator[None]:
    """Let an error that one process raises inside the block end it in all: each waits for the others at its end.

    The block itself may not wait for other processes.
    """
    if count() == 1:
        yield
        return
    from jax.experimental import multihost_utils

    error: Exception | None = None
    try:
        yield
    except Exception as caught:
        error = caught
    failed = np.asarray(multihost_utils.process_allgather(np.int32(error is not None)))
    if not failed.any():
        return
    number = int(failed.argmax())
    told = _told(b"" if error is None else _in_words(error).encode(), source=number).decode()
    raise _own(error) or AgreedError(f"process {number}: {told}")


@contextlib.contextmanager
def leaving() -> Iterator[None]:
    """End this process at once after an error inside the block that the others do not know of.

    Otherwise it would wait for them at its end, as they wait for its part of the next step.
    """
    try:
        yield
    except AgreedError:
        raise
    except Exception as error:
        if count() == 1:
            raise
        if isinstance(error, UserError):
            print(f"tflane: {error}", file=sys.stderr)
        else:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(2 if isinstance(error, UserError) else 1)


def _own(error: Exception | None) -> Exception | None:
    """Return what the process that had an error raises: a user's error as one that all know of."""
    return AgreedError(str(error)) if isinstance(error, UserError) else error


def _in_words(error: Exception) -> str:
    return str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"


def arrays_from_first(make: Callable[[], T], like: T) -> T:
    """Call `make` in the first process and return its tree of arrays in all; an error is raised in all.

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


def all_rows(tree: Any) -> Any:
    """Return the rows (leading axis) of all processes, in their order, of arrays (numpy) that each has a part of.

    They travel as bytes, so that no type changes.
    """
    leaves, treedef = jax.tree.flatten(tree)
    if count() == 1 or not leaves:
        return tree
    from jax.experimental import multihost_utils

    leaves = [np.ascontiguousarray(leaf) for leaf in leaves]
    sent = np.concatenate([leaf.reshape(-1).view(np.uint8) for leaf in leaves])
    every = np.asarray(multihost_utils.process_allgather(sent))
    whole, start = [], 0
    for leaf in leaves:
        part = np.ascontiguousarray(every[:, start : start + leaf.nbytes])
        whole.append(part.view(leaf.dtype).reshape(len(every) * len(leaf), *leaf.shape[1:]))
        start += leaf.nbytes
    return jax.tree.unflatten(treedef, whole)


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


def _told(text: bytes, source: int = 0) -> bytes:
    """Return the text of one process in all."""
    size = int(_broadcast(np.int32(len(text)), source))
    padded = np.zeros(size, np.uint8)
    if jax.process_index() == source:
        padded[:] = np.frombuffer(text, np.uint8)
    return np.asarray(_broadcast(padded, source)).tobytes()


def _broadcast(tree: Any, source: int = 0) -> Any:
    from jax.experimental import multihost_utils

    is_key = [jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in jax.tree.leaves(tree)]
    leaves, treedef = jax.tree.flatten(tree)
    plain = [jax.random.key_data(leaf) if key else leaf for leaf, key in zip(leaves, is_key, strict=True)]
    own = jax.process_index() == source
    found = multihost_utils.broadcast_one_to_all([np.asarray(leaf) for leaf in plain], is_source=own)
    whole = [jax.random.wrap_key_data(leaf) if key else leaf for leaf, key in zip(found, is_key, strict=True)]
    return jax.tree.unflatten(treedef, whole)
