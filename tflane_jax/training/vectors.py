"""Learned parameters as a few long vectors, each updated by one fused operation.

A small model has 300 leaves. Guard, clipping, moments, decay and average of every leaf apart are thousands of
operations that take a third of a step; on vectors they are a few dozen. Users and checkpoints see trees.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.errors import UserError

ROW = 64
"""Every leaf begins a new row of this many numbers; zeros fill its last row."""


@dataclass(frozen=True)
class Place:
    """Where a leaf lies: the first row in the vector of its group, and its shape."""

    group: str
    row: int
    shape: tuple[int, ...]

    @functools.cached_property
    def size(self) -> int:
        """Return how many numbers it has."""
        return int(np.prod(self.shape))

    @functools.cached_property
    def rows(self) -> int:
        """Return how many rows it takes."""
        return -(-self.size // ROW)


@dataclass(frozen=True)
class Stack:
    """Kernels of one shape (inputs x outputs) that follow each other in a vector."""

    row: int
    count: int
    shape: tuple[int, int]

    @property
    def rows(self) -> int:
        """Return how many rows each kernel takes."""
        return -(-self.shape[0] * self.shape[1] // ROW)


@dataclass(frozen=True)
class Layout:
    """Where every leaf of a tree lies: static, and equal for equal trees.

    Attributes:
        treedef: of the tree.
        places: of the leaves, in the order of the tree.
        multiple: the rows of every vector are a multiple of this; rows of zeros follow the leaves where needed.
    """

    treedef: Any
    places: tuple[Place, ...]
    multiple: int = 1

    def members(self, group: str) -> list[int]:
        """Return the leaves of a group, by their number in the tree, in the order of its vector."""
        members = [i for i, place in enumerate(self.places) if place.group == group]
        return sorted(members, key=lambda i: self.places[i].row)

    def tail(self, group: str) -> int:
        """Return how many rows of zeros follow the leaves of a group."""
        return -max(place.row + place.rows for place in self.places if place.group == group) % self.multiple

    def stacks(self, group: str) -> list[Stack]:
        """Return the kernels of a group as stacks of matrices; those without numbers are left out."""
        places = [self.places[i] for i in self.members(group) if self.places[i].size]
        runs = [list(run) for _, run in itertools.groupby(places, lambda place: matrix_shape(place.shape))]
        return [Stack(run[0].row, len(run), matrix_shape(run[0].shape)) for run in runs]


@struct.dataclass
class Vectors:
    """A tree of parameters, gradients or moments as one vector for each group.

    Attributes:
        groups: group -> (..., n) numbers of its leaves. The groups are "dense" and "convolution" (kernels), "other"
            (further matrices) and "plain" (what has no weight decay: biases and norms). A group without leaves is
            absent; in the state of an optimizer for other groups it is an `optax.MaskedNode`.
        layout: where each leaf lies.
    """

    groups: dict[str, Any]
    layout: Layout = struct.field(pytree_node=False)

    def tree(self) -> Any:
        """Return the tree; leading axes of the vectors lead every leaf, masked groups have masked leaves."""
        return jax.tree.unflatten(self.layout.treedef, [self._leaf(place) for place in self.layout.places])

    def _leaf(self, place: Place) -> Any:
        vector = self.groups[place.group]
        if isinstance(vector, optax.MaskedNode):
            return vector
        first = place.row * ROW
        return vector[..., first : first + place.size].reshape((*vector.shape[:-1], *place.shape))

    def map(self, function: Callable[[str, Any], Any]) -> Vectors:
        """Return other values, from (group, value) of each group."""
        return Vectors({group: function(group, value) for group, value in self.groups.items()}, self.layout)

    def padded(self, multiple: int) -> Vectors:
        """Return the vectors of a layout with `multiple`; this one has it already, or none (1)."""
        if self.layout.multiple == multiple:
            return self
        assert self.layout.multiple == 1
        layout = replace(self.layout, multiple=multiple)

        def longer(group: str, vector: Any) -> Any:
            if isinstance(vector, optax.MaskedNode) or not (tail := layout.tail(group)):
                return vector
            pad = np.pad if isinstance(vector, np.ndarray) else jnp.pad
            return pad(vector, ((0, 0),) * (vector.ndim - 1) + ((0, tail * ROW),))

        return Vectors({group: longer(group, vector) for group, vector in self.groups.items()}, layout)


def layout_of(params: Any) -> Layout:
    """Return the layout for a tree of learned parameters, in which kernels of one shape follow each other.

    Raises UserError if a leaf is not float32.
    """
    paths, treedef = jax.tree_util.tree_flatten_with_path(params)
    for path, leaf in paths:
        if leaf.dtype != np.float32:
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise UserError(
                f"the model's parameter {name} is {leaf.dtype}, and learned parameters are float32: give its module "
                "param_dtype float32 (its dtype may be another one), or make a constant an attribute of the module"
            )
    groups = [_group(path, leaf) for path, leaf in paths]
    places = [Place(group, 0, tuple(leaf.shape)) for group, (_, leaf) in zip(groups, paths, strict=True)]
    ends = dict.fromkeys(groups, 0)
    for i in sorted(range(len(places)), key=lambda i: matrix_shape(places[i].shape)):
        places[i] = Place(groups[i], ends[groups[i]], places[i].shape)
        ends[groups[i]] += places[i].rows
    return Layout(treedef, tuple(places))


def _group(path: tuple[Any, ...], leaf: Any) -> str:
    # Names beside ranks, because the biases of attention heads are matrices too.
    name = getattr(path[-1], "key", None)
    if leaf.ndim < 2 or name in ("bias", "scale"):
        return "plain"
    if name == "kernel" and leaf.ndim in (2, 4):
        return "dense" if leaf.ndim == 2 else "convolution"
    return "other"


def matrix_shape(shape: Sequence[int]) -> tuple[int, int]:
    """Return the shape of a kernel as a matrix: inputs (of a convolution: kh kw cin) x outputs."""
    return int(np.prod(shape[:-1])), shape[-1] if shape else 1


def ravel(tree: Any, layout: Layout) -> Vectors:
    """Return a tree (numpy or JAX) as vectors; leading axes that all leaves have beyond the layout's lead them."""
    leaves = layout.treedef.flatten_up_to(tree)
    groups: dict[str, Any] = {}
    for group in sorted({place.group for place in layout.places}):
        members = layout.members(group)
        if isinstance(leaves[members[0]], optax.MaskedNode):
            groups[group] = leaves[members[0]]
            continue
        parts = []
        for i in members:
            leaf, place = leaves[i], layout.places[i]
            lead = leaf.shape[: leaf.ndim - len(place.shape)]
            parts.append(leaf.reshape(*lead, place.size))
            if missing := place.rows * ROW - place.size:
                parts.append(np.zeros((*lead, missing), np.float32))
        if tail := layout.tail(group):
            parts.append(np.zeros((*parts[0].shape[:-1], tail * ROW), np.float32))
        concatenate = jnp.concatenate if any(isinstance(part, jax.Array) for part in parts) else np.concatenate
        groups[group] = concatenate(parts, -1)
    return Vectors(groups, layout)


def norm(vectors: Vectors) -> Float[Array, ""]:
    """Return the Euclidean norm of all numbers."""
    squares = [jnp.square(vector.reshape(-1, ROW)).sum(0) for vector in jax.tree.leaves(vectors)]
    return jnp.sqrt(sum(squares, jnp.zeros(ROW)).sum())


def any_in_leaf(vector: Bool[Array, " n"], layout: Layout, group: str) -> Bool[Array, " n"]:
    """Return for each number of a group's vector whether any number of its leaf is True."""
    members = layout.members(group)
    leaf_of_row = np.repeat(np.arange(len(members)), [layout.places[i].rows for i in members]).astype(np.int32)
    leaf_of_row = np.pad(leaf_of_row, (0, layout.tail(group)), "edge")
    rows = vector.reshape(-1, ROW).any(1)
    leaves = jax.ops.segment_max(
        rows.astype(jnp.int32), leaf_of_row, num_segments=len(members), indices_are_sorted=True
    )
    return jnp.broadcast_to((leaves > 0)[leaf_of_row, None], (len(rows), ROW)).reshape(-1)


def is_vectors(node: Any) -> bool:
    """Return whether a node of a tree is `Vectors`."""
    return isinstance(node, Vectors)
