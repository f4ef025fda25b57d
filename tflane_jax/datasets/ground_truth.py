"""Lanes and traffic elements of OpenLane-V2 from a vector map and a pose (specs/data_formats.md section 3).

Lanes come in two flavours, lane segments as the map holds them and centerlines merged over one-to-one joints;
both are moved into the ego frame, cut at the perception range and resampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.prepared_map import MapLanes, PreparedMap
from tflane_jax.geometry import PerceptionRange, transform_points
from tflane_jax.geometry.polylines import arc_length, clip_to_range, resample_lines, sample_at
from tflane_jax.scene import LaneGraph, TrafficElements
from tflane_jax.scene.logs import MapElement
from tflane_jax.world.bev.line_of_sight import hidden_points
from tflane_jax.world.cameras.sensor import ElementViews

# A traffic element farther away than this is not part of the truth; metres.
ELEMENT_DISTANCE = 60.0
# Points on each centerline at which visibility is asked: about one for each metre of the longest lanes.
_SIGHT_SAMPLES = 101


@dataclass(frozen=True)
class CroppedLanes:
    """Lanes inside the range.

    Attributes:
        graph: the truth.
        lane: (capacity,) number of the map lane that each valid row is a piece of.
        dropped: how many lanes found no room (the farthest).
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
    """Move, cut and resample lanes (steps 1 to 7).

    A centerline that the border cuts into several pieces gives several lanes. [i, j] of `successor` is true
    where piece i holds the end of its lane, piece j the start of its lane, and the map joins the two lanes.

    Args:
        boxes, buildings: what stands in the line of sight (see `hidden_points`), ego frame.
    """
    pieces = _crop(lanes, ego_from_global, range_)
    distance = [np.linalg.norm(p.centerline[:, :2], axis=-1).min() for p in pieces]
    kept = sorted(np.argsort(distance, kind="stable")[:capacity].tolist())
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
    """What the range leaves of a lane: its lines in the ego frame and whether its own start and end are in it."""

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

    Of several pieces inside the range, the one nearest to the centerline's; of none, the stretch of the
    boundary that runs beside it.
    """
    inside = clip_to_range(line, range_)
    if len(inside) == 1:
        return inside[0]
    if inside:
        middle = sample_at(part, np.array([arc_length(part)[-1] / 2]))[0, :2]
        return min(inside, key=lambda piece: np.linalg.norm(piece[:, :2] - middle, axis=-1).min())
    span = np.array([_position_along(whole, end) for end in (part[0], part[-1])]) / arc_length(whole)[-1]
    return sample_at(line, np.linspace(span[0], span[1], 11) * arc_length(line)[-1])


def _position_along(line: np.ndarray, point: np.ndarray) -> float:
    """Return the arc length at which a line passes nearest to a point."""
    start, step = line[:-1, :2], np.diff(line[:, :2], axis=0)
    square = (step**2).sum(-1)
    t = ((point[:2] - start) * step).sum(-1) / np.where(square > 0.0, square, 1.0)
    t = np.clip(t, 0.0, 1.0)
    nearest = np.linalg.norm(start + t[:, None] * step - point[:2], axis=-1).argmin()
    return float(arc_length(line)[nearest] + t[nearest] * np.sqrt(square[nearest]))


def traffic_elements(
    elements: Sequence[MapElement],
    attribute: Int[np.ndarray, " m"],
    prepared: PreparedMap,
    lanes: CroppedLanes,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    *,
    capacity: int,
    seen: ElementViews | None = None,
) -> tuple[TrafficElements, int]:
    """Return lights and signs, tied to the merged centerlines whose segments they govern, and how many found no room
    (the farthest).

    Without an image, those in range and nearer than `ELEMENT_DISTANCE` are the truth; with one, those seen in it.

    Args:
        elements, attribute: the map's elements and what each shows at this moment.
        lanes: cut from `prepared.centerlines`.
        seen: the elements in the front image, None where there is no image.
    """
    out = TrafficElements.empty(capacity, len(lanes.graph.valid))
    if not elements:
        return out, 0
    position = transform_points(ego_from_global, np.stack([e.position for e in elements]))
    distance = np.linalg.norm(position[:, :2], axis=-1)
    there = range_.contains(position) & (distance < ELEMENT_DISTANCE) if seen is None else seen.visible
    found = np.flatnonzero(there)
    kept = np.sort(found[np.argsort(distance[found], kind="stable")[:capacity]])
    for row, number in enumerate(kept):
        governed = [prepared.chain_of[s] for s in elements[number].lanes if s in prepared.chain_of]
        out.lane[: len(lanes.lane), row] = np.isin(lanes.lane, governed)
    n = len(kept)
    out.position[:n] = position[kept]
    if seen is not None:
        out.box[:n] = seen.box[kept]
    out.category[:n] = [elements[i].category for i in kept]
    out.attribute[:n] = np.asarray(attribute)[kept]
    out.valid[:n] = True
    return out, len(found) - n
