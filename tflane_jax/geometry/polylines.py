"""Polylines on the host: arc length, resampling, clipping and stacking of ragged lines (numpy)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.geometry.namespace import ArrayT, namespace
from tflane_jax.geometry.ranges import PerceptionRange


def arc_length(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Return the **ground plane** (x, y) distance from the first point to each point along the line, metres.

    Lengths are 2-D even for 3-D lines, as in the OpenLane-V2 tools.
    """
    steps = np.linalg.norm(np.diff(np.asarray(points)[:, :2], axis=0), axis=-1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def line_lengths(lines: Float[np.ndarray, "*b n d"]) -> Float[np.ndarray, "*b"]:
    """Return the ground-plane length of every line, metres."""
    return np.linalg.norm(np.diff(lines[..., :2], axis=-2), axis=-1).sum(-1)


def resample(points: Float[np.ndarray, "n d"], count: int) -> Float[np.ndarray, "count d"]:
    """Return `count` points equally spaced in ground-plane arc length, both ends included.

    At a repeated position the segment after the last repeated vertex counts; a line of length zero gives its
    first vertex `count` times. Raises ValueError for an empty line.
    """
    points = np.asarray(points)
    if len(points) == 0:
        raise ValueError("cannot resample a polyline without points")
    return sample_at(points, np.linspace(0.0, arc_length(points)[-1], count))


def sample_at(
    points: Float[np.ndarray, "n d"], distances: Float[np.ndarray, " k"], along: Float[np.ndarray, " n"] | None = None
) -> Float[np.ndarray, "k d"]:
    """Return the points at the given ground-plane distances along the line, clamped to its ends.

    Args:
        points: of the line.
        distances: metres.
        along: `arc_length(points)`, if the caller has it.
    """
    points = np.asarray(points)
    along = arc_length(points) if along is None else along
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


def resample_lines(lines: Sequence[Float[np.ndarray, "_ d"]], count: int) -> Float[np.ndarray, "l count d"]:
    """Return `resample` of every line at once (count >= 2); no line may be empty."""
    if not lines:
        return np.zeros((0, count, 3))
    sizes = np.array([len(line) for line in lines])
    if sizes.min() == 0:
        raise ValueError("cannot resample a polyline without points")
    points = np.concatenate(lines).astype(np.float64)  # the distance runs through all lines
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


def simplify(points: Float[np.ndarray, "n d"], tolerance: float) -> Float[np.ndarray, "k d"]:
    """Return the vertices of a line that keep all others within `tolerance` metres (Douglas and Peucker 1973).

    Distances are in the ground plane. Both ends stay; 0 keeps every vertex. A closed line is cut at the vertex farthest
    from its seam.
    """
    if tolerance <= 0.0 or len(points) < 3:
        return points
    keep = np.zeros(len(points), bool)
    keep[[0, -1]] = True
    spans = [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        origin, step = points[first, :2], points[last, :2] - points[first, :2]
        away = points[first + 1 : last, :2] - origin
        fraction = np.clip(away @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
        distance = np.linalg.norm(away - fraction[:, None] * step, axis=-1)
        if distance.max() > tolerance:
            farthest = first + 1 + int(distance.argmax())
            keep[farthest] = True
            spans += [(first, farthest), (farthest, last)]
    return points[keep]


def without_repeats(points: Float[np.ndarray, "n d"], tolerance: float) -> Float[np.ndarray, "k d"]:
    """Return a line without the points that lie within `tolerance` metres of the one before, in the ground plane.

    The point before may itself be left out: of many points in small steps only the first stays.
    """
    kept = np.ones(len(points), bool)
    kept[1:] = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=-1) > tolerance
    return points[kept]


def pad_lines(
    lines: Sequence[Float[np.ndarray, "_ d"]] | Float[np.ndarray, "l n d"], dims: int = 3
) -> Float[np.ndarray, "l n d"]:
    """Stack ragged polylines into one float64 array by repeating each line's last vertex (numpy).

    The repetition changes neither the discrete Fréchet distance nor the vertex nearest to a point. It does change means
    over vertices, so the Chamfer distance needs the true counts. Raises ValueError for a line without points.
    """
    if len(lines) == 0:
        return np.zeros((0, 1, dims))
    sizes = line_sizes(lines)
    if sizes.min() == 0:
        raise ValueError(f"polyline {int(sizes.argmin())} has no points")
    if sizes.min() == sizes.max():
        return np.asarray(lines, np.float64)
    first = np.cumsum(sizes) - sizes
    index = first[:, None] + np.minimum(np.arange(sizes.max()), sizes[:, None] - 1)
    return np.concatenate([np.asarray(line, np.float64) for line in lines])[index]


def line_sizes(lines: Sequence[Float[np.ndarray, "_ d"]] | Float[np.ndarray, "l n d"]) -> Int[np.ndarray, " l"]:
    """Return the number of vertices of every line; of an array, without a look at each of its lines."""
    if isinstance(lines, np.ndarray) and lines.ndim == 3:
        return np.full(len(lines), lines.shape[1])
    return np.fromiter(map(len, lines), int, len(lines))


def segment_distances(
    points: Float[ArrayT, "*#b 2"], start: Float[ArrayT, "*#b m 2"], step: Float[ArrayT, "*#b m 2"]
) -> tuple[Float[ArrayT, "*b m"], Float[ArrayT, "*b m"]]:
    """Return where on each straight piece `start` to `start + step` each point is nearest, and the distances.

    The first result is the fraction of the piece, in [0, 1]. A piece may have no length.
    """
    xp = namespace(points, start, step)
    # x and y apart: four times faster than sums over the last axis, with the same bits (hence `+ 0.0`, for -0.0).
    square = (step**2).sum(-1)
    away_x, away_y = (points[..., None, axis] - start[..., axis] for axis in (0, 1))
    along = away_x * step[..., 0] + away_y * step[..., 1]
    t = xp.clip(along / xp.where(square > 0.0, square, 1.0), 0.0, 1.0) + 0.0
    x, y = (start[..., axis] + t * step[..., axis] - points[..., None, axis] for axis in (0, 1))
    return t, xp.sqrt(x * x + y * y)


def line_distances(
    lines: Float[np.ndarray, "*#b p d"], others: Float[np.ndarray, "*#b q d"]
) -> tuple[Float[np.ndarray, "*b p"], Float[np.ndarray, "*b p"]]:
    """Return the ground-plane distance from every vertex to the other line, and the nearest place on that line.

    Distances are in metres. A place is a vertex number with a fraction, from 0 at the first vertex to q - 1 at the
    last. Lines need q >= 2 vertices.
    """
    start, step = others[..., None, :-1, :2], np.diff(others[..., None, :, :2], axis=-2)
    fraction, distance = segment_distances(lines[..., :2], start, step)
    nearest = distance.argmin(-1)[..., None]
    place = nearest + np.take_along_axis(fraction, nearest, -1)
    return np.take_along_axis(distance, nearest, -1)[..., 0], place[..., 0]


def nearest_on(line: Float[np.ndarray, "n d"], place: Float[np.ndarray, "2"]) -> tuple[int, float, float]:
    """Return where a line passes nearest to a place, in the ground plane.

    Returns the number of the segment, the fraction of it, and the distance in metres. A line may be a single point.
    """
    line = np.asarray(line)[:, :2]
    line = np.concatenate([line, line]) if len(line) == 1 else line
    t, distance = segment_distances(np.asarray(place), line[:-1], np.diff(line, axis=0))
    nearest = int(distance.argmin())
    return nearest, float(t[nearest]), float(distance[nearest])


def nearest_lines(
    lines: Sequence[Float[np.ndarray, "_ d"]],
    count: int,
    place: Float[np.ndarray, "2"] | tuple[float, float] = (0.0, 0.0),
) -> Int[np.ndarray, " k"]:
    """Return the numbers, ascending, of the `count` lines that pass nearest to a place in the ground plane.

    Distances are to the lines, not to their vertices: a straight line that passes close by may have only its far ends.
    """
    distance = [nearest_on(line, np.asarray(place))[2] for line in lines]
    return np.sort(np.argsort(distance, kind="stable")[:count])


def clip_to_range(points: Float[np.ndarray, "n d"], range_: PerceptionRange) -> list[np.ndarray]:
    """Cut a polyline at the border of the range in x and y.

    Returns the pieces inside, in order along the line, with new points exactly on the border (z
    interpolated). A line wholly outside, or only touching the border at a point, gives no piece.
    """
    points = np.asarray(points, np.float64)
    if len(points) < 2:
        return []
    inside = range_.contains(points)
    if inside.all():
        return [points] if _has_length(points) else []
    whole = inside[:-1] & inside[1:]  # segments
    # Of the other segments, only those can meet the box that do not lie beyond one of its four borders.
    (x0, x1), (y0, y1) = range_.x, range_.y
    x, y = points[:, 0], points[:, 1]
    beyond = np.stack([x < x0, x > x1, y < y0, y > y1])
    may_meet = ~(whole | (beyond[:, :-1] & beyond[:, 1:]).any(0))
    cuts = {}
    for i in np.flatnonzero(may_meet).tolist():
        if (cut := _cut(points[i], points[i + 1], range_)) is not None:
            cuts[i] = cut
    return [piece for piece in _pieces(points, whole, cuts) if _has_length(piece)]


class _Cut(NamedTuple):
    """The part of a segment inside the box.

    Attributes:
        enter, leave: (d,) its ends.
        from_start, to_end: whether these are the start and the end of the segment.
    """

    enter: np.ndarray
    leave: np.ndarray
    from_start: bool
    to_end: bool


class _Axis(NamedTuple):
    """Borders of the box and ends of a segment on one axis, metres."""

    low: float
    high: float
    start: float
    stop: float


def _pieces(points: np.ndarray, whole: np.ndarray, cuts: dict[int, _Cut]) -> list[np.ndarray]:
    """Return the pieces of a line inside the box.

    Args:
        points: the line.
        whole: for each segment, whether all of it is inside.
        cuts: by number of the segment, the parts of those that the border cuts.
    """
    pieces: list[list[np.ndarray]] = []
    stops = np.append(np.flatnonzero(~whole), len(whole))
    connected = False  # whether the last piece ends where segment i starts
    i = 0
    while i < len(whole):
        if whole[i]:
            # A run of segments inside: all of its vertices at once.
            after = int(stops[np.searchsorted(stops, i)])
            start, rest = points[i : i + 1], points[i + 1 : after + 1]
            from_start = to_end = True
        elif (cut := cuts.get(i)) is not None:
            after = i + 1
            start, rest = cut.enter[None], cut.leave[None]
            from_start, to_end = cut.from_start, cut.to_end
        else:
            i, connected = i + 1, False
            continue
        if not (connected and from_start):
            pieces.append([start])
        pieces[-1].append(rest)
        i, connected = after, to_end
    return [np.concatenate(parts) for parts in pieces]


def _has_length(points: np.ndarray) -> bool:
    return bool((points[1:, :2] != points[:-1, :2]).any())


def _cut(a: np.ndarray, b: np.ndarray, range_: PerceptionRange) -> _Cut | None:
    """Return the part of a segment inside the box (Liang-Barsky).

    None if it is outside or only touches the border: a vertex there belongs to the neighbour that goes inside.
    """
    enter, leave = 0.0, 1.0
    # Plain floats: an array operation on one segment costs more than all of this.
    axes = [
        _Axis(*borders, start, stop)
        for borders, start, stop in zip((range_.x, range_.y), a[:2].tolist(), b[:2].tolist(), strict=True)
    ]
    for low, high, start, stop in axes:
        if stop == start:
            if not low <= start <= high:
                return None
            continue
        t0, t1 = (low - start) / (stop - start), (high - start) / (stop - start)
        enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    if enter >= leave:
        return None
    return _Cut(_on_segment(a, b, enter, axes), _on_segment(a, b, leave, axes), enter == 0.0, leave == 1.0)


def _on_segment(a: np.ndarray, b: np.ndarray, t: float, axes: list[_Axis]) -> np.ndarray:
    """Return the point at a fraction t of a segment; one on the border lies exactly there, despite rounding."""
    if t in (0.0, 1.0):
        return b if t else a
    point = a + t * (b - a)
    for i, (low, high, start, stop) in enumerate(axes):
        point[i] = min(max(point[i], low), high)
        for border in (low, high):
            if stop != start and (border - start) / (stop - start) == t:
                point[i] = border
    return point
