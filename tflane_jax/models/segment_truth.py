"""Lane segments and pedestrian crossings as LaneSegNet learns them: two classes in one list, valid rows first.

Denoising, proposals and loss take these rows, as targets or as lanes.

Source: the dataset class of LaneSegNet, https://github.com/OpenDriveLab/LaneSegNet.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry.namespace import namespace
from tflane_jax.scene import Areas, AreaType, LaneGraph, LineType
from tflane_jax.scene.arrays import Array

Center = Literal["mean", "annotated"]
LANE, CROSSING = 0, 1
"""Classes of LaneSegNet's queries, `SegmentTargets.category`."""


@struct.dataclass
class SegmentTargets:
    """N lane segments, then A areas, of which the crossings are valid; padding is zero.

    Attributes:
        points, left, right: (N + A, P, 3) centerline and boundaries, metres, ego frame.
        category: (N + A,) `LANE` or `CROSSING`.
        left_type, right_type: (N + A,) `LineType`; NONE for crossings.
        successor: (N + A, N + A) [i, j] segment j continues segment i; crossings have no edges.
        valid: (N + A,).
    """

    points: Float[Array, "n p 3"]
    left: Float[Array, "n p 3"]
    right: Float[Array, "n p 3"]
    category: Int[Array, " n"]
    left_type: Int[Array, " n"]
    right_type: Int[Array, " n"]
    successor: Bool[Array, "n n"]
    valid: Bool[Array, " n"]


def segment_targets(segments: LaneGraph, areas: Areas, *, center: Center = "mean") -> SegmentTargets:
    """Return the rows of one example, numpy or jax.

    The first half of a crossing's points is its left side, the second half its reversed right side: the form of
    `ExampleConfig.crossings = "sides"`. Of a ring, they are its two halves.

    Args:
        segments: lane segments of P points.
        areas: of 2 P points; only crossings become rows.
        center: "mean" of the boundaries, point by point, as the reference learns; or the annotated centerline. The
            center of a crossing is always the mean.

    Raises:
        ValueError: areas do not have twice as many points as segments.
    """
    count, points = segments.points.shape[:2]
    if areas.points.shape[0] and areas.points.shape[1] != 2 * points:
        raise ValueError(f"areas have {areas.points.shape[1]} points, expected 2 x {points}, twice those of segments")
    xp = namespace(segments.points, areas.points)
    sides = areas.points.reshape(-1, 2, points, 3)
    left = xp.concatenate([segments.left, sides[:, 0]])
    right = xp.concatenate([segments.right, sides[:, 1, ::-1]])
    crossing = areas.valid & (areas.category == AreaType.PEDESTRIAN_CROSSING)
    valid = xp.concatenate([segments.valid, crossing])
    left, right = (xp.where(valid[:, None, None], line, 0.0) for line in (left, right))
    middle = 0.5 * (left + right)
    if center == "annotated":
        lanes = xp.where(segments.valid[:, None, None], segments.points, 0.0)
        middle = xp.concatenate([lanes, middle[count:]])
    is_lane = xp.concatenate([segments.valid, xp.zeros_like(crossing)])

    def typed(types: Array) -> Array:
        return xp.where(is_lane, xp.pad(types, (0, len(crossing))), int(LineType.NONE))

    return SegmentTargets(
        points=middle,
        left=left,
        right=right,
        category=xp.pad(xp.zeros(count, "int32"), (0, len(crossing)), constant_values=CROSSING),
        left_type=typed(segments.left_type),
        right_type=typed(segments.right_type),
        successor=xp.pad(segments.successor, (0, len(crossing))) & is_lane[:, None] & is_lane[None],
        valid=valid,
    )


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
