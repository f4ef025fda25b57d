"""Traffic simulation of a scene: positions of the ego vehicle and all road users over time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.limits import SOME_WEIGHT, Fraction, Positive, PositiveOrZero, above_at_most
from tflane_jax.scene import RoadUser
from tflane_jax.world.roads.networks import RoadNetwork
from tflane_jax.world.traffic.demand import Trips, draw_trips
from tflane_jax.world.traffic.lane_table import LaneTable, build_lane_table
from tflane_jax.world.traffic.pedestrians import Walkers, crossing_places, draw_crossers, walk_sidewalks
from tflane_jax.world.traffic.rollout import Rollout
from tflane_jax.world.traffic.signals import Signals, draw_signals, turn_green
from tflane_jax.world.traffic.vehicles import Drivers, draw_drivers

# Time step of the warm-up, and how long before its end the ego vehicle joins, seconds.
_WARM_UP_STEP, EGO_JOINS = 0.4, 3.2
# Places tried for the ego vehicle.
_EGO_CHOICES = 6
# Its mean speed as a fraction of the free speed, and how far from the middle of its route it may aim, metres.
_EGO_PACE, _EGO_AIM = 0.95, 20.0


@dataclass(frozen=True)
class TrafficConfig:
    """Amount and composition of the traffic.

    Attributes:
        vehicles_per_metre: mean density on a lane in free flow, up to what junctions let in: above about 0.05 it
            changes little; 0: no moving motor vehicles but the ego.
        category_share: relative frequencies of the categories of moving motor vehicles.
        bicycles_per_metre: on bike lanes; slow outer lanes get half of the corresponding fraction of their traffic.
        parked_share: fraction of the parking slots that are occupied.
        pedestrians_per_metre: pedestrians on a metre of sidewalk.
        crossers_per_minute: crossing pedestrians, for each crossing.
        ego_top_speed: highest speed of the ego vehicle, m/s.
        ego_passes_s: time at which the ego vehicle passes the middle of its route, so the central feature of the roads,
            up to 20 m and what traffic allows, seconds after the first frame; None starts it anywhere on the route.
        variety: how much the amounts differ between scenes: moving vehicles, parked vehicles and pedestrians of a
            scene are each multiplied by exp(variety * z - variety^2 / 2), z standard normal, so that the means stay
            (of moving vehicles, what is asked for).
        green_wave: probability that the first light on the ego vehicle's way turns green about when the log begins.
        range: distance from the ego vehicle up to which road users exist, metres; the tracker has its own.
        warm_up_s: time for which traffic settles before the log begins, seconds: at least 3.2, when the ego vehicle
            joins.
        early_s: time before the warm-up from which vehicles are on their way, seconds: a slow drive through the map.
        step_s: largest time step, seconds; frames within a step assume constant acceleration. Drivers who decide less
            often than once a second run into each other.
    """

    vehicles_per_metre: PositiveOrZero = 0.032
    category_share: Annotated[tuple[tuple[RoadUser, PositiveOrZero], ...], SOME_WEIGHT] = (
        (RoadUser.CAR, 0.79),
        (RoadUser.TRUCK, 0.1),
        (RoadUser.BUS, 0.05),
        (RoadUser.MOTORCYCLE, 0.06),
    )
    bicycles_per_metre: PositiveOrZero = 0.012
    parked_share: Fraction = 0.55
    pedestrians_per_metre: PositiveOrZero = 0.015
    crossers_per_minute: PositiveOrZero = 3.0
    variety: Fraction = 0.0
    ego_top_speed: Positive = 14.0
    ego_passes_s: Positive | None = None
    green_wave: Fraction = 0.6
    range: Positive = 90.0
    warm_up_s: PositiveOrZero = 20.0
    early_s: PositiveOrZero = 40.0
    step_s: Annotated[float, above_at_most(0, 1)] = 0.2


@dataclass(frozen=True)
class Traffic:
    """N road users over F frames, global metres and radians.

    Attributes:
        xy: (F, N, 2) box centers.
        yaw: (F, N).
        present: (F, N).
        size: (N, 3) length, width, height.
        category: (N,) `RoadUser`.
        ego: (F, 3) x, y, yaw of the ego vehicle, which is not among the N.
        on_route: number of frames until the ego vehicle comes to the end of its route.
        signals: traffic lights; t = 0 is the first frame.
        on_roads: number of frames until the ego vehicle comes to the end of the roads, where it then stays.
    """

    xy: Float[np.ndarray, "f n 2"]
    yaw: Float[np.ndarray, "f n"]
    present: Bool[np.ndarray, "f n"]
    size: Float[np.ndarray, "n 3"]
    category: Int[np.ndarray, " n"]
    ego: Float[np.ndarray, "f 3"]
    on_route: int
    signals: Signals
    on_roads: int


def simulate_traffic(
    rng: np.random.Generator, network: RoadNetwork, config: TrafficConfig, *, frames: int, rate_hz: float
) -> Traffic:
    """Let traffic settle, then record `frames` frames."""
    config = _varied(rng, config)
    table = build_lane_table(network)
    times = np.arange(frames) / rate_hz
    stop = times[-1] if frames else 0.0
    steps = max(round((config.warm_up_s - EGO_JOINS) / _WARM_UP_STEP), 0)
    start = -(steps * _WARM_UP_STEP + EGO_JOINS)

    index = {int(segment): i for i, segment in enumerate(table.ids)}
    way = tuple(index[i] for i in network.ego_routes[rng.integers(len(network.ego_routes))])
    signals = _signals_for_ego(rng, table, way, config.green_wave)
    trips = draw_trips(
        rng,
        table,
        way,
        start=start - config.early_s,
        stop=stop + 5.0,
        vehicles_per_metre=config.vehicles_per_metre,
        bicycles_per_metre=config.bicycles_per_metre,
        category_share=config.category_share,
        junctions=network.junctions,
    )
    drive = network.drive
    trips.drivers.top_speed[0] = config.ego_top_speed if drive is None else min(config.ego_top_speed, drive.top_speed)
    crossers = draw_crossers(rng, network.walk_across, start=start, stop=stop, per_minute=config.crossers_per_minute)
    places = crossing_places(network.walk_across, table)
    road = Rollout(table, signals, trips, crossers, places, len(network.walk_across))
    road.place_early_trips(start)
    road.drive(start, _WARM_UP_STEP, steps, 1)
    road.put_ego(_ego_starts(rng, road, stop + EGO_JOINS, config.ego_passes_s, None if drive is None else drive.aim))
    road.drive(-EGO_JOINS, _WARM_UP_STEP, round(EGO_JOINS / _WARM_UP_STEP), 1)

    position, progress = _driven_frames(road, frames, rate_hz, config.step_s)
    # Most trips end before the log begins or start after it ends; the ego vehicle's is the first.
    here = ((position >= 0.0) & (position <= road.trips.routes.length)).any(0)
    rows = np.flatnonzero(here | (np.arange(position.shape[1]) == 0))
    driven = _driven(road.trips.take(rows), road.table, position[:, rows])
    walking = [walk_sidewalks(rng, network.sidewalks, times, config.pedestrians_per_metre)]
    walking.append(crossers.paths(progress))
    return _assemble(rng, network, config, driven, walking, _on_way(road, len(way), position[:, 0]), signals)


def _driven_frames(
    road: Rollout, frames: int, rate_hz: float, step_s: float
) -> tuple[Float[np.ndarray, "f n"], Float[np.ndarray, "f p"]]:
    """Return positions and the pedestrians' progress in every frame, with steps of at most `step_s` seconds."""
    substeps = int(step_s * rate_hz + 1e-9)
    if substeps:
        found = road.drive(0.0, substeps / rate_hz, -(-frames // substeps), substeps)
        return found[0][:frames], found[1][:frames]
    steps = math.ceil(1.0 / (step_s * rate_hz) - 1e-9)
    position, progress = road.drive(0.0, 1.0 / (steps * rate_hz), frames * steps, 1)
    return position[::steps], progress[::steps]


def _on_way(road: Rollout, legs: int, position: Float[np.ndarray, " f"]) -> tuple[int, int]:
    """Return for how many frames the ego vehicle is on the first legs of its route, and for how many on all of it.

    What follows the first legs leads to the border.
    """
    start, length = road.trips.routes.start[0], road.trips.routes.length[0]
    end = start[legs] if legs < len(start) and np.isfinite(start[legs]) else length
    on_legs, on_all = (int(np.append(np.flatnonzero(position >= x), len(position))[0]) for x in (end, length))
    return on_legs, on_all


def _varied(rng: np.random.Generator, config: TrafficConfig) -> TrafficConfig:
    """Draw the amounts of one scene."""
    if config.variety == 0.0:
        return config
    vehicles, parked, people = np.exp(config.variety * rng.standard_normal(3) - 0.5 * config.variety**2)
    return replace(
        config,
        vehicles_per_metre=vehicles * config.vehicles_per_metre,
        bicycles_per_metre=vehicles * config.bicycles_per_metre,
        parked_share=min(parked * config.parked_share, 1.0),
        pedestrians_per_metre=people * config.pedestrians_per_metre,
        crossers_per_minute=people * config.crossers_per_minute,
    )


def _signals_for_ego(rng: np.random.Generator, table: LaneTable, way: tuple[int, ...], green_wave: float) -> Signals:
    """Draw signals; with probability `green_wave` the ego route's first one turns green about when the log begins."""
    signals = draw_signals(rng, table)
    favoured, when = rng.random() < green_wave, rng.uniform(-5.0, 1.0)
    governed = [i for i in way if table.intersection[i] >= 0]
    if favoured and governed:
        return turn_green(signals, int(table.intersection[governed[0]]), int(table.phase[governed[0]]), when)
    return signals


def _ego_starts(
    rng: np.random.Generator, road: Rollout, duration: float, passes_s: float | None, middle: float | None
) -> Float[np.ndarray, " c"]:
    """Draw candidate start positions on the ego route: early enough to stay on it, and not inside a junction.

    Args:
        rng, road: stream and traffic.
        duration: of the drive, seconds.
        passes_s: see `TrafficConfig.ego_passes_s`.
        middle: where it then is on its route, metres; None for half of the route.
    """
    routes, table = road.trips.routes, road.table
    way = routes.segment[0, np.isfinite(routes.start[0])]
    speed = min(float(np.median(table.speed_at_start[way])), road.trips.drivers.top_speed[0])
    # The continuation of the route to the border of the map must not be driven; 50 m is more than half of it.
    starts = rng.uniform(5.0, max(routes.length[0] - 50.0 - speed * duration, 10.0), _EGO_CHOICES)
    if passes_s is not None:
        aim = (0.5 * routes.length[0] if middle is None else middle) + rng.uniform(-_EGO_AIM, _EGO_AIM, _EGO_CHOICES)
        rows = np.flatnonzero(road.active)
        on_way = rows[np.isin(routes.take(rows).place(road.position[rows])[0], way)]
        if len(on_way):
            speed = min(speed, float(road.speed[on_way].mean()))
        starts = np.maximum(aim - _EGO_PACE * speed * (EGO_JOINS + passes_s), 5.0)
    for i, at in enumerate(starts):
        leg = int((routes.start[0] <= at).sum()) - 1
        while leg > 0 and table.is_gate[routes.segment[0, leg]]:
            starts[i] = routes.start[0, leg] - 4.0
            leg -= 1
    return np.maximum(starts, 3.0)


@dataclass(frozen=True)
class _Driven:
    """Vehicles of N trips over F frames: box centers, headings, presence, sizes and categories."""

    xy: Float[np.ndarray, "f n 2"]
    yaw: Float[np.ndarray, "f n"]
    present: Bool[np.ndarray, "f n"]
    drivers: Drivers


def _driven(trips: Trips, table: LaneTable, position: Float[np.ndarray, "f n"]) -> _Driven:
    """Return the vehicles at distances along their routes: front and rear wheels stay on the lane."""
    routes, drivers = trips.routes, trips.drivers
    present = (position >= 0.0) & (position <= routes.length)
    at = np.where(present, position, 0.0)
    # Others leave the scene at the end of their routes; the ego vehicle stays there.
    at[:, 0] = np.clip(position[:, 0], 0.0, routes.length[0])
    wheelbase = 0.6 * drivers.size[:, 0]
    axles = at[..., None] + wheelbase[:, None] * np.array([-0.5, 0.5])
    segment, station = routes.place(axles.transpose(1, 0, 2))
    xy, heading = table.locate(segment, station)
    # The lateral oscillation is a function of distance, so that a standing vehicle does not slide.
    sway = drivers.offset[:, None, None] + drivers.wander[:, None, None] * np.sin(
        axles.transpose(1, 0, 2) / 11.0 + drivers.phase[:, None, None]
    )
    xy = xy + sway[..., None] * np.stack([-np.sin(heading), np.cos(heading)], -1)
    middle, axis = xy.mean(2), xy[:, :, 1] - xy[:, :, 0]
    return _Driven(middle.transpose(1, 0, 2), np.arctan2(axis[..., 1], axis[..., 0]).T, present, drivers)


def _assemble(
    rng: np.random.Generator,
    network: RoadNetwork,
    config: TrafficConfig,
    driven: _Driven,
    walking: list[Walkers],
    on_way: tuple[int, int],
    signals: Signals,
) -> Traffic:
    """Join vehicles, parked vehicles and pedestrians; drop those that never come near the ego vehicle."""
    xy, yaw, present, drivers = driven.xy, driven.yaw, driven.present, driven.drivers
    frames = len(xy)
    slots = network.parking[rng.random(len(network.parking)) < config.parked_share]
    lorry = rng.random(len(slots)) < 0.06
    parked = draw_drivers(rng, np.where(lorry, RoadUser.TRUCK, RoadUser.CAR))
    # Slots are 6.5 m long, so only vans and light trucks park there.
    parked.size[:, 0] = np.minimum(parked.size[:, 0], 6.0)
    slots = slots + np.stack([0.3 * parked.offset, parked.wander * 0.3, 0.05 * parked.wander], -1)
    people = draw_drivers(rng, np.full(sum(w.xy.shape[1] for w in walking), int(RoadUser.PEDESTRIAN)))

    def still(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, (frames, *values.shape))

    xy = np.concatenate([xy, still(slots[:, :2]), *(w.xy for w in walking)], 1)
    yaw = np.concatenate([yaw, still(slots[:, 2]), *(w.yaw for w in walking)], 1)
    present = np.concatenate([present, still(np.ones(len(slots), bool)), *(w.present for w in walking)], 1)
    size = np.concatenate([drivers.size, parked.size, people.size])
    category = np.concatenate([drivers.category, parked.category, people.category])
    ego = np.concatenate([xy[:, 0], yaw[:, :1]], -1)
    present = present & (np.hypot(*(xy - ego[:, None, :2]).transpose(2, 0, 1)) < config.range)
    present[:, 0] = False
    seen = present.any(0)
    on_route, on_roads = on_way
    moving = xy[:, seen], yaw[:, seen], present[:, seen]
    return Traffic(*moving, size[seen], category[seen], ego, on_route, signals, on_roads)
