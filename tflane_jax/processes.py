"""Several processes that train one model, on one machine or on many: joining them, and what only the first one does.

All processes run the same program on the same data; each feeds its own devices (`devices`). Only the first process
reads and writes the run folder; it sends the content, or its error, to the others (`from_first`). An error in one
process before the first step is raised in all of them (`agreed`). After that, the process with the error ends at once
(`leaving`), and JAX ends the others, which wait for it. A single process is the first of one, at no cost.
"""

from __future__ import annotations

import contextlib
import contextvars
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from tflane_jax.accelerators import devices_of_task
from tflane_jax.errors import UserError

T = TypeVar("T")
AGREE_EVERY = 10
"""Several processes agree every so many steps on whether to stop."""

HEARTBEAT_SECONDS = 30
"""If a process sends no heartbeat for so long, JAX ends the others."""

_apart = contextvars.ContextVar("apart", default=False)


class AgreedError(UserError):
    """An error that all processes raise."""


def join(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Join this process to the others; call it before JAX is used.

    Joined processes keep no compiled programs and read none, whatever `training.runtime.configure_jax` set: JAX writes
    those of the first process alone. Where each host has a cache of its own, the first process would load a program
    that the others compile. XLA divides autotuning on GPUs among the processes, and theirs would wait for results that
    the first one never sends.

    With explicit arguments, a process uses all devices that it sees; in a cluster's job, those of its task
    (`accelerators.devices_of_task`). JAX_LOCAL_DEVICE_IDS overrules both.

    JAX's preemption service stays off: its handler of SIGTERM would replace that of the command, and nothing here asks
    it whether a SIGTERM came.

    Args:
        coordinator: host:port of the first process. None, together with the others: JAX asks the cluster (Slurm, Open
            MPI, Kubernetes, Cloud TPU).
        processes: how many there are.
        process: number of this one, from 0.

    Raises:
        UserError: one of the three is missing or out of range, no cluster is found, the others do not come, or the
            processes have different numbers of devices (the same error in all).
    """
    given = (coordinator, processes, process)
    if any(value is None for value in given) and any(value is not None for value in given):
        raise UserError("--coordinator, --processes and --process belong together: give all three")
    if processes is not None and process is not None and not 0 <= process < processes:
        raise UserError(f"--process {process} is none of {processes}: they are numbered from 0")
    ask = coordinator is None  # the cluster
    own = devices_of_task(os.environ) if ask and "JAX_LOCAL_DEVICE_IDS" not in os.environ else None
    jax.config.update("jax_enable_preemption_service", False)
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
        if ask and "coordinator_address" in str(error):
            raise UserError(
                "no cluster's job was found in which to join other processes (Slurm, Open MPI, Kubernetes, Cloud TPU): "
                "give each process --coordinator HOST:PORT, --processes and --process, or leave --distributed out"
            ) from error
        raise UserError(f"the processes of this training cannot be joined: {str(error).splitlines()[0]}") from error
    jax.config.update("jax_enable_compilation_cache", False)
    _check_devices([device.process_index for device in jax.devices()], jax.process_count())


def _check_devices(owners: Sequence[int], count: int) -> None:
    """Raise UserError where the `count` processes have different numbers of devices: none could exchange anything.

    `owners` has the process of each device. All processes know the devices of all.
    """
    numbers = [owners.count(process) for process in range(count)]
    if others := [f"process {i} has {number}" for i, number in enumerate(numbers) if number != numbers[0]]:
        raise UserError(
            f"the processes have different numbers of devices: process 0 has {numbers[0]}, {', '.join(others)}; give "
            "all as many (CUDA_VISIBLE_DEVICES or JAX_LOCAL_DEVICE_IDS choose them)"
        )


def process_count() -> int:
    """Return the number of processes that work together; 1 inside `apart`."""
    return 1 if _apart.get() else jax.process_count()


def is_first() -> bool:
    """Return whether this process reads and writes the run folder."""
    # A process that joined no others is the first. JAX is not asked then: it would look for its devices, whose settings
    # may still come.
    return not jax.distributed.is_initialized() or jax.process_index() == 0


@contextlib.contextmanager
def apart() -> Iterator[None]:
    """Let this process work alone inside the block, on its first device; the others do not run the block."""
    token = _apart.set(True)
    try:
        yield
    finally:
        _apart.reset(token)


def from_first(make: Callable[[], T]) -> T:
    """Call `make` in the first process and return its result, plain JSON, in all; an error is raised in all."""
    if process_count() == 1:
        return make()
    answer: dict[str, Any] = {}
    error: Exception | None = None
    if is_first():
        try:
            answer = {"value": make()}
        except Exception as caught:
            answer, error = {"error": _in_words(caught)}, caught
    answer = json.loads(_sent(json.dumps(answer).encode()))
    if "error" in answer:
        raise _own(error) or AgreedError(answer["error"])
    return answer["value"]


@contextlib.contextmanager
def agreed() -> Iterator[None]:
    """Raise an error of one process inside the block in all processes, at the end of the block.

    The processes wait for each other there; the block itself may not wait for other processes.
    """
    if process_count() == 1:
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
    message = _sent(b"" if error is None else _in_words(error).encode(), source=number).decode()
    raise _own(error) or AgreedError(f"process {number}: {message}")


@contextlib.contextmanager
def leaving() -> Iterator[None]:
    """End this process at once after an error inside the block that is not agreed between the processes.

    A normal exit would wait for the others, which wait for this process's part of the next step.
    """
    try:
        yield
    except AgreedError:
        raise
    except Exception as error:
        if process_count() == 1:
            raise
        if isinstance(error, UserError):
            print(f"tflane: {error}", file=sys.stderr)
        else:
            traceback.print_exc()
        end_alone(2 if isinstance(error, UserError) else 1)
    except KeyboardInterrupt as error:
        end_alone(128 + getattr(error, "number", signal.SIGINT))
        raise


def end_alone(code: int) -> None:
    """End this process at once if it is one of several, which wait for it: JAX ends them. No-op for a single one."""
    if process_count() > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _own(error: Exception | None) -> Exception | None:
    """Return the error that its own process raises: an agreed one for a user's error."""
    return AgreedError(str(error)) if isinstance(error, UserError) else error


def _in_words(error: Exception) -> str:
    return str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"


def arrays_from_first(make: Callable[[], T], like: T) -> T:
    """Call `make` in the first process and return its tree of arrays in all; an error is raised in all.

    Args:
        make: returns the arrays.
        like: a tree of the same structure, shapes and types.
    """
    if process_count() == 1:
        return make()
    held = like

    def hold() -> None:
        nonlocal held
        held = make()

    from_first(hold)
    return _broadcast(held)


def all_texts(text: str) -> list[str]:
    """Return the texts of all processes, in process order."""
    if process_count() == 1:
        return [text]
    from jax.experimental import multihost_utils

    own = np.frombuffer(text.encode(), np.uint8)
    sizes = np.asarray(multihost_utils.process_allgather(np.int32(len(own))))
    padded = np.zeros(sizes.max(), np.uint8)
    padded[: len(own)] = own
    every = np.asarray(multihost_utils.process_allgather(padded))
    return [row[:size].tobytes().decode() for row, size in zip(every, sizes, strict=True)]


def all_rows(tree: Any) -> Any:
    """Return arrays (numpy) whose rows (leading axis) are divided among the processes as whole ones, in process order.

    They are exchanged as bytes, so that no type changes.
    """
    leaves, treedef = jax.tree.flatten(tree)
    if process_count() == 1 or not leaves:
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
    """Return the signal that stops the training after `step`, of this process or of any of several.

    Several processes exchange it every `AGREE_EVERY` steps, so that they do not wait for each other at every step.
    """
    if process_count() == 1:
        return signal
    if step % AGREE_EVERY:
        return None
    from jax.experimental import multihost_utils

    asked = int(np.max(multihost_utils.process_allgather(np.int32(signal or 0))))
    return asked or None


def _sent(text: bytes, source: int = 0) -> bytes:
    """Return the text of the process `source` in all processes."""
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
