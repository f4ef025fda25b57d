"""Vehicles of a front view: positions, and their shadows on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.limits import Fraction, Range, Shares
from tflane_jax.scene import RoadUser
from tflane_jax.world.front_view.road import Highway
from tflane_jax.world.traffic.vehicles import draw_drivers

_CATEGORIES = (RoadUser.CAR, RoadUser.TRUCK, RoadUser.BUS, RoadUser.MOTORCYCLE)
_SHOWN = 200.0  # farther vehicles are not drawn, metres
_GAP, _LONGEST = 4.0, 12.2  # between vehicles at least, and the longest of them, metres


@dataclass(frozen=True)
class FrontTrafficConfig:
    """Traffic of a front view.

    Attributes:
        empty: probability of a road without traffic.
        density: vehicles per metre of lane.
        clear_ahead: free road ahead of the ego, metres.
        categories: relative frequencies of cars, trucks, buses and motorcycles.
    """

    empty: Fraction = 0.06
    density: Range = (0.003, 0.03)
    clear_ahead: Range = (6.0, 50.0)
    categories: Shares = (0.8, 0.14, 0.03, 0.03)


@dataclass(frozen=True)
class FrontTraffic:
    """Vehicles on the ground of the ego frame.

    Attributes:
        xy: (k, 2) centers, metres.
        yaw: (k,) radians.
        size: (k, 3) length, width, height, metres.
        category: (k,) `RoadUser`.
        look: (k, 4) 0 to 1, random numbers that choose colour and shape.
    """

    xy: Float[np.ndarray, "k 2"]
    yaw: Float[np.ndarray, " k"]
    size: Float[np.ndarray, "k 3"]
    category: Int[np.ndarray, " k"]
    look: Float[np.ndarray, "k 4"]


def draw_traffic(rng: np.random.Generator, road: Highway, config: FrontTrafficConfig) -> FrontTraffic:
    """Draw the traffic around the ego; the same stream, road and config give the same bits."""
    density = 0.0 if rng.random() < config.empty else rng.uniform(*config.density)
    ego_lane = int(np.argmin(np.abs(road.lanes - road.ego_offset)))
    ahead = rng.uniform(*config.clear_ahead)
    places = []
    for ours, lanes in ((True, road.lanes), (False, road.oncoming)):
        for number, offset in enumerate(lanes):
            s = ahead if ours and number == ego_lane else rng.uniform(-6.0, 20.0)
            while density:
                s += _GAP + rng.exponential(1.0 / density)
                if s > _SHOWN:
                    break
                places.append((s, offset, ours))
                s += _LONGEST
    table = np.array(places, np.float64).reshape(-1, 3)
    probability = np.asarray(config.categories) / np.sum(config.categories)
    category = np.array(_CATEGORIES, np.int32)[rng.choice(len(_CATEGORIES), len(table), p=probability)]
    drivers = draw_drivers(rng, category)
    s, ours = table[:, 0] + 0.5 * drivers.size[:, 0], table[:, 2] > 0.0
    _, heading = road.axis.at(s)
    return FrontTraffic(
        xy=road.at(s, table[:, 1] - drivers.offset),
        yaw=heading + np.where(ours, 0.0, np.pi),
        size=drivers.size,
        category=category,
        look=rng.random((len(table), 4)),
    )


def ground_shadows(
    traffic: FrontTraffic, sun: Float[np.ndarray, "3"]
) -> tuple[list[Float[np.ndarray, "8 2"]], list[Float[np.ndarray, "4 2"]]]:
    """Return points whose convex hull is the cast shadow of each vehicle, and corners of the dark area below it."""
    cast, below = [], []
    for xy, yaw, size in zip(traffic.xy, traffic.yaw, traffic.size, strict=True):
        corners = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1.0]]) * size[:2]
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        foot = corners @ turn + xy
        roof = (corners * 0.9) @ turn + xy - sun[:2] / max(sun[2], 0.05) * 0.92 * size[2]
        cast.append(np.concatenate([foot, roof]))
        below.append((corners * [1.02, 1.0]) @ turn + xy)
    return cast, below
