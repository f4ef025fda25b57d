"""Polylines: arc length, resampling, clipping and the two curve distances of lane metrics.

Resampling and clipping of ragged lines run in numpy (host); the distances run in numpy or under jit on fixed shapes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from tflane_jax.geometry.ranges import PerceptionRange


def arc_length(points: Float[Array, "n d"]) -> Float[Array, " n"]:
    """Return the distance travelled in the **ground plane** (x, y) from the first point to each point, metres.

    Lengths are 2-D even for 3-D lines, as in the OpenLane-V2 tools (specs/metrics.md section 6).
    """
    steps = np.linalg.norm(np.diff(np.asarray(points)[:, :2], axis=0), axis=-1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: Float[Array, "n d"], count: int) -> Float[Array, "count d"]:
    """Return `count` points equally spaced in ground-plane arc length, both ends included.

    At a repeated position the segment after the last repeated vertex counts; a line of length zero gives its first
    vertex `count` times. Raises ValueError for an empty line.
    """
    points = np.asarray(points)
    if len(points) == 0:
        raise ValueError("cannot resample a polyline without points")
    return sample_at(points, np.linspace(0.0, arc_length(points)[-1], count))


def sample_at(points: Float[Array, "n d"], distances: Float[Array, " k"]) -> Float[Array, "k d"]:
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
    # The form a + w (b - a) keeps w = 0 exact; w = 1 is set by hand so that both ends are the line's own points.
    out = points[segment] + weight * (points[segment + 1] - points[segment])
    return np.where(weight == 1.0, points[segment + 1], out)


def clip_to_range(points: Float[Array, "n d"], range_: PerceptionRange) -> list[np.ndarray]:
    """Cut a polyline at the border of the range in x and y.

    Returns the pieces inside, in order along the line, with new points exactly on the border (z interpolated). A line
    wholly outside, or only touching the border at a point, gives no piece.
    """
    points = np.asarray(points, np.float64)
    pieces: list[list[np.ndarray]] = []
    open_piece = False
    for a, b in zip(points[:-1], points[1:], strict=True):
        span = _inside_interval(a, b, range_)
        if span is None:
            open_piece = False
            continue
        enter, leave = (_on_segment(a, b, t, range_) for t in span)
        if open_piece and span[0] == 0.0:
            pieces[-1].append(leave)
        else:
            pieces.append([enter, leave])
        open_piece = span[1] == 1.0
    return [np.stack(p) for p in pieces if arc_length(np.stack(p))[-1] > 0.0]


def _inside_interval(a: np.ndarray, b: np.ndarray, range_: PerceptionRange) -> tuple[float, float] | None:
    """Return the parameters at which the segment a-b enters and leaves the box (Liang-Barsky), or None."""
    enter, leave = 0.0, 1.0
    for axis, (low, high) in enumerate((range_.x, range_.y)):
        step = b[axis] - a[axis]
        if step == 0.0:
            if not low <= a[axis] <= high:
                return None
            continue
        t0, t1 = sorted(((low - a[axis]) / step, (high - a[axis]) / step))
        enter, leave = max(enter, t0), min(leave, t1)
    return (enter, leave) if enter <= leave else None


def _on_segment(a: np.ndarray, b: np.ndarray, t: float, range_: PerceptionRange) -> np.ndarray:
    if t == 0.0:
        return a
    if t == 1.0:
        return b
    point = a + t * (b - a)
    # Rounding must not leave a cut end a hair outside the box.
    point[0] = np.clip(point[0], *range_.x)
    point[1] = np.clip(point[1], *range_.y)
    return point
