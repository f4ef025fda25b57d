"""LaneSegNet's targets as its denoising, proposals and loss take them: valid rows first, and as lanes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.datasets.segment_targets import Center, SegmentTargets, segment_targets
from tflane_jax.scene import Areas, LaneGraph

LANE, CROSSING = 0, 1
"""Classes of LaneSegNet's queries, `SegmentTargets.category`."""


def ordered_targets(segments: LaneGraph, areas: Areas, center: Center = "mean", classes: int = 2) -> SegmentTargets:
    """Return the targets of one example, valid rows first; padding may hold anything and is zero in the result.

    Args:
        segments, areas, center: see `segment_targets`.
        classes: 2 with crossings, 1 without.
    """
    if classes == 1:
        areas = Areas.empty(0, 2 * segments.points.shape[1])
    targets = segment_targets(*jax.tree.map(jnp.asarray, (segments, areas)), center=center)
    order = _order(targets.valid)
    rows = jax.tree.map(lambda leaf: leaf[order], targets)
    return rows.replace(successor=rows.successor[:, order])


def governed_rows(segments: LaneGraph, governed: Bool[Array, "n e"], rows: int) -> Bool[Array, "rows e"]:
    """Return which elements govern each of the `rows` targets of `ordered_targets`; none governs a crossing.

    Args:
        segments: as of `ordered_targets`.
        governed: which elements govern each segment.
        rows: number of targets, segments and areas.
    """
    count = len(segments.valid)
    lane = jnp.asarray(segments.valid)[:, None] & governed
    padded = jnp.pad(lane, ((0, rows - count), (0, 0)))
    # Lanes come first among the valid rows, so that their order needs no areas.
    return padded[_order(jnp.pad(jnp.asarray(segments.valid), (0, rows - count)))]


def _order(valid: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Return the rows, valid ones first."""
    return jnp.argsort(~valid, stable=True)


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
