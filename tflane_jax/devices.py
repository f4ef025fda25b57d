"""Data parallelism: each batch is divided among the devices by examples; every device holds the parameters.

With `training.shard_state` it holds a part of them (`training.sharding`).

A program stays one program over all devices of all processes (GSPMD): XLA divides the work on single examples, and adds
up gradients and batch statistics. A loss is therefore that of the whole batch, and equal on one device and on many up
to rounding. With one device nothing here changes anything.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from tflane_jax import processes
from tflane_jax.errors import UserError

DATA_AXIS = "data"
"""Axis of the mesh that divides a batch."""

_OTHER_BATCH = " (--training.same-examples divides the steps as the batch grows)"


def training_mesh(batch_size: int, accumulate: int = 1) -> Mesh | None:
    """Return the mesh over all devices of all processes; None if there is one device.

    Raises UserError if the devices cannot share each of the `accumulate` parts of a batch evenly.
    """
    devices = jax.device_count()
    if accumulate > 1 and batch_size % (devices * accumulate):
        shared = "" if devices == 1 else f" times {devices} devices"
        raise UserError(
            f"training.batch_size is {batch_size}, which {accumulate} parts (training.accumulate){shared} cannot share "
            f"evenly: choose a multiple of {devices * accumulate}{_OTHER_BATCH}"
        )
    if batch_size % devices:
        raise UserError(
            f"training.batch_size is {batch_size}, which {devices} devices cannot share evenly: "
            f"choose a multiple of {devices}{_OTHER_BATCH}"
        )
    return prediction_mesh(batch_size)


def prediction_mesh(batch_size: int) -> Mesh | None:
    """Return the mesh over all devices; None if there is one, or if they cannot share a batch evenly.

    A process that works `apart` from the others has no mesh either.
    """
    devices = jax.devices()
    if len(devices) == 1 or batch_size % len(devices) or processes.process_count() < jax.process_count():
        return None
    return Mesh(np.array(devices), (DATA_AXIS,), axis_types=(AxisType.Auto,))


def active(mesh: Mesh | None) -> contextlib.AbstractContextManager[Any]:
    """Return a context in which programs for `mesh` are traced."""
    return contextlib.nullcontext() if mesh is None else jax.set_mesh(mesh)


def everywhere(mesh: Mesh | None) -> NamedSharding | None:
    """Return the sharding of arrays that are whole on every device; None for the default device."""
    return None if mesh is None else NamedSharding(mesh, PartitionSpec())


def in_parts(mesh: Mesh) -> NamedSharding:
    """Return the sharding that splits the leading axis over the devices."""
    return NamedSharding(mesh, PartitionSpec(DATA_AXIS))


def replicated(tree: Any, mesh: Mesh | None) -> Any:
    """Put a tree that every process holds on every device; on the default device for None."""
    if jax.device_count() == 1:
        return jax.device_put(tree)
    return jax.tree.map(lambda leaf: _put(leaf, everywhere(mesh)), tree)


def _put(leaf: Any, sharding: NamedSharding | None) -> Any:
    if sharding is not None and isinstance(leaf, jax.Array) and leaf.sharding == sharding:
        return leaf
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_put(jax.random.key_data(leaf), sharding))
    host = np.asarray(gathered(leaf))  # the array may be on all devices
    return jax.device_put(host) if sharding is None else jax.make_array_from_process_local_data(sharding, host)


def made_on_host(make: Callable[[], Any]) -> Any:
    """Return the arrays that a function makes, computed on the host and put on the default device.

    For programs that run once, and whose compiling for an accelerator takes far longer than they do. Where the CPU is
    the default backend, or JAX_PLATFORMS names the accelerator alone, the function is only called.
    """
    if jax.default_backend() == "cpu":
        return make()
    try:
        host = jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return make()
    with jax.default_device(host):
        made = make()
    return jax.tree.map(lambda leaf: _put(leaf, None), made)


def spread(leaf: Any, mesh: Mesh) -> jax.Array:
    """Put an array, held whole by every process or spread before, on the devices in equal parts."""
    if isinstance(leaf, jax.Array) and leaf.sharding == in_parts(mesh):
        return leaf
    host = np.asarray(gathered(leaf))
    return jax.make_array_from_callback(host.shape, in_parts(mesh), lambda part: host[part])


def gathered(tree: Any) -> Any:
    """Return arrays that are in parts on several devices as whole ones on each of them; others stay."""

    def whole(leaf: Any) -> Any:
        where = leaf.sharding if isinstance(leaf, jax.Array) else None
        if not isinstance(where, NamedSharding) or where.is_fully_replicated:
            return leaf
        return _on_every_device(leaf, where.mesh)

    return jax.tree.map(whole, tree)


@functools.partial(jax.jit, static_argnums=1)
def _on_every_device(leaf: jax.Array, mesh: Any) -> jax.Array:
    return lax.with_sharding_constraint(leaf, everywhere(mesh))


def of_one_process(tree: Any) -> Any:
    """Return a tree that is on every device, whole or in parts, so that one process alone can save it.

    Of several processes, each gets arrays of its host: a state that is in parts may not fit on one device.
    """
    return tree if processes.process_count() == 1 else jax.tree.map(_on_host, tree)


def _on_host(leaf: Any) -> Any:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_on_host(jax.random.key_data(leaf)))
    return np.asarray(gathered(leaf))


def divided(rows: Any, mesh: Mesh | None) -> Any:
    """Put a batch on the devices, divided along the leading axis.

    Args:
        rows: the examples of this process's own devices (`share`).
        mesh: None for one device.
    """
    if mesh is None:
        return jax.device_put(rows)
    parts = in_parts(mesh)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(parts, np.asarray(leaf)), rows)


def share(mesh: Mesh | None) -> tuple[int, int]:
    """Return (index, count) of this process among those that divide every batch."""
    return (0, 1) if mesh is None else (jax.process_index(), jax.process_count())
