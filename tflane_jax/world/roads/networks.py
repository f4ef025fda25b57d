"""Procedural road networks: the static half of the built-in world.

`build_road_network` draws a scene kind, plans its streets (`layout_roads`, `layout_junctions`), lays them out as lane
segments (`through_roads`, `junction_networks`) and furnishes the roadside. All of it is metres in one global frame
around the central feature, right-hand traffic, z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.errors import UserError
from tflane_jax.scene.logs import LaneSegment, VectorMap
from tflane_jax.world.roads import roadside
from tflane_jax.world.roads.access_roads import with_access_roads
from tflane_jax.world.roads.car_parks import draw_car_parks
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.cuts import set_back
from tflane_jax.world.roads.driveways import draw_driveways, interrupted, parking_beside
from tflane_jax.world.roads.intersections import crossing_walk
from tflane_jax.world.roads.junction_networks import lay_out_junctions
from tflane_jax.world.roads.lane_network import LaneNetwork
from tflane_jax.world.roads.layout_junctions import plan_junctions
from tflane_jax.world.roads.layout_roads import plan_road
from tflane_jax.world.roads.layouts import draw
from tflane_jax.world.roads.lines import road_lines
from tflane_jax.world.roads.site import Site
from tflane_jax.world.roads.through_roads import lay_out_road

__all__ = ["EgoDrive", "RoadConfig", "RoadNetwork", "SceneKind", "build_road_network"]

_SHORTEST_ROUTE = 120.0
_JUNCTIONS = (
    SceneKind.T_JUNCTION,
    SceneKind.FOUR_WAY,
    SceneKind.TWO_JUNCTIONS,
    SceneKind.ROUNDABOUT,
    SceneKind.FIVE_LEGS,
    SceneKind.STAGGERED,
)


@dataclass(frozen=True)
class EgoDrive:
    """The ego vehicle's drive over a map that is complete around some places only.

    Attributes:
        aim: where on its route, metres from the start, it should be when examples are made.
        top_speed: m/s, slow enough to start on the route.
        places: (n, 2) around which the map is complete, metres.
        within: an example may be made up to this distance from one of them, metres.
    """

    aim: float
    top_speed: float
    places: Float[np.ndarray, "n 2"]
    within: float

    def covers(self, xy: Float[np.ndarray, "f 2"]) -> Bool[np.ndarray, " f"]:
        """Return at which positions the map is complete as far as an example sees."""
        return np.linalg.norm(xy[:, None] - self.places, axis=-1).min(1, initial=np.inf) <= self.within


@dataclass(frozen=True)
class RoadNetwork:
    """A map with its traffic rules, sidewalks, parking slots and ego routes.

    Attributes:
        map: lane segments, crossings, road boundaries, traffic elements, buildings.
        speed_limit: m/s for each segment id.
        yield_to: segment -> segments whose traffic has priority over traffic that enters it.
        signal_phase: connector -> (intersection index, phase index); absent where there are no signals.
        sidewalks: (n, 2) lines on which pedestrians walk, metres.
        walk_across: (2, 2) start and end of the walk over each pedestrian crossing, behind the kerbs.
        parking: (P, 3) x, y, yaw of places for parked vehicles: at the kerb, in driveways and in car parks.
        ego_routes: sequences of segment ids that the ego vehicle may drive, each at least 120 m long; its perception
            range (+-51.2 m x +-25.6 m) stays inside the map all along.
        kind: the central feature; None on a recorded map.
        lanes: lanes that vehicles drive, if the map cuts them differently; None: the map's segments. The ids in
            `speed_limit`, `yield_to`, `signal_phase` and `ego_routes` are theirs.
        junctions: intersections that share the vehicles which enter the map.
        drive: where examples may be made, on a recorded map; None on a network that is complete around every route.
    """

    map: VectorMap
    speed_limit: dict[int, float]
    yield_to: dict[int, tuple[int, ...]]
    signal_phase: dict[int, tuple[int, int]]
    sidewalks: tuple[np.ndarray, ...]
    walk_across: tuple[np.ndarray, ...]
    parking: np.ndarray
    ego_routes: tuple[tuple[int, ...], ...]
    kind: SceneKind | None
    lanes: dict[int, LaneSegment] | None = None
    junctions: int = 1
    drive: EgoDrive | None = None

    @property
    def traffic_lanes(self) -> dict[int, LaneSegment]:
        """The lanes that vehicles drive, by id."""
        return self.map.segments if self.lanes is None else self.lanes


def build_road_network(rng: np.random.Generator, config: RoadConfig) -> RoadNetwork:
    """Draw a road network; the same stream and config give the same bits.

    Raises UserError for settings that leave no room for streets or routes.
    """
    kinds, weights = zip(*config.kinds, strict=True)
    kind = kinds[rng.choice(len(kinds), p=np.array(weights) / np.sum(weights))]
    network = LaneNetwork()
    if kind in _JUNCTIONS:
        plan = plan_junctions(rng, kind, config)
        site = lay_out_junctions(rng, plan, network, config)
    else:
        plan = None
        site = lay_out_road(plan_road(rng, kind, config), network, config)
    if config.driveways and site.urban:
        site.driveways = draw_driveways(rng, site, _stop_lines(network), config)
    if config.car_parks and site.urban:
        site.car_parks = draw_car_parks(rng, site, config)
    routes = network.routes(_SHORTEST_ROUTE)
    if not routes:
        raise UserError(f"roads: no route of {_SHORTEST_ROUTE:g} m ({kind.value}): raise ego_reach and reach")
    lanes = network.segments()
    mapped = _as_mapped(rng, lanes, site, config)
    density = rng.uniform(0.55, 0.95) if site.urban else rng.uniform(0.0, 0.3)
    boxes = roadside.buildings(rng, site, config.building_setback, density)
    return RoadNetwork(
        map=VectorMap(
            segments=mapped,
            crossings=_on_plane(site.crossings),
            road_boundaries=_on_plane([*interrupted(site.kerbs, site.driveways), *site.islands]),
            elements=tuple(site.elements),
            buildings=boxes,
            roads=_on_plane(road_lines(site.streets, plan)),
        ),
        speed_limit={i: d.speed for i, d in network.drafts.items()},
        yield_to={i: tuple(sorted(others)) for i, others in network.yield_to.items()},
        signal_phase=dict(network.signal_phase),
        sidewalks=tuple(roadside.sidewalks(site.kerbs, config.sidewalk)) if site.urban else (),
        walk_across=tuple(crossing_walk(ring, config.sidewalk) for ring in site.crossings),
        parking=np.concatenate([parking_beside(roadside.parking_slots(site), site.driveways), site.car_parks]),
        ego_routes=routes,
        kind=kind,
        lanes=None if mapped is lanes else lanes,
    )


def _as_mapped(
    rng: np.random.Generator, lanes: dict[int, LaneSegment], site: Site, config: RoadConfig
) -> dict[int, LaneSegment]:
    """Return lanes as the map has them; the same ones, and nothing is drawn, if it has those that traffic drives on."""
    setback = draw(rng, (0.0, 2.0 * config.cut_setback)) if config.cut_setback else 0.0
    mapped = set_back(rng, lanes, setback) if setback else lanes
    if any(one.lanes for one in site.driveways):
        mapped = with_access_roads(rng, mapped, site, setback, config.turn_restriction)
    return mapped


def _stop_lines(network: LaneNetwork) -> Float[np.ndarray, "j 2"]:
    """Return the middles of both ends of every connector."""
    ends = [0.5 * (d.left[[0, -1]] + d.right[[0, -1]]) for d in network.drafts.values() if d.is_intersection]
    return np.concatenate([np.zeros((0, 2)), *ends])


def _on_plane(lines: Sequence[Float[np.ndarray, "n 2"]]) -> tuple[np.ndarray, ...]:
    return tuple(np.pad(line, ((0, 0), (0, 1))) for line in lines)
