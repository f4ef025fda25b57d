"""Geometry of an intersection: stop distances of its arms, kerb roundings and pedestrian crossings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tflane_jax.world.roads.curves import blend, cross, direction, fillet, right_of

# Above this angle between neighbouring arms their kerbs are joined by a smooth curve, without a corner.
_NO_CORNER = np.deg2rad(155.0)
# Between the kerb rounding and the crossing, and between the crossing and the stop line, metres.
_CLEARANCE = 0.8
_STOP_LINE_GAP = 1.2


@dataclass(frozen=True)
class Arm:
    """A street where it meets an intersection, seen from the intersection.

    Attributes:
        origin: a point of the street's axis near the middle of the intersection, metres.
        heading: outwards, radians.
        left: distance from the axis to the kerb beside the traffic that comes in (on the left, looking outwards).
        right: distance from the axis to the kerb beside the traffic that goes out.
        crossing: width of the pedestrian crossing along the road, 0 without one, metres.
    """

    origin: Float[np.ndarray, "2"]
    heading: float
    left: float
    right: float
    crossing: float

    def kerb_corner(self, distance: float, side: float) -> Float[np.ndarray, "2"]:
        """Return the point at `distance` along the arm and `side` metres to its right (negative: left)."""
        return self.origin + distance * direction(self.heading) + side * right_of(self.heading)


def stop_distances(arms: Sequence[Arm], radius: float) -> Float[np.ndarray, " arms"]:
    """Return the distance from each arm's origin to its stop line, which leaves room for roundings and crossings.

    Args:
        arms: in counter-clockwise order.
        radius: of the kerb roundings, metres.
    """
    room = np.full(len(arms), 4.0)
    for i, arm in enumerate(arms):
        j = (i + 1) % len(arms)
        gap = _gap(arm, arms[j])
        if gap < _NO_CORNER:
            along, along_next = _kerbs_meet(arm, arms[j])
            rounding = radius / np.tan(gap / 2)
            room[i] = max(room[i], along + rounding)
            room[j] = max(room[j], along_next + rounding)
    crossings = np.array([arm.crossing for arm in arms])
    return room + np.where(crossings > 0, _CLEARANCE + crossings, 0.0) + _STOP_LINE_GAP


def kerb_corners(
    arms: Sequence[Arm], distances: Float[np.ndarray, " arms"], radius: float
) -> list[Float[np.ndarray, "n 2"]]:
    """Return for each arm the kerb from its incoming lanes around the corner to the next arm's outgoing lanes.

    The first and last points lie on the two kerbs at the arms' stop distances.
    """
    corners = []
    for i, arm in enumerate(arms):
        j = (i + 1) % len(arms)
        start = arm.kerb_corner(distances[i], -arm.left)
        stop = arms[j].kerb_corner(distances[j], arms[j].right)
        if _gap(arm, arms[j]) < _NO_CORNER:
            along, _ = _kerbs_meet(arm, arms[j])
            arc = fillet(arm.kerb_corner(along, -arm.left), arm.heading, arms[j].heading, radius)
            corners.append(np.concatenate([start[None], arc, stop[None]]))
        else:
            count = max(int(np.linalg.norm(stop - start) / 1.5), 4)
            headings = np.array([arm.heading + np.pi]), np.array([arms[j].heading])
            corners.append(blend(start[None], headings[0], stop[None], headings[1], count)[0][0])
    return corners


def radius_beyond(arm: Arm, following: Arm, normal: Float[np.ndarray, "2"], distance: float) -> float:
    """Return the radius with which the rounded corner between two arms just stays beyond a line.

    Args:
        arm, following: neighbours in counter-clockwise order, both on the far side of the line.
        normal: of the line, towards them.
        distance: of the line from the origin of coordinates, metres.
    """
    half = 0.5 * _gap(arm, following)
    corner = arm.kerb_corner(_kerbs_meet(arm, following)[0], -arm.left)
    # The rounding ends this much farther out than the corner, for each metre of radius.
    gained = (1.0 / np.sin(half) - 1.0) * float(direction(arm.heading + half) @ normal)
    return (distance - float(corner @ normal)) / gained


def crossing_ring(arm: Arm, distance: float) -> Float[np.ndarray, "5 2"]:
    """Return the closed ring of the pedestrian crossing in front of the arm's stop line: two kerb-to-kerb edges.

    Args:
        arm: with a crossing.
        distance: the arm's stop distance, metres.
    """
    outer = distance - _STOP_LINE_GAP
    inner = outer - arm.crossing
    a0, a1 = arm.kerb_corner(inner, arm.right), arm.kerb_corner(inner, -arm.left)
    b0, b1 = arm.kerb_corner(outer, arm.right), arm.kerb_corner(outer, -arm.left)
    return np.stack([a0, a1, b1, b0, a0])


def crossing_walk(ring: Float[np.ndarray, "5 2"], beyond: float) -> Float[np.ndarray, "2 2"]:
    """Return the middle line of a crossing, lengthened by `beyond` metres behind both kerbs."""
    start, stop = 0.5 * (ring[0] + ring[3]), 0.5 * (ring[1] + ring[2])
    along = (stop - start) / np.linalg.norm(stop - start)
    return np.stack([start - beyond * along, stop + beyond * along])


def _gap(arm: Arm, following: Arm) -> float:
    """Return the counter-clockwise angle from one arm to the next, in (0, 2 pi)."""
    return float((following.heading - arm.heading) % (2 * np.pi))


def _kerbs_meet(arm: Arm, following: Arm) -> tuple[float, float]:
    """Return the distances along both arms at which their facing kerb lines cross."""
    u, v = direction(arm.heading), direction(following.heading)
    d = following.kerb_corner(0.0, following.right) - arm.kerb_corner(0.0, -arm.left)
    # arm kerb + a u = following kerb + b v
    sine = cross(u, v)
    return float(cross(d, v) / sine), float(cross(d, u) / sine)
