"""A recorded map as a road network of the built-in world: traffic, sensors and markers work on it as elsewhere.

Lanes, markings, crossings and the border of the road are the map's. Speed limits, signals, right of way, sidewalks,
parked cars and buildings are not in it: they are derived or drawn for each scene. The ground is flat.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.scene.logs import LaneSegment, VectorMap
from tflane_jax.world.roads import map_roadside, roadside
from tflane_jax.world.roads.config import RoadConfig
from tflane_jax.world.roads.curves import arc_length
from tflane_jax.world.roads.intersections import crossing_walk
from tflane_jax.world.roads.layouts import chance, draw
from tflane_jax.world.roads.map_junctions import MapJunction, find_junctions, merging_lanes
from tflane_jax.world.roads.map_roads import road_lines_of
from tflane_jax.world.roads.networks import EgoDrive, RoadNetwork
from tflane_jax.world.roads.road_map import RoadMap, traffic_lanes

# The map of a scene: segments, roadside and traffic up to these distances from the middle of its examples, metres.
_SEGMENTS, _ROADSIDE, _TRAFFIC = 160.0, 140.0, 350.0
# An example is made at most this far from there, metres.
_WITHIN = 90.0
# An example may be made this far from a recorded drive, even if the map is complete for less, metres.
_LEAST_MARGIN = 5.0
# Route of the ego vehicle before and after the middle of its examples, metres; and its least speed limit, m/s.
_BEFORE, _AFTER, _SLOWEST = 260.0, 120.0, 4.0
_PACE = 0.95
_ROUTE_TRIES = 12
_DENSITY = (0.3, 0.95)
# Intersections that a vehicle passes on its way through a map: each of them takes up its share of the inflow.
_PASSED = 1.5


@dataclass(frozen=True)
class PreparedRoads:
    """What all scenes on a map share.

    Attributes:
        segments: of the map, on the plane z = 0.
        lanes: for traffic, with their lengths, metres.
        before: lane -> lanes open to motor vehicles that it continues.
        junctions: intersections.
        merges: lane -> lane into whose traffic it merges.
        border: oriented lines at the edge of the road.
        kerbs: parts of them beside lanes; sidewalks: lines behind them on which pedestrians walk.
        walks: start and end of the walk over each crossing; crossings: their rings.
        parking: x, y, yaw.
        roads: center lines.
        points: of all lanes.
        complete: distance from the places up to which every lane is in the map, metres.
        beside: distance from the nearest place, lane, station and point, every few metres of lane.
    """

    segments: dict[int, LaneSegment]
    lanes: dict[int, LaneSegment]
    length: dict[int, float]
    before: dict[int, list[int]]
    junctions: list[MapJunction]
    merges: dict[int, tuple[int, ...]]
    border: list[Float[np.ndarray, "_ 2"]]
    kerbs: list[Float[np.ndarray, "_ 2"]]
    sidewalks: list[Float[np.ndarray, "_ 2"]]
    crossings: list[Float[np.ndarray, "_ 3"]]
    walks: list[Float[np.ndarray, "2 2"]]
    parking: Float[np.ndarray, "p 3"]
    roads: tuple[Float[np.ndarray, "_ 2"], ...]
    points: Float[np.ndarray, "p 2"]
    complete: float
    beside: list[tuple[float, int, float, Float[np.ndarray, "2"]]]

    def within(self, sees: float) -> float:
        """Return how far from the map's places examples are made that see so far, metres."""
        return max(self.complete - sees, _LEAST_MARGIN)

    def spots(self, sees: float) -> list[tuple[int, float, Float[np.ndarray, "2"]]]:
        """Return places of examples: lane, distance along it and point; the nearest one if none is near enough."""
        near = [one[1:] for one in self.beside if one[0] <= self.within(sees)]
        return near or [min(self.beside, key=lambda one: one[0])[1:]]


@functools.lru_cache(maxsize=64)
def prepare_roads(road_map: RoadMap, sidewalk: float) -> PreparedRoads:
    """Return what all scenes on a map share; the last maps stay in memory.

    Args:
        road_map: the map.
        sidewalk: distance of the walking line behind the kerb, metres.

    Raises UserError for a map without a lane open to motor vehicles.
    """
    segments = {i: _flat(segment) for i, segment in road_map.map.segments.items()}
    lanes = traffic_lanes(segments)
    if not any(lane.vehicle for lane in lanes.values()):
        raise UserError(
            f"{road_map.source} {road_map.name} has no lane open to motor vehicles: leave it out (data.without)"
        )
    before: dict[int, list[int]] = {i: [] for i in lanes}
    for i, lane in lanes.items():
        for j in lane.successors:
            if lane.vehicle:
                before[j].append(i)
    points = map_roadside.lane_points(segments.values())
    low, high = points.min(0) - 60.0, points.max(0) + 60.0
    clipped = map_roadside.clip_border(road_map.map.road_boundaries, low, high)
    border = map_roadside.facing_lanes(clipped, points)
    kerbs = map_roadside.kerbs_of(border, points)
    crossings = [_on_plane(ring) for ring in road_map.map.crossings if len(ring) == 5]
    junctions = find_junctions(lanes, segments)
    return PreparedRoads(
        segments=segments,
        lanes=lanes,
        length={i: float(arc_length(lane.centerline[:, :2])[-1]) for i, lane in lanes.items()},
        before=before,
        junctions=junctions,
        merges=merging_lanes(lanes),
        border=border,
        kerbs=kerbs,
        sidewalks=map_roadside.walking_lines(kerbs, sidewalk, points),
        crossings=crossings,
        walks=[crossing_walk(ring[:, :2], sidewalk) for ring in crossings],
        parking=map_roadside.parking_places(segments, kerbs, crossings, road_map.parked),
        roads=road_lines_of(lanes, junctions),
        points=points,
        complete=road_map.complete,
        beside=_beside(lanes, road_map.places),
    )


def build_map_network(
    rng: np.random.Generator, road_map: RoadMap, config: RoadConfig, *, sees: float, leads_s: float
) -> RoadNetwork:
    """Draw a scene on a recorded map; the same stream, map and config give the same bits.

    Args:
        rng: stream.
        road_map: the map.
        config: its `urban_speed`, `signals`, `sidewalk` and `building_setback` are used.
        sees: distance up to which an example must be complete, metres.
        leads_s: time that the ego vehicle drives before examples are made, seconds.
    """
    roads = prepare_roads(road_map, config.sidewalk)
    way, aim, spot = _ego_way(rng, roads, roads.spots(sees))
    speed = draw(rng, config.urban_speed)
    lanes = {i: lane for i, lane in roads.lanes.items() if _near(lane.centerline, spot, _TRAFFIC) or i in way}
    yields = {i: others for i, others in roads.merges.items() if i in lanes and others[0] in lanes}
    phase: dict[int, tuple[int, int]] = {}
    elements = []
    for junction in roads.junctions:
        signals = junction.may_have_signals and chance(rng, config.signals)
        if not all(i in lanes for i in junction.connectors):
            continue
        yields |= junction.gives_way(signals)
        if signals:
            number = len({one for one, _ in phase.values()})
            phase |= {i: (number, p) for i, p in junction.signal_phases().items()}
            if np.linalg.norm(junction.center - spot) < 0.5 * _SEGMENTS:
                elements += junction.elements(int(rng.integers(max(junction.phase) + 1)))
    kerbs = [kerb for kerb in roads.kerbs if _near(kerb, spot, _ROADSIDE)]
    buildings = np.zeros((0, 5))
    if kerbs:
        used = np.concatenate([roads.points, roads.parking[:, :2]])
        used = used[np.linalg.norm(used - spot, axis=-1) < _ROADSIDE + 60.0]
        buildings = roadside.buildings_along(rng, kerbs, [used], config.building_setback, draw(rng, _DENSITY))
    return RoadNetwork(
        map=VectorMap(
            segments={i: s for i, s in roads.segments.items() if _near(s.centerline, spot, _SEGMENTS)},
            crossings=tuple(ring for ring in roads.crossings if _near(ring, spot, _SEGMENTS)),
            road_boundaries=tuple(_on_plane(line) for line in roads.border),
            elements=tuple(elements),
            buildings=buildings,
            roads=tuple(_on_plane(line) for line in roads.roads),
            dividers=None
            if road_map.map.dividers is None
            else tuple(_on_plane(line) for line in road_map.map.dividers if _near(line, spot, _SEGMENTS)),
            side=road_map.map.side,
        ),
        speed_limit=dict.fromkeys(lanes, speed),
        yield_to=yields,
        signal_phase=phase,
        sidewalks=tuple(line for line in roads.sidewalks if _near(line, spot, _ROADSIDE)),
        walk_across=tuple(walk for walk in roads.walks if _near(walk, spot, _ROADSIDE)),
        parking=roads.parking[np.linalg.norm(roads.parking[:, :2] - spot, axis=-1) < _ROADSIDE],
        ego_routes=(way,),
        kind=None,
        lanes=lanes,
        junctions=max(round(sum(len(junction.minor) > 2 for junction in roads.junctions) / _PASSED), 1),
        drive=EgoDrive(
            aim=aim,
            top_speed=max(aim / (_PACE * leads_s), _SLOWEST),
            places=road_map.places[np.linalg.norm(road_map.places - spot, axis=-1) < _WITHIN],
            within=roads.within(sees),
        ),
    )


def _ego_way(
    rng: np.random.Generator, roads: PreparedRoads, spots: Sequence[tuple[int, float, Float[np.ndarray, "2"]]]
) -> tuple[tuple[int, ...], float, Float[np.ndarray, "2"]]:
    """Draw a place for examples and a route through it: lanes, distance of the place along them, and the place.

    Of a few draws, the one with the longest way before the place is taken, up to `_BEFORE`.
    """
    best: tuple[tuple[int, ...], float, Float[np.ndarray, "2"]] | None = None
    for _ in range(_ROUTE_TRIES):
        lane, station, spot = spots[int(rng.integers(len(spots)))]
        way, ahead, behind = [lane], roads.length[lane] - station, station
        while behind < _BEFORE and (onto := [i for i in roads.before[way[0]] if i not in way]):
            way.insert(0, onto[int(rng.integers(len(onto)))])
            behind += roads.length[way[0]]
        while ahead < _AFTER and (onward := [i for i in roads.lanes[way[-1]].successors if i not in way]):
            way.append(onward[int(rng.integers(len(onward)))])
            ahead += roads.length[way[-1]]
        if best is None or min(behind, _BEFORE) > min(best[1], _BEFORE):
            best = tuple(way), behind, spot
        if behind > 0.4 * _BEFORE and ahead > 0.25 * _AFTER:
            break
    assert best is not None
    return best


def _beside(
    lanes: Mapping[int, LaneSegment], places: Float[np.ndarray, "n 2"]
) -> list[tuple[float, int, float, Float[np.ndarray, "2"]]]:
    """Return points of lanes open to motor vehicles: distance from the nearest place, lane, station and point."""
    from scipy.spatial import KDTree

    tree, found = KDTree(places), []
    for i, lane in lanes.items():
        if lane.vehicle:
            line = map_roadside.evenly(lane.centerline[:, :2], 3.0)
            stations = np.linspace(0.0, arc_length(line)[-1], len(line))
            found += [(float(d), i, float(s), xy) for d, s, xy in zip(tree.query(line)[0], stations, line, strict=True)]
    return found


def _near(line: Float[np.ndarray, "n d"], spot: Float[np.ndarray, "2"], metres: float) -> bool:
    return bool((np.linalg.norm(line[:, :2] - spot, axis=-1) < metres).any())


def _on_plane(line: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 3"]:
    return np.pad(np.asarray(line, np.float64)[:, :2], ((0, 0), (0, 1)))


def _flat(segment: LaneSegment) -> LaneSegment:
    lines = (_on_plane(line) for line in (segment.centerline, segment.left, segment.right))
    centerline, left, right = lines
    return replace(segment, centerline=centerline, left=left, right=right)
