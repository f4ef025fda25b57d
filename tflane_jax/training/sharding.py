"""The training state divided over devices: each holds its part of parameters, moving average and moments.

The loss needs all parameters, so an update begins by gathering them. Gradients are summed over the devices, and each
device then updates its own part. What Muon makes orthogonal is gathered before, and every device makes all of it: of
those kernels only the storage is divided. Running statistics, counts and keys stay whole on every device.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
from jax import lax
from jax.sharding import Mesh

from tflane_jax.devices import everywhere, in_parts, replicated, spread
from tflane_jax.training.vectors import Vectors, is_vectors


def placed(state: Any, mesh: Mesh | None, *, shard: bool) -> Any:
    """Put a state, or a part of one, on the devices.

    Args:
        state: held whole by every process, or placed before.
        mesh: of the devices; None for one device.
        shard: divide its `Vectors` over the devices, with rows of zeros at their ends where needed; else all of it is
            on every device.
    """
    if mesh is None or not shard:
        return replicated(state, mesh)

    def place(node: Any) -> Any:
        if not is_vectors(node):
            return replicated(node, mesh)
        return jax.tree.map(lambda vector: spread(vector, mesh), node.padded(mesh.size))

    return jax.tree.map(place, state, is_leaf=is_vectors)


def laid_out(state: Any, mesh: Mesh, *, shard: bool) -> Any:
    """Return shapes and shardings of a state, given by its shapes, as `placed` puts it on the devices."""

    def shapes(node: Any) -> Any:
        divided = shard and is_vectors(node)
        node = jax.eval_shape(lambda vectors: vectors.padded(mesh.size), node) if divided else node
        where = in_parts(mesh) if divided else everywhere(mesh)
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), node)

    return jax.tree.map(shapes, state, is_leaf=is_vectors)


@dataclass(frozen=True)
class Division:
    """Where the arrays of an update are; without a mesh, nothing here changes anything.

    Attributes:
        mesh: of the devices that share the state; None if each has all of it.
    """

    mesh: Mesh | None = None

    def gathered(self, vectors: Vectors) -> Vectors:
        """Return vectors that are whole on every device."""
        return vectors if self.mesh is None else lax.with_sharding_constraint(vectors, everywhere(self.mesh))

    def at_rest(self, tree: Any) -> Any:
        """Return arrays as they are between updates: `Vectors` in parts, all else whole on every device."""
        if (mesh := self.mesh) is None:
            return tree

        def put(node: Any) -> Any:
            return lax.with_sharding_constraint(node, in_parts(mesh) if is_vectors(node) else everywhere(mesh))

        return jax.tree.map(put, tree, is_leaf=is_vectors)
