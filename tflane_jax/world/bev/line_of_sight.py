"""Occlusion: line of sight from a sensor past boxes and buildings on flat ground (2.5-D).

A straight ray from the sensor to a target point is blocked if it passes through the volume of a box. A ray may pass
over the roof of a low box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import wrap_angle

# Widens each angular interval of the prefilter so that rounding never drops a pair; the exact test decides.
_ANGLE_MARGIN = 1e-9
# Replaces a zero component of a ray direction: far smaller than any real one, and its inverse is finite.
_NO_DIRECTION = 1e-30


@dataclass(frozen=True)
class Directions:
    """Points sorted by direction from the sensor.

    Attributes:
        order: (2 n,) point numbers by direction, twice.
        angle: (2 n,) their directions over two turns, ascending, radians.
        radius: (n,) distance of each point, metres.
    """

    order: Int[np.ndarray, " m"]
    angle: Float[np.ndarray, " m"]
    radius: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 2"]) -> Directions:
        """Sort points."""
        angle = np.arctan2(points[:, 1], points[:, 0])
        order = np.argsort(angle)
        # Two turns, so that an interval across +-pi is one slice as well.
        turns = np.concatenate([angle[order], angle[order] + 2 * np.pi])
        return cls(np.concatenate([order, order]), turns, np.hypot(points[:, 0], points[:, 1]))


def hidden_points(
    points: Float[np.ndarray, "n 2"],
    boxes: Float[np.ndarray, "k 7"],
    buildings: Float[np.ndarray, "b 5"],
    *,
    sensor_height: float = 1.8,
    target_height: float | Float[np.ndarray, " n"] = 0.0,
    exclude: Int[np.ndarray, " n"] | None = None,
    directions: Directions | None = None,
) -> Bool[np.ndarray, " n"]:
    """Return which points the sensor at (0, 0, `sensor_height`) cannot see.

    A point is hidden if the open segment from the sensor to it passes through the inside of an occluder;
    grazing a face does not hide. Ground inside a box's footprint is therefore hidden by that box. An occluder
    whose footprint holds the sensor is the ego vehicle itself and hides nothing.

    Args:
        points: x, y in the ego frame, metres.
        boxes: rows x, y, length, width, yaw, height, base_z (center in x and y; base_z is the underside).
        buildings: rows x, y, length, width, yaw; opaque from the ground to any height.
        sensor_height: metres above the ground.
        target_height: height of the points, a scalar or one value per point.
        exclude: for each point the row of `boxes` that must not hide it (the actor's own box); any other number
            excludes nothing.
        directions: `Directions.of(points)`, if the same points are tested repeatedly.
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    occluders = _occluders(boxes, buildings)
    pair_point, pair_box = _pairs_in_angle(Directions.of(points) if directions is None else directions, occluders)
    if exclude is not None:
        keep = np.asarray(exclude)[pair_point] != pair_box
        pair_point, pair_box = pair_point[keep], pair_box[keep]
    heights = np.broadcast_to(np.asarray(target_height, np.float64), len(points))
    target = np.concatenate([points, heights[:, None]], -1)
    blocked = _ray_meets_box(target[pair_point], occluders[pair_box], sensor_height)
    hidden = np.zeros(len(points), bool)
    hidden[pair_point[blocked]] = True
    return hidden


def occluders_from(boxes: Float[np.ndarray, "k 7"], eye: Float[np.ndarray, "_"]) -> Float[np.ndarray, "k 7"]:
    """Return boxes as `hidden_points` takes them, with x and y relative to those of an eye.

    Args:
        boxes: rows x, y, length, width, yaw, low z, high z.
        eye: x, y (and z, which is not used).
    """
    x, y, length, width, yaw, low, high = boxes.T
    return np.stack([x - eye[0], y - eye[1], length, width, yaw, high - low, low], -1)


def _occluders(boxes: np.ndarray, buildings: np.ndarray) -> Float[np.ndarray, "o 7"]:
    """Return boxes then buildings as rows x, y, length, width, yaw, low z, high z."""
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    buildings = np.asarray(buildings, np.float64).reshape(-1, 5)
    base, height = boxes[:, 6:7], boxes[:, 5:6]
    low_high = np.concatenate([base, base + height], -1)
    unlimited = np.broadcast_to([-np.inf, np.inf], (len(buildings), 2))
    return np.concatenate([np.concatenate([boxes[:, :5], low_high], -1), np.concatenate([buildings, unlimited], -1)])


def _pairs_in_angle(points: Directions, occluders: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (point, occluder) index pairs in which the occluder may hide the point.

    Seen from the origin a convex footprint covers one interval of directions below half a turn, so sorting
    the points by direction turns "which points lie behind this box" into one slice for each box.
    """
    x, y, length, width, yaw = occluders[:, :5].T
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], -1)
    center = np.stack([x, y], -1)
    along, across = (center * ahead).sum(-1), (center * left).sum(-1)
    around_ego = (np.abs(along) < length / 2) & (np.abs(across) < width / 2)

    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    corners = (
        center[:, None]
        + (signs[:, :1] * length[:, None, None]) * ahead[:, None]
        + (signs[:, 1:] * width[:, None, None]) * left[:, None]
    )
    middle = np.arctan2(y, x)
    offset = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    offset = wrap_angle(offset)
    low = wrap_angle(middle + offset.min(-1) - _ANGLE_MARGIN)
    span = offset.max(-1) - offset.min(-1) + 2 * _ANGLE_MARGIN

    first = np.searchsorted(points.angle, low, side="left")
    count = np.where(around_ego, 0, np.searchsorted(points.angle, low + span, side="right") - first)
    box = np.repeat(np.arange(len(occluders)), count)
    within = np.arange(len(box)) - np.repeat(np.cumsum(count) - count, count)
    point = points.order[first[box] + within]

    nearest = np.hypot(x, y) - np.hypot(length, width) / 2
    behind = points.radius[point] > nearest[box]
    return point[behind], box[behind]


def _ray_meets_box(target: np.ndarray, box: np.ndarray, sensor_height: float) -> Bool[np.ndarray, " p"]:
    """Return, pair by pair, whether the open segment from sensor to target crosses the box (slab test)."""
    cos, sin = np.cos(box[:, 4]), np.sin(box[:, 4])
    starts = (-(cos * box[:, 0] + sin * box[:, 1]), sin * box[:, 0] - cos * box[:, 1], sensor_height)
    steps = (
        cos * target[:, 0] + sin * target[:, 1],
        cos * target[:, 1] - sin * target[:, 0],
        target[:, 2] - sensor_height,
    )
    slabs = ((-box[:, 2] / 2, box[:, 2] / 2), (-box[:, 3] / 2, box[:, 3] / 2), (box[:, 5], box[:, 6]))
    enter, leave = np.zeros(len(box)), np.ones(len(box))
    for start, step, (low, high) in zip(starts, steps, slabs, strict=True):
        inverse = 1.0 / np.where(step == 0.0, _NO_DIRECTION, step)
        a, b = (low - start) * inverse, (high - start) * inverse
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    return enter < leave
