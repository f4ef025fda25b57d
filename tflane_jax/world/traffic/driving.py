"""Accelerations of drivers in one time step: car-following, merging, stop lines, priority and crossings.

Car-following is the Intelligent Driver Model (Treiber, Hennecke, Helbing 2000, Eqs. 3-5): acceleration
a [1 - (v / v0)^4 - (s* / s)^2] with the desired gap s* = s0 + v T + v dv / (2 sqrt(a b)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.world.traffic.demand import Routes
from tflane_jax.world.traffic.lane_table import COMFORTABLE_BRAKING, LaneTable
from tflane_jax.world.traffic.pedestrians import CrossingPlaces

# IDM: gap kept at rest (metres), comfortable braking (m/s^2); and the hardest braking of all.
_REST_GAP, _BRAKING, _HARDEST = 2.0, 2.0, 7.0
# A driver stops for a red light if this braking suffices, and for a pedestrian if twice as much does, m/s^2.
_STOPS_IF = 3.5
# Accepted gap in priority traffic, seconds, and distance below which priority traffic always blocks, metres.
_ACCEPTED_GAP, _AT_HAND = 3.2, 3.0
# Hardest braking for merging into a gap on a parallel lane, m/s^2.
_FITTING_IN = 2.5
# Pedestrians start to cross if no vehicle arrives within this time, seconds.
_CROSSING_GAP = 3.5


@dataclass
class Convoy:
    """A vehicles on the road: constant properties, positions and speeds.

    Attributes:
        routes: of the vehicles.
        half: (A,) half their lengths, metres.
        eagerness, top_speed, acceleration, headway: (A,) see `vehicles.Profile`.
        position: (A,) distance of their middles along their routes, metres.
        speed: (A,) m/s.
    """

    routes: Routes
    half: Float[np.ndarray, " a"]
    eagerness: Float[np.ndarray, " a"]
    top_speed: Float[np.ndarray, " a"]
    acceleration: Float[np.ndarray, " a"]
    headway: Float[np.ndarray, " a"]
    position: Float[np.ndarray, " a"]
    speed: Float[np.ndarray, " a"]


@dataclass(frozen=True)
class Footing:
    """Places of the rear, middle and front of A vehicles.

    Attributes:
        segment, station: (A, 3) place of rear, middle and front.
        front: (A,) distance of the front along the route.
    """

    segment: Int[np.ndarray, "a 3"]
    station: Float[np.ndarray, "a 3"]
    front: Float[np.ndarray, " a"]


def footing(convoy: Convoy) -> Footing:
    """Return the places of rears, middles and fronts."""
    reach = convoy.half[:, None] * np.array([-1.0, 0.0, 1.0])
    segment, station = convoy.routes.place(convoy.position[:, None] + reach)
    return Footing(segment, station, convoy.position + convoy.half)


def acceleration(
    convoy: Convoy,
    at: Footing,
    table: LaneTable,
    red: Bool[np.ndarray, " s"],
    walked_over: tuple[Int[np.ndarray, " o"], Float[np.ndarray, " o"]],
) -> Float[np.ndarray, " a"]:
    """Return the acceleration that each driver chooses, m/s^2.

    Args:
        convoy: the vehicles.
        at: where they are.
        table: lanes.
        red: (S,) segments that must not be entered at a red light.
        walked_over: segments and stations at which a pedestrian crosses the lane.
    """
    v, a = convoy.speed, convoy.acceleration
    wanted = np.maximum(np.minimum(_speed_ahead(convoy, at, table) * convoy.eagerness, convoy.top_speed), 0.3)
    free = np.maximum(a * (1.0 - (v / wanted) ** 4), -_FITTING_IN)
    gap, leader_speed = _leader(convoy, at, table)
    following = _interaction(convoy, gap, leader_speed, _REST_GAP, convoy.headway)
    stop = np.minimum(_stop_line(convoy, at, table, red), _occupied_crossing(convoy, at, walked_over))
    stopping = _interaction(convoy, stop, np.zeros_like(v), 1.0, np.full_like(v, 0.5))
    fit_gap, fit_speed = _merging_leader(convoy, at, table)
    fitting = np.maximum(_interaction(convoy, fit_gap, fit_speed, _REST_GAP, 0.6 * convoy.headway), -_FITTING_IN - a)
    return np.clip(free + np.minimum(np.minimum(following, stopping), fitting), -_HARDEST, a)


def crossings_busy(convoy: Convoy, at: Footing, places: CrossingPlaces, crossings: int) -> Bool[np.ndarray, " c"]:
    """Return the crossings that a vehicle occupies or reaches too soon for a pedestrian to start."""
    gap = convoy.routes.distance[:, places.segment] + places.station - at.front[:, None]
    length = 2.0 * convoy.half[:, None]
    soon = (gap < convoy.speed[:, None] * _CROSSING_GAP) & (gap > -length - 1.0)
    busy = np.zeros(crossings, bool)
    busy[places.crossing[soon.any(0)]] = True
    return busy


def _interaction(
    convoy: Convoy,
    gap: Float[np.ndarray, " a"],
    leader_speed: Float[np.ndarray, " a"],
    rest: float,
    headway: Float[np.ndarray, " a"],
) -> Float[np.ndarray, " a"]:
    """Return IDM's braking term -a (s* / s)^2; 0 for an infinite gap."""
    v, a = convoy.speed, convoy.acceleration
    desired = rest + np.maximum(v * headway + v * (v - leader_speed) / (2.0 * np.sqrt(a * _BRAKING)), 0.0)
    return -a * (desired / np.maximum(gap, 0.2)) ** 2


def _speed_ahead(convoy: Convoy, at: Footing, table: LaneTable) -> Float[np.ndarray, " a"]:
    """Return the comfortable speed at each vehicle, which allows braking for curves of later segments."""
    here = table.speed[table.vertex(at.segment[:, 1], at.station[:, 1])]
    ahead = convoy.routes.start - convoy.position[:, None]
    entry = table.speed_at_start[convoy.routes.segment]
    square = np.where(ahead > 0.0, entry**2 + 2.0 * COMFORTABLE_BRAKING * ahead, np.inf)
    return np.minimum(here, np.sqrt(square.min(1)))


def _leader(convoy: Convoy, at: Footing, table: LaneTable) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " a"]]:
    """Return gap to and speed of the leader of each vehicle.

    The leader is the nearest vehicle whose rear, middle or front lies on a segment ahead, or on one so close beside a
    segment ahead that there is no room for two.
    """
    vehicle = np.broadcast_to(np.arange(len(at.front))[:, None], at.segment.shape)
    tail = at.station - convoy.half[:, None] * np.array([0.0, 1.0, 2.0])
    new = np.ones(at.segment.shape, bool)
    new[:, 1:] = at.segment[:, 1:] != at.segment[:, :-1]
    vertex = table.vertex(at.segment, at.station)
    beside = table.beside[vertex]
    b, part, slot = np.nonzero(beside >= 0)
    off_vertex = (vertex - table.first_vertex[at.segment]) * table.step[at.segment] - tail
    beside_tail = table.beside_station[vertex[b, part], slot] - off_vertex[b, part]
    return _nearest(
        convoy,
        at,
        np.concatenate([vehicle[new], b]),
        np.concatenate([at.segment[new], beside[b, part, slot]]),
        np.concatenate([tail[new], beside_tail]),
    )


def _merging_leader(
    convoy: Convoy, at: Footing, table: LaneTable
) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " a"]]:
    """Return gap and speed of the next vehicle ahead on the lane into which each vehicle's lane merges."""
    merging = np.flatnonzero(table.merges_into >= 0)
    main = table.merges_into[merging]
    middle, station = at.segment[:, 1], at.station[:, 1]
    vehicle, k = np.nonzero(middle[:, None] == main)
    tail = station[vehicle] - convoy.half[vehicle] + table.length[merging[k]] - table.length[main[k]]
    return _nearest(convoy, at, vehicle, merging[k], tail)


def _nearest(
    convoy: Convoy,
    at: Footing,
    vehicle: Int[np.ndarray, " m"],
    segment: Int[np.ndarray, " m"],
    tail: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " a"]]:
    """Return gap and speed of the nearest of M vehicle rears ahead (inf and 0 where there is none)."""
    count = len(at.front)
    if not len(vehicle):
        return np.full(count, np.inf), np.zeros(count)
    gap = convoy.routes.distance[:, segment] + tail - at.front[:, None]
    # The middles decide which vehicle is ahead; the index decides for two side by side.
    lead = gap + convoy.half[:, None] + convoy.half[vehicle]
    me = np.arange(count)[:, None]
    ahead = (lead > 0.05) | ((np.abs(lead) <= 0.05) & (vehicle < me))
    gap = np.where(ahead & (vehicle != me), gap, np.inf)
    nearest = gap.argmin(1)
    return gap[np.arange(count), nearest], convoy.speed[vehicle[nearest]]


def _occupied_crossing(
    convoy: Convoy, at: Footing, walked_over: tuple[Int[np.ndarray, " o"], Float[np.ndarray, " o"]]
) -> Float[np.ndarray, " a"]:
    """Return the distance to the next occupied crossing; inf without one or if it is too late to stop."""
    segment, station = walked_over
    gap = convoy.routes.distance[:, segment] + station - 1.2 - at.front[:, None]
    stoppable = (gap > -0.8) & (gap > convoy.speed[:, None] ** 2 / (2.0 * 2.0 * _STOPS_IF))
    return np.where(stoppable, gap, np.inf).min(1, initial=np.inf)


def _stop_line(convoy: Convoy, at: Footing, table: LaneTable, red: Bool[np.ndarray, " s"]) -> Float[np.ndarray, " a"]:
    """Return the distance to the stop line at which each driver must wait; inf for drivers who may go.

    Drivers wait for a red light, for priority traffic nearby, for crossing traffic inside the junction, and for a
    conflicting driver with equal right of way who is nearer to the stop line.
    """
    routes = convoy.routes
    count = len(at.front)
    me = np.arange(count)
    ahead = np.where(table.is_gate[routes.segment], routes.start - at.front[:, None], -1.0)
    ahead = np.where(ahead > 0.0, ahead, np.inf)
    leg = ahead.argmin(1)
    distance = ahead[me, leg]
    gate = routes.segment[me, leg]
    committed = distance < convoy.speed**2 / (2.0 * _STOPS_IF)
    looks = (distance < 60.0) & ~committed
    if not looks.any():
        return np.full(count, np.inf)

    to_entry = routes.distance - at.front[:, None]
    waits = (convoy.speed < 0.5) & table.yields[gate].any(1)
    soon = (to_entry > 0.0) & (to_entry < convoy.speed[:, None] * _ACCEPTED_GAP + _AT_HAND)
    soon &= ~red & ~(waits[:, None] & (to_entry >= distance[:, None] - 0.1))
    others_come = soon.sum(0) > soon
    must_yield = (table.yields[gate] & others_come).any(1)

    # Crossing traffic inside the junction, until its rear is clear.
    tail, tail_station = at.segment[:, 0], at.station[:, 0]
    middle, front = at.segment[:, 1], at.segment[:, 2]
    blocked = table.crosses[gate[:, None], tail] & (tail_station < table.clear_after[gate[:, None], tail])
    blocked |= table.crosses[gate[:, None], middle] | table.crosses[gate[:, None], front]
    gone = (middle == tail) & (tail_station >= table.clear_after[gate[:, None], tail])
    blocked &= ~gone & (me != me[:, None])

    barred = red[gate] | must_yield | blocked.any(1)
    rivals = table.crosses[gate[:, None], gate] & (distance < np.maximum(2.5, 1.5 * convoy.speed)) & ~barred
    earlier = (distance < distance[:, None]) | ((distance == distance[:, None]) & (me < me[:, None]))
    barred |= (rivals & earlier & (distance[:, None] > 0.3)).any(1)
    return np.where(barred & looks, distance, np.inf)
