"""Lanes and traffic elements of OpenLane-V2 from a vector map and an ego pose.

Lanes come in two flavours: the map's lane segments, and centerlines merged over one-to-one joints. Both are moved into
the ego frame, cut at the perception range and resampled. The conversion code of OpenLane-V2 is not public;
docs/reference/openlane_v2_truth.md gives the rules and their sources.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.prepared_map import MapLanes
from tflane_jax.geometry import PerceptionRange, transform_points
from tflane_jax.geometry.polylines import (
    arc_length,
    clip_to_range,
    nearest_lines,
    resample_lines,
    sample_at,
    segment_distances,
)
from tflane_jax.scene import LaneGraph, TrafficElements
from tflane_jax.scene.logs import MapElement
from tflane_jax.world.bev.line_of_sight import hidden_points
from tflane_jax.world.cameras.sensor import ElementViews

# Metres; traffic elements farther away are not ground truth.
ELEMENT_DISTANCE = 60.0
# Metres along a lane, about its width: ends of a boundary may be ahead of or behind those of the centerline.
_BESIDE = 3.5
# Points on each centerline at which line of sight is tested: about one per metre of the longest lanes.
_SIGHT_SAMPLES = 101


@dataclass(frozen=True)
class CroppedLanes:
    """Lanes inside the range.

    Attributes:
        graph: the ground truth.
        lane: (n,) map lane of which each of the n valid rows is a piece.
        dropped: number of lanes left out because the capacity was exceeded (the farthest).
    """

    graph: LaneGraph
    lane: np.ndarray
    dropped: int


def lane_graph(
    lanes: MapLanes,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    *,
    capacity: int,
    points: int,
    boxes: Float[np.ndarray, "k 7"],
    buildings: Float[np.ndarray, "b 5"],
) -> CroppedLanes:
    """Return the lanes in range: moved into the ego frame, cut and resampled.

    A centerline that the border cuts into several pieces gives several lanes. `successor[i, j]` is true if piece i
    contains the end of its lane, piece j contains the start of its lane, and the map connects the two lanes.

    Args:
        lanes: of the map, in one flavour, global frame.
        ego_from_global: pose.
        range_: perception range, ego frame.
        capacity: lanes in the result; of more, the farthest are left out.
        points: points on each lane.
        boxes, buildings: obstacles to the line of sight (see `hidden_points`), ego frame.
    """
    pieces = _crop(lanes, ego_from_global, range_)
    kept = nearest_lines([p.centerline for p in pieces], capacity)
    dropped, pieces = len(pieces) - len(kept), [pieces[i] for i in kept]
    n, graph = len(pieces), LaneGraph.empty(capacity, points)
    lane = np.array([p.lane for p in pieces], int)
    if n:
        graph.points[:n] = resample_lines([p.centerline for p in pieces], points)
        graph.left[:n] = resample_lines([p.left for p in pieces], points)
        graph.right[:n] = resample_lines([p.right for p in pieces], points)
        sight = resample_lines([p.centerline for p in pieces], _SIGHT_SAMPLES)[..., :2]
        hidden = hidden_points(sight.reshape(-1, 2), boxes, buildings).reshape(n, -1)
        graph.visibility[:n] = 1.0 - hidden.mean(-1)
        graph.left_type[:n] = [lanes.lanes[i].left_type for i in lane]
        graph.right_type[:n] = [lanes.lanes[i].right_type for i in lane]
        graph.is_connector[:n] = [lanes.lanes[i].is_intersection for i in lane]
        graph.valid[:n] = True
        edge = np.zeros((len(lanes.lanes), len(lanes.lanes)), bool)
        edge[lanes.edges[:, 0], lanes.edges[:, 1]] = True
        ends, starts = (np.array([getattr(p, name) for p in pieces]) for name in ("has_end", "has_start"))
        graph.successor[:n, :n] = edge[np.ix_(lane, lane)] & ends[:, None] & starts
    return CroppedLanes(graph, lane, dropped)


@dataclass(frozen=True)
class _Piece:
    """A piece of a lane inside the range, ego frame, and whether it contains the lane's start and end."""

    lane: int
    centerline: np.ndarray
    left: np.ndarray
    right: np.ndarray
    has_start: bool
    has_end: bool


def _crop(lanes: MapLanes, ego_from_global: np.ndarray, range_: PerceptionRange) -> list[_Piece]:
    lines = (lanes.centerline, lanes.left, lanes.right)
    centerlines, lefts, rights = (x.moved(ego_from_global) for x in lines)
    pieces = []
    for number in centerlines.near(range_):
        whole = centerlines.line(number)
        parts = clip_to_range(whole, range_)
        pieces += [
            _Piece(
                lane=number,
                centerline=part,
                left=_boundary_of(part, lefts.line(number), whole, range_),
                right=_boundary_of(part, rights.line(number), whole, range_),
                has_start=part is parts[0] and np.array_equal(part[0], whole[0]),
                has_end=part is parts[-1] and np.array_equal(part[-1], whole[-1]),
            )
            for part in parts
        ]
    return pieces


def _boundary_of(part: np.ndarray, line: np.ndarray, whole: np.ndarray, range_: PerceptionRange) -> np.ndarray:
    """Return the piece of a boundary that belongs to a piece of its centerline.

    Of several pieces inside the range, it is the one nearest to the middle of the centerline's piece. If no piece lies
    beside it, it is the part of the boundary at the same fractions of its length. A boundary that stays inside while
    its centerline leaves the range and returns is given whole to each piece of the centerline.
    """
    inside = clip_to_range(line, range_)
    if len(inside) == 1 and np.array_equal(part, whole):
        return inside[0]
    start, stop = (_position_along(whole, end) for end in (part[0], part[-1]))
    beside = [(way, piece) for piece in inside if (way := _lies_beside(piece, whole, start, stop)) is not None]
    if beside:
        middle = sample_at(part, np.array([arc_length(part)[-1] / 2]))[0, :2]

        def rank(candidate: tuple[str, np.ndarray]) -> tuple[bool, float]:
            """Pieces that run the centerline's way come first, then the nearest to its middle."""
            way, piece = candidate
            return way == "against", float(np.linalg.norm(piece[:, :2] - middle, axis=-1).min())

        return min(beside, key=rank)[1]
    span = np.array([start, stop]) / arc_length(whole)[-1]
    return sample_at(line, np.linspace(span[0], span[1], 11) * arc_length(line)[-1])


def _lies_beside(piece: np.ndarray, whole: np.ndarray, start: float, stop: float) -> Literal["along", "against"] | None:
    """Return which way a boundary's piece runs beside a stretch of the centerline, or nearly so; None if it does not.

    A lane that leaves the range and comes back may have a centerline inside where the boundary is outside. Where it
    turns back outside, the boundary between its legs lies beside both; each leg has the piece that runs its way.
    """
    first, last = (_position_along(whole, end, (start, stop)) for end in (piece[0], piece[-1]))
    if min(first, last) - stop > _BESIDE or start - max(first, last) > _BESIDE:
        return None
    if last >= first:
        return "along"
    nearest = [_position_along(whole, end) for end in (piece[0], piece[-1])]
    return "against" if nearest == [first, last] else None


def _position_along(line: np.ndarray, point: np.ndarray, stretch: tuple[float, float] | None = None) -> float:
    """Return the arc length at which a line passes nearest to a point.

    With `stretch` (a range of arc lengths): of several places that are about equally near, the one closest to it.
    """
    step = np.diff(line[:, :2], axis=0)
    fraction, distance = segment_distances(point[:2], line[:-1, :2], step)
    position = arc_length(line)[:-1] + fraction * np.linalg.norm(step, axis=-1)
    if stretch is None:
        return float(position[distance.argmin()])
    around = np.pad(distance, 1, constant_values=np.inf)
    least = (distance <= around[:-2]) & (distance <= around[2:])
    passes = least & (distance <= 1.5 * distance.min() + 0.5)
    gap = np.maximum(np.maximum(stretch[0] - position, position - stretch[1]), 0.0)
    return float(position[np.lexsort((distance, np.where(passes, gap, np.inf)))[0]])


def traffic_elements(
    elements: Sequence[MapElement],
    attribute: Int[np.ndarray, " m"],
    number: Mapping[int, int],
    lanes: CroppedLanes,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    *,
    capacity: int,
    of: Literal["centerlines", "segments"] = "centerlines",
    seen: ElementViews | None = None,
) -> tuple[TrafficElements, int]:
    """Return lights and signs with the lanes that they govern, and how many exceeded the capacity.

    Ground truth are the elements visible in the front image. Without an image, they are those in range and nearer than
    `ELEMENT_DISTANCE`. Of more than the capacity, the farthest are left out.

    Args:
        elements, attribute: the map's elements and the attribute of each at this moment.
        number: from segment id to the number of its lane: `PreparedMap.chain_of` or `PreparedMap.segment_of`.
        lanes: lanes in range, of this flavour.
        ego_from_global: pose.
        range_: perception range, ego frame.
        capacity: elements in the result.
        of: what `lanes` are.
        seen: the elements in the front image; None if there is no image.
    """
    rows, segments = len(lanes.graph.valid), of == "segments"
    out = TrafficElements.empty(capacity, None if segments else rows, rows if segments else None)
    governs = out.segment if segments else out.lane
    assert governs is not None
    if not elements:
        return out, 0
    position = transform_points(ego_from_global, np.stack([e.position for e in elements]))
    distance = np.linalg.norm(position[:, :2], axis=-1)
    there = range_.contains(position) & (distance < ELEMENT_DISTANCE) if seen is None else seen.visible
    found = np.flatnonzero(there)
    kept = np.sort(found[np.argsort(distance[found], kind="stable")[:capacity]])
    for row, element in enumerate(kept):
        governed = [number[s] for s in elements[element].lanes if s in number]
        governs[: len(lanes.lane), row] = np.isin(lanes.lane, governed)
    n = len(kept)
    out.position[:n] = position[kept]
    if seen is not None:
        out.box[:n] = seen.box[kept]
    out.category[:n] = [elements[i].category for i in kept]
    out.attribute[:n] = np.asarray(attribute)[kept]
    out.valid[:n] = True
    return out, len(found) - n
