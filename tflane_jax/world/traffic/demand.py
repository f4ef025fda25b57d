"""Traffic demand: routes and entry times of vehicles and bicycles on a lane network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.scene import RoadUser
from tflane_jax.world.traffic.lane_table import LaneTable
from tflane_jax.world.traffic.vehicles import Drivers, draw_drivers

# Shortest time between two vehicles that enter on one lane, seconds, and the largest inflow of a lane, 1/s.
_SHORTEST_HEADWAY, _LANE_CAPACITY = 1.9, 0.4
# Largest total inflow towards junctions without and with signals, 1/s: more would only make queues grow.
_JUNCTION_CAPACITY, _SIGNAL_CAPACITY = 0.45, 0.7
# Branches that turn by more than this are chosen a third as often, radians.
_STRAIGHT = np.deg2rad(35.0)
# Bicycles share the lane where traffic is not faster than this, m/s.
_SHARED_LANE_SPEED = 15.0
_LONGEST_ROUTE = 24


@dataclass(frozen=True)
class Routes:
    """Routes of N trips through S segments; distances along a route start at 0 at its first segment.

    Attributes:
        segment: (N, L) segment indices; arbitrary beyond the end.
        start: (N, L) distance at which each begins; inf beyond the end.
        length: (N,) of the whole route, metres.
        distance: (N, S) distance at which a segment begins on the route; inf for segments not on it.
    """

    segment: Int[np.ndarray, "n l"]
    start: Float[np.ndarray, "n l"]
    length: Float[np.ndarray, " n"]
    distance: Float[np.ndarray, "n s"]

    def take(self, rows: Int[np.ndarray, " m"]) -> Routes:
        """Return the routes of some trips."""
        return Routes(self.segment[rows], self.start[rows], self.length[rows], self.distance[rows])

    def place(self, distance: Float[np.ndarray, "n *b"]) -> tuple[Int[np.ndarray, "n *b"], Float[np.ndarray, "n *b"]]:
        """Return segments and stations at distances along each route."""
        n = len(self.start)
        extra = (1,) * (distance.ndim - 1)
        leg = (self.start.reshape(n, *extra, self.start.shape[1]) <= distance[..., None]).sum(-1) - 1
        row = np.arange(n).reshape(n, *extra)
        leg = np.maximum(leg, 0)
        return self.segment[row, leg], distance - self.start[row, leg]


@dataclass(frozen=True)
class Trips:
    """N trips. The first is the ego vehicle's.

    Attributes:
        routes: of the trips.
        drivers: of the trips.
        enters: (N,) time at which each passes the start of its route, seconds; inf for the ego vehicle, which is placed
            separately.
    """

    routes: Routes
    drivers: Drivers
    enters: Float[np.ndarray, " n"]

    def take(self, rows: Int[np.ndarray, " m"]) -> Trips:
        """Return some trips."""
        return Trips(self.routes.take(rows), self.drivers.take(rows), self.enters[rows])


def draw_trips(
    rng: np.random.Generator,
    table: LaneTable,
    ego_way: tuple[int, ...],
    *,
    start: float,
    stop: float,
    vehicles_per_metre: float,
    bicycles_per_metre: float,
    category_share: tuple[tuple[RoadUser, float], ...],
    junctions: int = 1,
) -> Trips:
    """Draw the trips that enter the network between two times.

    Args:
        rng: stream.
        table: lanes.
        ego_way: segment indices that the ego vehicle must drive first.
        start, stop: seconds.
        vehicles_per_metre: target density on a lane in free flow.
        bicycles_per_metre: the same for bicycles on bike lanes; at half the fraction, at the edge of slow outer lanes.
        category_share: motor vehicles by category.
        junctions: intersections that share the vehicles.
    """
    categories, fractions = zip(*category_share, strict=True)
    fractions = np.array(fractions) / np.sum(fractions)
    entered = {j for following in table.successors for j in following}
    enters: list[np.ndarray] = []
    category: list[np.ndarray] = []
    edge: list[np.ndarray] = []
    ways: list[tuple[int, ...]] = [_continue(rng, table, ego_way)]
    outer = _outer_lanes(table)
    lanes = [i for i in range(len(table.ids)) if i not in entered]
    capacity = _lane_capacity(table, int(table.vehicle[lanes].sum()), junctions)
    for lane in lanes:
        busy = rng.uniform(0.4, 1.6)
        if table.vehicle[lane]:
            flow = min(busy * vehicles_per_metre * table.speed_at_start[lane], capacity)
            times = _arrivals(rng, start, stop, flow)
            kind = rng.choice(categories, size=len(times), p=fractions)
            shared = outer[lane] and table.speed_at_start[lane] < _SHARED_LANE_SPEED
            ratio = bicycles_per_metre / max(vehicles_per_metre + bicycles_per_metre, 1e-9)
            at_edge = (rng.random(len(times)) < 0.5 * ratio) & shared
            kind = np.where(at_edge, int(RoadUser.BICYCLE), kind)
        else:
            times = _arrivals(rng, start, stop, min(busy * bicycles_per_metre * 5.0, _LANE_CAPACITY))
            kind, at_edge = np.full(len(times), int(RoadUser.BICYCLE)), np.zeros(len(times), bool)
        enters.append(times)
        category.append(kind)
        edge.append(at_edge)
        ways += [_continue(rng, table, (lane,)) for _ in times]
    when = np.concatenate([[np.inf], *enters])
    drivers = draw_drivers(rng, np.concatenate([[int(RoadUser.CAR)], *category]).astype(np.int32))
    # Cyclists without a bike lane keep to the right edge.
    drivers.offset[np.concatenate([[False], *edge])] -= 0.85
    return Trips(_routes(ways, table), drivers, when)


def _lane_capacity(table: LaneTable, lanes: int, junctions: int) -> float:
    """Return the inflow of each lane into the network, 1/s."""
    if not table.is_gate.any():
        return _LANE_CAPACITY
    junction = _SIGNAL_CAPACITY if (table.intersection >= 0).any() else _JUNCTION_CAPACITY
    return min(_LANE_CAPACITY, junctions * junction / max(lanes, 1))


def _arrivals(rng: np.random.Generator, start: float, stop: float, flow: float) -> Float[np.ndarray, " k"]:
    """Return times of a renewal process with a shortest gap and `flow` arrivals a second."""
    if flow <= 0.0:
        return np.zeros(0)
    mean = 1.0 / flow
    count = int((stop - start) / _SHORTEST_HEADWAY) + 1
    gaps = _SHORTEST_HEADWAY + rng.exponential(mean - _SHORTEST_HEADWAY, count)
    # The first gap is a random part of a gap, so that lanes are not synchronised.
    gaps[0] *= rng.random()
    times = start + np.cumsum(gaps)
    return times[times < stop]


def _continue(rng: np.random.Generator, table: LaneTable, way: tuple[int, ...]) -> tuple[int, ...]:
    """Return a route continued by random choices to the border of the map, without repeating a segment."""
    out = list(way)
    choices = rng.random(_LONGEST_ROUTE)
    for choice in choices[: max(_LONGEST_ROUTE - len(out), 0)]:
        onward = [j for j in table.successors[out[-1]] if j not in out]
        if not onward:
            break
        if len(onward) == 1:
            out.append(onward[0])
            continue
        weight = np.where(table.turn[onward] < _STRAIGHT, 3.0, 1.0)
        out.append(onward[int(np.searchsorted(np.cumsum(weight) / weight.sum(), choice, side="right"))])
    return tuple(out)


def _outer_lanes(table: LaneTable) -> np.ndarray:
    """Return which segments have no other lane of their direction within 5 m to the right of their start."""
    at, heading = table.xy[table.first_vertex], table.heading[table.first_vertex]
    between = at[None] - at[:, None]
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)
    right = np.stack([np.sin(heading), -np.cos(heading)], -1)
    along = (between * ahead[:, None]).sum(-1)
    across = (between * right[:, None]).sum(-1)
    same = (ahead[:, None] * ahead[None]).sum(-1) > 0.8
    return ~((np.abs(along) < 3.0) & (across > 0.5) & (across < 5.0) & same).any(1)


def _routes(ways: list[tuple[int, ...]], table: LaneTable) -> Routes:
    n, longest = len(ways), max(len(way) for way in ways)
    segment = np.zeros((n, longest), np.intp)
    used = np.zeros((n, longest), bool)
    for i, way in enumerate(ways):
        segment[i, : len(way)] = way
        used[i, : len(way)] = True
    length = np.where(used, table.length[segment], 0.0)
    start = np.where(used, np.cumsum(length, 1) - length, np.inf)
    distance = np.full((n, len(table.ids)), np.inf)
    row, leg = np.nonzero(used)
    distance[row, segment[row, leg]] = start[row, leg]
    return Routes(segment, start, length.sum(1), distance)
