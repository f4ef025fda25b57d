"""Ground truth of OpenLane-V2 from a vector map and a pose (specs/data_formats.md section 3).

Lanes come in two flavours, lane segments as the map holds them and centerlines merged over one-to-one joints;
both are moved into the ego frame, cut at the perception range and resampled. Crossings stay whole, road
boundaries are cut.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.chains import merge_chains
from tflane_jax.geometry import PerceptionRange, transform_points
from tflane_jax.geometry.polylines import arc_length, clip_to_range, resample_lines, sample_at
from tflane_jax.logs import LaneSegment, VectorMap
from tflane_jax.scene import Areas, AreaType, LaneGraph, TrafficElements
from tflane_jax.world.line_of_sight import hidden_points
from tflane_jax.world.map_samples import MapSamples, sample_map

# Road boundaries are cut this far inside the range, as MapTR and (by its figures) OpenLane-V2 do; metres.
BOUNDARY_MARGIN = 0.2
# A traffic element farther away than this is not part of the truth; metres.
ELEMENT_DISTANCE = 60.0
# Points on each centerline at which visibility is asked: about one for each metre of the longest lanes.
_SIGHT_SAMPLES = 101


@dataclass(frozen=True)
class PackedLines:
    """Polylines of a map in one array, so that a frame moves all of them with one product.

    Attributes:
        points: (M, 3) all points, one line after the other.
        ends: (L,) index after the last point of each line.
    """

    points: np.ndarray
    ends: np.ndarray

    @classmethod
    def pack(cls, lines: Sequence[np.ndarray]) -> PackedLines:
        """Pack lines of any length, none empty."""
        ends = np.cumsum([len(line) for line in lines], dtype=int)
        return cls(np.concatenate([np.zeros((0, 3)), *lines]), ends)

    def line(self, number: int) -> Float[np.ndarray, "n 3"]:
        """Return one line (a view)."""
        return self.points[self.ends[number - 1] if number else 0 : self.ends[number]]

    def moved(self, pose: Float[np.ndarray, "4 4"]) -> PackedLines:
        """Return the lines in another frame."""
        return PackedLines(transform_points(pose, self.points), self.ends)

    def near(self, range_: PerceptionRange) -> list[int]:
        """Return the numbers of the lines whose bounding box meets the range."""
        if len(self.ends) == 0:
            return []
        starts = np.concatenate([[0], self.ends[:-1]])
        low = np.minimum.reduceat(self.points[:, :2], starts, axis=0)
        high = np.maximum.reduceat(self.points[:, :2], starts, axis=0)
        range_low, range_high = np.array([range_.x, range_.y]).T
        return np.flatnonzero(((high >= range_low) & (low <= range_high)).all(-1)).tolist()


@dataclass(frozen=True)
class MapLanes:
    """The lanes of a whole map in one flavour.

    Attributes:
        lanes: L lanes, global frame.
        centerline, left, right: L packed lines each.
        edges: (E, 2) lane numbers: the second succeeds the first.
    """

    lanes: tuple[LaneSegment, ...]
    centerline: PackedLines
    left: PackedLines
    right: PackedLines
    edges: np.ndarray

    @classmethod
    def of(cls, lanes: dict[int, LaneSegment]) -> MapLanes:
        """Number and pack lanes."""
        number = {lane_id: i for i, lane_id in enumerate(lanes)}
        edges = [(number[s.id], number[t]) for s in lanes.values() for t in s.successors if t in number]
        return cls(
            lanes=tuple(lanes.values()),
            centerline=PackedLines.pack([s.centerline for s in lanes.values()]),
            left=PackedLines.pack([s.left for s in lanes.values()]),
            right=PackedLines.pack([s.right for s in lanes.values()]),
            edges=np.array(edges, int).reshape(-1, 2),
        )


@dataclass(frozen=True)
class PreparedMap:
    """A map made ready for many frames.

    Attributes:
        segments, centerlines: both flavours of its lanes.
        chain_of: number in `centerlines` of the chain that holds a segment id.
        crossings, boundaries: packed lines.
        samples: dense points for the bird's-eye-view sensor.
    """

    segments: MapLanes
    centerlines: MapLanes
    chain_of: dict[int, int]
    crossings: PackedLines
    boundaries: PackedLines
    samples: MapSamples


_PREPARED: dict[tuple[int, bool], PreparedMap] = {}


def prepare_map(vector_map: VectorMap, *, bike_lanes: bool) -> PreparedMap:
    """Merge, pack and sample a map; remembered for as long as the map lives.

    Args:
        bike_lanes: keep lanes closed to motor vehicles (unknown of the official ground truth; MapTRv2 keeps
            them).
    """
    key = (id(vector_map), bike_lanes)
    if key not in _PREPARED:
        _PREPARED[key] = _prepare(vector_map, bike_lanes)
        weakref.finalize(vector_map, _PREPARED.pop, key)
    return _PREPARED[key]


def _prepare(vector_map: VectorMap, bike_lanes: bool) -> PreparedMap:
    kept = {i: s for i, s in vector_map.segments.items() if bike_lanes or s.vehicle}
    merged = merge_chains(kept)
    number = {chain: i for i, chain in enumerate(merged.chains)}
    return PreparedMap(
        segments=MapLanes.of(kept),
        centerlines=MapLanes.of(merged.chains),
        chain_of={segment: number[chain] for segment, chain in merged.chain_of.items()},
        crossings=PackedLines.pack(vector_map.crossings),
        boundaries=PackedLines.pack(vector_map.road_boundaries),
        samples=sample_map(vector_map),
    )


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
    return sample_at(line, np.linspace(*span, 11) * arc_length(line)[-1])


def _position_along(line: np.ndarray, point: np.ndarray) -> float:
    """Return the arc length at which a line passes nearest to a point."""
    start, step = line[:-1, :2], np.diff(line[:, :2], axis=0)
    square = (step**2).sum(-1)
    t = ((point[:2] - start) * step).sum(-1) / np.where(square > 0.0, square, 1.0)
    t = np.clip(t, 0.0, 1.0)
    nearest = np.linalg.norm(start + t[:, None] * step - point[:2], axis=-1).argmin()
    return float(arc_length(line)[nearest] + t[nearest] * np.sqrt(square[nearest]))


def crop_areas(
    prepared: PreparedMap,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    *,
    capacity: int,
    points: int,
) -> tuple[Areas, int]:
    """Return crossings that meet the range, whole (step 8), and road boundaries cut `BOUNDARY_MARGIN` inside it
    (step 9), and how many of them found no room (the farthest)."""
    crossings = prepared.crossings.moved(ego_from_global)
    # A ring that meets the range crosses its border or lies inside; none is so large as to surround it.
    rings = [crossings.line(i) for i in crossings.near(range_)]
    rings = [ring for ring in rings if clip_to_range(ring, range_)]
    low, high = BOUNDARY_MARGIN, -BOUNDARY_MARGIN
    inner = PerceptionRange(
        (range_.x[0] + low, range_.x[1] + high), (range_.y[0] + low, range_.y[1] + high), range_.z
    )
    lines = prepared.boundaries.moved(ego_from_global)
    boundaries = [piece for i in lines.near(inner) for piece in clip_ring(lines.line(i), inner)]
    found = rings + boundaries
    category = [AreaType.PEDESTRIAN_CROSSING] * len(rings) + [AreaType.ROAD_BOUNDARY] * len(boundaries)
    distance = [np.linalg.norm(line[:, :2], axis=-1).min() for line in found]
    kept = sorted(np.argsort(distance, kind="stable")[:capacity].tolist())
    n, areas = len(kept), Areas.empty(capacity, points)
    if n:
        areas.points[:n] = resample_lines([found[i] for i in kept], points)
        areas.category[:n] = [category[i] for i in kept]
        areas.valid[:n] = True
    return areas, len(found) - n


def clip_ring(line: np.ndarray, range_: PerceptionRange) -> list[np.ndarray]:
    """Cut a line at the range; of a closed ring, the pieces at its arbitrary seam are joined again."""
    pieces = clip_to_range(line, range_)
    closed = np.array_equal(line[0], line[-1])
    if closed and len(pieces) > 1 and all(np.array_equal(p, line[0]) for p in (pieces[0][0], pieces[-1][-1])):
        pieces = [np.concatenate([pieces[-1], pieces[0][1:]]), *pieces[1:-1]]
    return pieces


def traffic_elements(
    vector_map: VectorMap,
    prepared: PreparedMap,
    lanes: CroppedLanes,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    *,
    capacity: int,
) -> tuple[TrafficElements, int]:
    """Return lights and signs in range and nearer than `ELEMENT_DISTANCE`, tied to the merged centerlines whose
    segments they govern, and how many found no room (the farthest)."""
    out = TrafficElements.empty(capacity, len(lanes.graph.valid))
    if not vector_map.elements:
        return out, 0
    position = transform_points(ego_from_global, np.stack([e.position for e in vector_map.elements]))
    distance = np.linalg.norm(position[:, :2], axis=-1)
    found = np.flatnonzero(range_.contains(position) & (distance < ELEMENT_DISTANCE))
    kept = np.sort(found[np.argsort(distance[found], kind="stable")[:capacity]])
    for row, number in enumerate(kept):
        element = vector_map.elements[number]
        governed = [prepared.chain_of[s] for s in element.lanes if s in prepared.chain_of]
        out.lane[: len(lanes.lane), row] = np.isin(lanes.lane, governed)
    n = len(kept)
    out.position[:n] = position[kept]
    out.category[:n] = [vector_map.elements[i].category for i in kept]
    out.attribute[:n] = [vector_map.elements[i].attribute for i in kept]
    out.valid[:n] = True
    return out, len(found) - n
