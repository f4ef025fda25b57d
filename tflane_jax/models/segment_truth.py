"""LaneSegNet's targets as its denoising, proposals and loss take them: valid rows first, and as lanes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.datasets.segment_targets import Center, SegmentTargets, segment_targets
from tflane_jax.scene import Areas, LaneGraph

LANE, CROSSING = 0, 1
"""Classes of LaneSegNet's queries, `SegmentTargets.category`."""


def ordered_targets(segments: LaneGraph, areas: Areas, center: Center = "mean") -> SegmentTargets:
    """Return the targets of one example, valid rows first; padding may hold anything and is zero in the result."""
    targets = segment_targets(*jax.tree.map(jnp.asarray, (segments, areas)), center=center)
    order = jnp.argsort(~targets.valid, stable=True)
    rows = jax.tree.map(lambda leaf: leaf[order], targets)
    return rows.replace(successor=rows.successor[:, order])


def target_lines(targets: SegmentTargets) -> Float[Array, "*b n 3 p 3"]:
    """Return centerline, left and right boundary of every row, metres."""
    return jnp.stack([jnp.asarray(line) for line in (targets.points, targets.left, targets.right)], -3)


def target_lanes(targets: SegmentTargets) -> LaneGraph:
    """Return all rows, crossings too, as lanes that can be proposed and noised; visibility is unknown, 0."""
    nothing = jnp.zeros(targets.valid.shape)
    return LaneGraph(
        points=targets.points,
        left=targets.left,
        right=targets.right,
        left_type=targets.left_type,
        right_type=targets.right_type,
        is_connector=nothing.astype(bool),
        visibility=nothing,
        successor=targets.successor,
        valid=targets.valid,
    )
