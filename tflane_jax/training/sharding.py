"""The training state divided over devices: each holds its part of parameters, moving average and moments.

The loss needs all parameters, so an update begins by gathering them. Gradients are summed over the devices, and each
device then updates its own part. Matrices that Muon makes orthogonal are gathered with their momentum and updated on
every device: of those, only the storage is divided. Running statistics, counts and keys stay whole on every device.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
from jax import lax
from jax.sharding import Mesh

from tflane_jax.devices import everywhere, in_parts, replicated, spread
from tflane_jax.training.vectors import Vectors


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
        if not _is_vectors(node):
            return replicated(node, mesh)
        return jax.tree.map(lambda vector: spread(vector, mesh), node.padded(mesh.size))

    return jax.tree.map(place, state, is_leaf=_is_vectors)


@dataclass(frozen=True)
class Division:
    """Where an update computes; without a mesh, nothing here changes anything.

    Attributes:
        mesh: of the devices that share the state; None if it is not divided.
        whole_groups: groups of `Vectors` whose update needs whole matrices.
    """

    mesh: Mesh | None = None
    whole_groups: tuple[str, ...] = ()

    def gathered(self, vectors: Vectors) -> Vectors:
        """Return vectors that are whole on every device."""
        return self._put(vectors, lambda group: True)

    def for_update(self, tree: Any) -> Any:
        """Return gradients, or the state of an optimiser, where their update is computed."""
        return self._put(tree, lambda group: group in self.whole_groups)

    def at_rest(self, tree: Any) -> Any:
        """Return a state or metrics where they are between updates: vectors in parts, all else on every device."""
        return self._put(tree, lambda group: False)

    def _put(self, tree: Any, is_whole: Callable[[str], bool]) -> Any:
        if (mesh := self.mesh) is None:
            return tree
        whole, parts = everywhere(mesh), in_parts(mesh)

        def put(node: Any) -> Any:
            if not _is_vectors(node):
                return lax.with_sharding_constraint(node, whole)
            return node.map(
                lambda group, value: jax.tree.map(
                    lambda vector: lax.with_sharding_constraint(vector, whole if is_whole(group) else parts), value
                )
            )

        return jax.tree.map(put, tree, is_leaf=_is_vectors)


def _is_vectors(node: Any) -> bool:
    return isinstance(node, Vectors)
