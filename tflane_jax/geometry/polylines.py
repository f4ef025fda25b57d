"""Polylines on the host: arc length, resampling and clipping of ragged lines (numpy)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry.namespace import AnyArray
from tflane_jax.geometry.ranges import PerceptionRange


def arc_length(points: Float[AnyArray, "n d"]) -> Float[np.ndarray, " n"]:
    """Return the **ground plane** (x, y) distance from the first point to each point along the line, metres.

    Lengths are 2-D even for 3-D lines, as in the OpenLane-V2 tools.
    """
    steps = np.linalg.norm(np.diff(np.asarray(points)[:, :2], axis=0), axis=-1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: Float[AnyArray, "n d"], count: int) -> Float[np.ndarray, "count d"]:
    """Return `count` points equally spaced in ground-plane arc length, both ends included.

    At a repeated position the segment after the last repeated vertex counts; a line of length zero gives its
    first vertex `count` times. Raises ValueError for an empty line.
    """
    points = np.asarray(points)
    if len(points) == 0:
        raise ValueError("cannot resample a polyline without points")
    return sample_at(points, np.linspace(0.0, arc_length(points)[-1], count))


def sample_at(points: Float[AnyArray, "n d"], distances: Float[AnyArray, " k"]) -> Float[np.ndarray, "k d"]:
    """Return the points at the given ground-plane distances along the line, clamped to its ends."""
    points = np.asarray(points)
    along = arc_length(points)
    if len(points) == 1 or along[-1] == 0.0:
        return np.repeat(points[:1], len(distances), axis=0)
    distances = np.clip(distances, 0.0, along[-1])
    # The last segment that starts at or before the distance, never one of zero length.
    segment = np.searchsorted(along, distances, side="right") - 1
    last = np.searchsorted(along, along[-1], side="left") - 1
    segment = np.minimum(segment, last)
    start, length = along[segment], along[segment + 1] - along[segment]
    weight = ((distances - start) / length)[:, None]
    # a + w (b - a) is exact for w = 0 but not for w = 1; both ends must be the line's own points.
    out = points[segment] + weight * (points[segment + 1] - points[segment])
    return np.where(weight == 1.0, points[segment + 1], out)


def resample_lines(lines: Sequence[Float[AnyArray, "_ d"]], count: int) -> Float[np.ndarray, "l count d"]:
    """Return `resample` of every line at once (count >= 2); no line may be empty."""
    if not lines:
        return np.zeros((0, count, 3))
    sizes = np.array([len(line) for line in lines])
    if sizes.min() == 0:
        raise ValueError("cannot resample a polyline without points")
    points = np.concatenate(lines)
    first = np.cumsum(sizes) - sizes
    last = first + sizes - 1
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=-1)
    steps[last[:-1]] = 0.0
    along = np.concatenate([[0.0], np.cumsum(steps)])
    distances = along[first][:, None] + (along[last] - along[first])[:, None] * np.linspace(0.0, 1.0, count)
    distances[:, -1] = along[last]
    # The end of a line and the start of the next have the same distance: the clip keeps each query on its own line,
    # and on its last segment that has a length.
    start = np.searchsorted(along, distances, side="right") - 1
    final = np.maximum(np.searchsorted(along, along[last], side="left") - 1, first)
    start = np.clip(start, first[:, None], final[:, None])
    stop = np.minimum(start + 1, last[:, None])
    length = along[stop] - along[start]
    weight = ((distances - along[start]) / np.where(length > 0.0, length, 1.0))[..., None]
    weight = np.clip(weight, 0.0, 1.0)
    return np.where(weight == 1.0, points[stop], points[start] + weight * (points[stop] - points[start]))


def clip_to_range(points: Float[AnyArray, "n d"], range_: PerceptionRange) -> list[np.ndarray]:
    """Cut a polyline at the border of the range in x and y.

    Returns the pieces inside, in order along the line, with new points exactly on the border (z
    interpolated). A line wholly outside, or only touching the border at a point, gives no piece.
    """
    points = np.asarray(points, np.float64)
    if len(points) > 1 and range_.contains(points).all():
        # The common case, several times faster than the general one below.
        return [points] if _has_length(points) else []
    a, b = points[:-1], points[1:]
    enter, leave, inside = _inside_interval(a, b, range_)
    enter_point, leave_point = (_on_segment(a, b, t, range_) for t in (enter, leave))
    # A segment continues the piece of the one before it unless the line left the box in between.
    continues = inside[1:] & inside[:-1] & (leave[:-1] == 1.0) & (enter[1:] == 0.0)
    starts = np.flatnonzero(inside & ~np.concatenate([[False], continues]))
    stops = np.flatnonzero(inside & ~np.concatenate([continues, [False]])) + 1
    pieces = [np.concatenate([enter_point[i : i + 1], leave_point[i:j]]) for i, j in zip(starts, stops, strict=True)]
    return [p for p in pieces if _has_length(p)]


def _has_length(points: np.ndarray) -> bool:
    return bool((points[1:, :2] != points[:-1, :2]).any())


def _inside_interval(
    a: np.ndarray, b: np.ndarray, range_: PerceptionRange
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where each segment a-b enters and leaves the box (Liang-Barsky), and whether it meets it."""
    enter, leave, inside = np.zeros(len(a)), np.ones(len(a)), np.ones(len(a), bool)
    for axis, (low, high) in enumerate((range_.x, range_.y)):
        step = b[:, axis] - a[:, axis]
        parallel = step == 0.0
        inside &= ~parallel | ((low <= a[:, axis]) & (a[:, axis] <= high))
        t0, t1 = _crossing(a, b, axis, low), _crossing(a, b, axis, high)
        enter = np.where(parallel, enter, np.maximum(enter, np.minimum(t0, t1)))
        leave = np.where(parallel, leave, np.minimum(leave, np.maximum(t0, t1)))
    return enter, leave, inside & (enter <= leave)


def _crossing(a: np.ndarray, b: np.ndarray, axis: int, border: float) -> np.ndarray:
    """Return where each segment a-b meets the border, 0 at a and 1 at b; NaN for a parallel one."""
    step = b[:, axis] - a[:, axis]
    return (border - a[:, axis]) / np.where(step == 0.0, np.nan, step)


def _on_segment(a: np.ndarray, b: np.ndarray, t: np.ndarray, range_: PerceptionRange) -> np.ndarray:
    point = a + t[:, None] * (b - a)
    # Despite rounding, a cut end lies exactly on the border and a vertex of the line stays where it is.
    for axis, borders in enumerate((range_.x, range_.y)):
        point[:, axis] = np.clip(point[:, axis], *borders)
        for border in borders:
            point[_crossing(a, b, axis, border) == t, axis] = border
    return np.where(t[:, None] == 0.0, a, np.where(t[:, None] == 1.0, b, point))
