"""Sizes and driving styles of the road users of the built-in world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.scene import RoadUser

Range = tuple[float, float]


@dataclass(frozen=True)
class Profile:
    """Ranges of one road-user category, from which every road user draws its values.

    Attributes:
        length, width, height: metres.
        eagerness: desired speed as a fraction of the speed limit.
        top_speed: m/s, whatever the limit.
        acceleration: largest, m/s^2 (IDM a).
        headway: desired time gap to the leader, seconds (IDM T).
        wander: largest distance from the middle of the lane, metres.
    """

    length: Range
    width: Range
    height: Range
    eagerness: Range
    top_speed: float
    acceleration: Range
    headway: Range
    wander: float


PROFILES: dict[RoadUser, Profile] = {
    RoadUser.CAR: Profile((3.9, 5.1), (1.72, 1.98), (1.42, 1.9), (0.85, 1.12), 30.0, (1.4, 2.4), (0.9, 1.7), 0.28),
    RoadUser.TRUCK: Profile((6.5, 9.8), (2.25, 2.42), (2.8, 3.9), (0.72, 0.95), 22.0, (0.8, 1.3), (1.4, 2.2), 0.14),
    RoadUser.BUS: Profile((10.5, 12.2), (2.35, 2.45), (3.0, 3.5), (0.72, 0.92), 20.0, (0.8, 1.2), (1.4, 2.0), 0.1),
    RoadUser.MOTORCYCLE: Profile((2.0, 2.3), (0.7, 0.9), (1.4, 1.7), (0.9, 1.15), 32.0, (2.0, 3.0), (0.9, 1.5), 0.5),
    RoadUser.BICYCLE: Profile((1.6, 1.85), (0.5, 0.65), (1.6, 1.85), (1.0, 1.0), 5.5, (0.7, 1.1), (0.8, 1.4), 0.2),
    RoadUser.PEDESTRIAN: Profile((0.45, 0.7), (0.45, 0.75), (1.5, 1.95), (1.0, 1.0), 1.5, (1.0, 1.0), (1.0, 1.0), 0.4),
}


@dataclass(frozen=True)
class Drivers:
    """Sizes and styles of N road users; the attributes are those of `Profile`, one value each.

    Attributes:
        category: (N,) `RoadUser`.
        size: (N, 3) length, width, height, metres.
        eagerness, top_speed, acceleration, headway: (N,).
        wander: (N,) signed amplitude of the lateral oscillation in the lane, metres.
        offset: (N,) mean distance to the left of the middle of the lane, metres.
        phase: (N,) initial phase of that oscillation, radians.
    """

    category: Int[np.ndarray, " n"]
    size: Float[np.ndarray, "n 3"]
    eagerness: Float[np.ndarray, " n"]
    top_speed: Float[np.ndarray, " n"]
    acceleration: Float[np.ndarray, " n"]
    headway: Float[np.ndarray, " n"]
    wander: Float[np.ndarray, " n"]
    offset: Float[np.ndarray, " n"]
    phase: Float[np.ndarray, " n"]

    def take(self, rows: Int[np.ndarray, " m"]) -> Drivers:
        """Return some of them."""
        return Drivers(**{name: values[rows] for name, values in vars(self).items()})


def draw_drivers(rng: np.random.Generator, category: Int[np.ndarray, " n"]) -> Drivers:
    """Draw one road user for each given category. The number of draws from `rng` depends on N alone."""
    n = len(category)
    profiles = [PROFILES[RoadUser(c)] for c in category]
    fraction = rng.random((9, n))

    def draw(row: int, ranges: list[Range]) -> Float[np.ndarray, " n"]:
        low, high = np.array(ranges).reshape(n, 2).T
        return low + fraction[row] * (high - low)

    limit = np.array([p.wander for p in profiles])
    return Drivers(
        category=np.asarray(category, np.int32),
        size=np.stack(
            [
                draw(0, [p.length for p in profiles]),
                draw(1, [p.width for p in profiles]),
                draw(2, [p.height for p in profiles]),
            ],
            -1,
        ),
        eagerness=draw(3, [p.eagerness for p in profiles]),
        top_speed=np.array([p.top_speed for p in profiles])
        * (1.0 - 0.3 * fraction[3] * (category >= RoadUser.BICYCLE)),
        acceleration=draw(4, [p.acceleration for p in profiles]),
        headway=draw(5, [p.headway for p in profiles]),
        # Half of the lateral range is a constant offset, half is oscillation.
        wander=0.5 * limit * (2.0 * fraction[6] - 1.0),
        offset=0.5 * limit * (2.0 * fraction[7] - 1.0),
        phase=2.0 * np.pi * fraction[8],
    )
