"""Lane segments and pedestrian crossings as the rows that LaneSegNet learns: two classes in one list.

Source: the dataset class of LaneSegNet, https://github.com/OpenDriveLab/LaneSegNet.
"""

from __future__ import annotations

from typing import Literal

from flax import struct
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry.namespace import namespace
from tflane_jax.scene import Areas, AreaType, LaneGraph, LineType
from tflane_jax.scene.arrays import Array

Center = Literal["mean", "annotated"]


@struct.dataclass
class SegmentTargets:
    """N lane segments, then A areas, of which the crossings are valid; padding is zero.

    Attributes:
        points, left, right: (N + A, P, 3) centerline and boundaries, metres, ego frame.
        category: (N + A,) 0 lane segment, 1 pedestrian crossing.
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
        category=xp.pad(xp.zeros(count, "int32"), (0, len(crossing)), constant_values=1),
        left_type=typed(segments.left_type),
        right_type=typed(segments.right_type),
        successor=xp.pad(segments.successor, (0, len(crossing))) & is_lane[:, None] & is_lane[None],
        valid=valid,
    )
