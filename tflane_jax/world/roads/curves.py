"""Plane curves for road layout: clothoid-like reference lines, kerb fillets and connector curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import wrap_angle

# Greatest distance between points of a rounded corner, metres.
_FILLET_SPACING = 0.8


def direction(heading: Float[np.ndarray, "*b"] | float) -> Float[np.ndarray, "*b 2"]:
    """Return the unit vector of a heading (radians)."""
    return np.stack([np.cos(heading), np.sin(heading)], -1)


def right_of(heading: Float[np.ndarray, "*b"] | float) -> Float[np.ndarray, "*b 2"]:
    """Return the unit vector that points to the right of a heading (radians)."""
    return np.stack([np.sin(heading), -np.cos(heading)], -1)


def cross(a: Float[np.ndarray, "*#b 2"], b: Float[np.ndarray, "*#b 2"]) -> Float[np.ndarray, "*#b"]:
    """Return the z component of the cross product of plane vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def smoothstep(u: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Return the cubic that rises from 0 to 1 on [0, 1] with flat ends, clamped outside."""
    u = np.clip(u, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


def grid_with(stations: Sequence[float], spacing: float) -> Float[np.ndarray, " n"]:
    """Return increasing stations at most `spacing` apart that contain every given station exactly."""
    stops = np.unique(np.asarray(stations, np.float64))
    stops = stops[np.concatenate([[True], np.diff(stops) > 1e-6])]
    pieces = [np.linspace(a, b, int(np.ceil((b - a) / spacing)), endpoint=False) for a, b in pairwise(stops)]
    return np.concatenate([*pieces, stops[-1:]])


@dataclass(frozen=True)
class ReferenceLine:
    """The sampled axis of a street, in one direction of travel.

    Attributes:
        s: (n,) station of each vertex, metres along the line.
        xy: (n, 2) metres.
        heading: (n,) radians.
    """

    s: Float[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    heading: Float[np.ndarray, " n"]

    @cached_property
    def right(self) -> Float[np.ndarray, "n 2"]:
        """Unit vectors to the right of travel."""
        return right_of(self.heading)

    def offset(self, distance: Float[np.ndarray, "*k n"] | float) -> Float[np.ndarray, "*k n 2"]:
        """Return the line shifted to the right by a distance that may vary along it (negative: to the left)."""
        return self.xy + np.asarray(distance)[..., None] * self.right

    def backward(self) -> ReferenceLine:
        """Return the same line driven the other way, with stations counted from its new start."""
        return ReferenceLine(self.s[-1] - self.s[::-1], self.xy[::-1], self.heading[::-1] + np.pi)

    def at(self, s: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Return positions and headings at stations, interpolated linearly between vertices."""
        xy = np.stack([np.interp(s, self.s, self.xy[:, i]) for i in range(2)], -1)
        return xy, np.interp(s, self.s, self.heading)


def clothoid_line(
    origin: Float[np.ndarray, "2"],
    heading: float,
    s: Float[np.ndarray, " n"],
    knots: Sequence[tuple[float, float]],
) -> ReferenceLine:
    """Return the line through `origin` with `heading` at s = 0 whose curvature is linear between knots.

    Args:
        origin: metres.
        heading: radians.
        s: increasing stations to sample.
        knots: (station, curvature 1/m); constant outside.
    """
    knot_s, knot_k = np.asarray(knots, np.float64).reshape(-1, 2).T
    # The grid of the integral contains s = 0, where position and heading are given.
    at_zero = np.searchsorted(s, 0.0)
    pinned = at_zero < len(s) and s[at_zero] == 0.0
    grid = s if pinned else np.insert(s, at_zero, 0.0)
    curvature = np.interp(grid, knot_s, knot_k)
    step = np.diff(grid)
    turn = np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * step)])
    angle = heading + turn - turn[at_zero]
    chord = direction(0.5 * (angle[1:] + angle[:-1])) * step[:, None]
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(chord, 0)])
    xy = origin + (xy - xy[at_zero])
    if not pinned:
        xy, angle = np.delete(xy, at_zero, 0), np.delete(angle, at_zero)
    return ReferenceLine(s, xy, angle)


def fillet(
    corner: Float[np.ndarray, "2"], heading_a: float, heading_b: float, radius: float
) -> Float[np.ndarray, "n 2"]:
    """Return the arc that rounds the corner between two rays, from the ray `heading_a` to the ray `heading_b`.

    Both headings point away from `corner`; the arc touches each ray `radius / tan(gap / 2)` from it.
    """
    a, b = direction(heading_a), direction(heading_b)
    gap = np.arccos(np.clip(a @ b, -1.0, 1.0))
    middle = (a + b) / np.linalg.norm(a + b)
    center = corner + middle * radius / np.sin(gap / 2)
    start = corner + a * radius / np.tan(gap / 2) - center
    first = np.arctan2(start[1], start[0])
    sweep = np.copysign(np.pi - gap, cross(b, a))
    angles = first + np.linspace(0.0, sweep, max(int(np.ceil(radius * abs(sweep) / _FILLET_SPACING)), 2) + 1)
    return center + radius * direction(angles)


def blend(
    start: Float[np.ndarray, "c 2"],
    start_heading: Float[np.ndarray, " c"],
    stop: Float[np.ndarray, "c 2"],
    stop_heading: Float[np.ndarray, " c"],
    count: int,
    radius: Float[np.ndarray, " c"] | float = np.inf,
    handle: Float[np.ndarray, " c"] | float = 0.4,
) -> tuple[Float[np.ndarray, "c count 2"], Float[np.ndarray, "c count"]]:
    """Return curves of `count` points that join poses smoothly, and their headings at these points.

    Where the tangents of the two poses meet ahead, the curve runs straight, turns around that corner on a cubic Bezier
    curve close to a circular arc, and runs straight again; else it is one cubic Bezier curve (an S).

    Args:
        start, start_heading: where the curves begin, metres and radians.
        stop, stop_heading: where they end.
        count: of points.
        radius: largest radius of the arc, metres; smaller ones stay nearer to the corner.
        handle: length of the Bezier handles of an S, as a fraction of the distance between its ends; with longer ones
            it leaves the straight line later and crosses over more steeply.
    """
    u, v, d = direction(start_heading), direction(stop_heading), stop - start
    turn = np.abs(wrap_angle(stop_heading - start_heading))
    distance = np.linalg.norm(d, axis=-1)
    sine = cross(u, v)
    safe = np.where(np.abs(sine) > 1e-9, sine, 1.0)
    # start + ahead u + behind v = stop
    ahead, behind = cross(d, v) / safe, cross(u, d) / safe
    meets = (np.abs(sine) > 0.2) & (ahead > 0.5) & (behind > 0.5)
    # Tangent lengths of the arc. Very unequal ones would tighten the curve at the shorter end.
    tangent = radius * np.tan(np.where(meets, turn, 1.0) / 2)
    first = np.minimum(np.minimum(ahead, 1.3 * behind), tangent)
    second = np.minimum(np.minimum(behind, 1.3 * ahead), tangent)
    lead, tail = np.where(meets, ahead - first, 0.0), np.where(meets, behind - second, 0.0)
    # Bezier handles of a circular arc are 4/3 tan(turn / 4) of its radius.
    arc = 4.0 / 3.0 * np.tan(turn / 4) / np.where(meets, np.tan(turn / 2), 1.0)
    first, second = np.where(meets, arc * first, handle * distance), np.where(meets, arc * second, handle * distance)
    a, b = start + lead[:, None] * u, stop - tail[:, None] * v
    p0, p1, p2, p3 = (p[:, None] for p in (a, a + first[:, None] * u, b - second[:, None] * v, b))

    middle = 1.03 * np.linalg.norm(b - a, axis=-1)
    along = np.linspace(0.0, 1.0, count) * (lead + middle + tail)[:, None]
    q = np.clip((along - lead[:, None]) / middle[:, None], 0.0, 1.0)[..., None]
    xy = (1 - q) ** 3 * p0 + 3 * q * (1 - q) ** 2 * p1 + 3 * q * q * (1 - q) * p2 + q**3 * p3
    slope = (1 - q) ** 2 * (p1 - p0) + 2 * q * (1 - q) * (p2 - p1) + q * q * (p3 - p2)
    before = np.minimum(along - lead[:, None], 0.0)[..., None]
    after = np.maximum(along - (lead + middle)[:, None], 0.0)[..., None]
    return xy + before * u[:, None] + after * v[:, None], np.arctan2(slope[..., 1], slope[..., 0])


# `geometry.arc_length` and `sample_at` do the same and round differently, in the last bits (np.hypot and np.interp
# here). Roads stand and traffic drives where these two put them: with the others, scenes of recorded runs would change.
def arc_length(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Return the distance along the line to each point, metres."""
    steps = np.diff(points, axis=0)
    return np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])


def points_at(line: Float[np.ndarray, "n 2"], distances: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 2"]:
    """Return the points at distances along the line, clamped to its ends."""
    along = arc_length(line)
    return np.stack([np.interp(distances, along, line[:, i]) for i in range(2)], -1)


def offset_polyline(points: Float[np.ndarray, "n 2"], distance: float) -> Float[np.ndarray, "n 2"]:
    """Return the polyline shifted to its right, each vertex along the mean of its neighbours' normals."""
    step = np.gradient(points, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-12)
    return points + distance * np.stack([step[:, 1], -step[:, 0]], -1)
