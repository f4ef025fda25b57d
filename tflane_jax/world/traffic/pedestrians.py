"""Pedestrians on sidewalks, and on crossings when traffic permits."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.world.traffic.lane_table import LaneTable

# Distance from the kerb at which crossing pedestrians appear and vanish, metres.
_APPROACH = 4.0


@dataclass(frozen=True)
class Walkers:
    """Positions of P pedestrians over F frames, global metres and radians."""

    xy: Float[np.ndarray, "f p 2"]
    yaw: Float[np.ndarray, "f p"]
    present: Bool[np.ndarray, "f p"]


def walk_sidewalks(
    rng: np.random.Generator,
    sidewalks: tuple[Float[np.ndarray, "_ 2"], ...],
    times: Float[np.ndarray, " f"],
    per_metre: float,
) -> Walkers:
    """Draw pedestrians who walk along the lines at constant speed, one in eight standing still.

    A pedestrian is present while between the ends of its line."""
    parts = []
    for line in sidewalks:
        step = np.diff(line, axis=0)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
        count = rng.poisson(per_metre * along[-1])
        start, pace, side, forward, stands = rng.random((5, count))
        sign = np.where(forward < 0.5, 1.0, -1.0)
        speed = sign * (0.9 + 0.8 * pace) * (stands > 0.125)
        at = start * along[-1] + times[:, None] * speed
        heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        direction = np.interp(at, 0.5 * (along[1:] + along[:-1]), heading)
        offset = 1.2 * (side - 0.5)
        x = np.interp(at, along, line[:, 0]) - offset * np.sin(direction)
        y = np.interp(at, along, line[:, 1]) + offset * np.cos(direction)
        yaw = direction + np.where(sign > 0, 0.0, np.pi)
        parts.append((np.stack([x, y], -1), yaw, (at > 0.0) & (at < along[-1])))
    if not parts:
        return Walkers(np.zeros((len(times), 0, 2)), np.zeros((len(times), 0)), np.zeros((len(times), 0), bool))
    return Walkers(*(np.concatenate(arrays, 1) for arrays in zip(*parts, strict=True)))


@dataclass(frozen=True)
class CrossingPlaces:
    """Where lanes pass over the C pedestrian crossings: O places.

    Attributes:
        segment, station: (O,) place on the lane.
        crossing: (O,) which crossing.
        along: (O,) distance along the crossing's walk, metres.
    """

    segment: Int[np.ndarray, " o"]
    station: Float[np.ndarray, " o"]
    crossing: Int[np.ndarray, " o"]
    along: Float[np.ndarray, " o"]


def crossing_places(walks: tuple[Float[np.ndarray, "2 2"], ...], table: LaneTable) -> CrossingPlaces:
    """Intersect the walks with the centerlines."""
    if not walks:
        return CrossingPlaces(np.zeros(0, np.intp), np.zeros(0), np.zeros(0, np.intp), np.zeros(0))
    start, stop = np.stack(walks).transpose(1, 0, 2)
    length = np.hypot(*(stop - start).T)
    ahead = (stop - start) / length[:, None]
    offset = table.xy - start[:, None]
    along = (offset * ahead[:, None]).sum(-1)
    across = offset[..., 0] * -ahead[:, None, 1] + offset[..., 1] * ahead[:, None, 0]
    owner = np.searchsorted(table.first_vertex, np.arange(len(table.axis)), side="right") - 1
    inner = owner[1:] == owner[:-1]
    crossing, vertex = np.nonzero((across[:, 1:] * across[:, :-1] < 0.0) & inner)
    a, b = across[crossing, vertex], across[crossing, vertex + 1]
    fraction = a / (a - b)
    at = along[crossing, vertex] * (1.0 - fraction) + along[crossing, vertex + 1] * fraction
    segment = owner[vertex]
    station = (vertex - table.first_vertex[segment] + fraction) * table.step[segment]
    inside = (at > 0.0) & (at < length[crossing])
    return CrossingPlaces(segment[inside], station[inside], crossing[inside], at[inside])


@dataclass
class Crossers:
    """P pedestrians who approach a crossing, wait until it is free, and cross.

    Attributes:
        start, ahead: (P, 2) where the walk starts and its direction.
        length: (P,) of the walk, metres.
        crossing: (P,) which one.
        forward: (P,) in the direction of the crossing's walk, not against it.
        pace: (P,) m/s.
        progress: (P,) metres walked since the kerb; negative before it.
        side: (P,) distance to the left of the walk, metres.
    """

    start: Float[np.ndarray, "p 2"]
    ahead: Float[np.ndarray, "p 2"]
    length: Float[np.ndarray, " p"]
    crossing: Int[np.ndarray, " p"]
    forward: Bool[np.ndarray, " p"]
    pace: Float[np.ndarray, " p"]
    progress: Float[np.ndarray, " p"]
    side: Float[np.ndarray, " p"]
    history: list[Float[np.ndarray, " p"]] = field(default_factory=list)

    def advance(self, dt: float, busy: Bool[np.ndarray, " c"]) -> None:
        """Advance by `dt` seconds; pedestrians at the kerb of a busy crossing wait."""
        onward = self.progress + self.pace * dt
        waits = (self.progress <= 0.0) & (onward > 0.0) & busy[self.crossing]
        self.progress = np.where(waits, self.progress, onward)

    def in_the_way(self, places: CrossingPlaces) -> Bool[np.ndarray, " o"]:
        """Return the places on the lanes that a pedestrian occupies or is about to reach."""
        walked = np.where(self.forward, self.progress, self.length - self.progress)
        sign = np.where(self.forward, 1.0, -1.0)
        ahead = (places.along[:, None] - walked) * sign
        walking = (self.progress > 0.0) & (self.progress < self.length)
        same = places.crossing[:, None] == self.crossing
        return (same & walking & (ahead > -2.2) & (ahead < 4.5)).any(1)

    def paths(self, progress: Float[np.ndarray, "f p"]) -> Walkers:
        """Return positions and headings for given progress."""
        left = np.stack([-self.ahead[:, 1], self.ahead[:, 0]], -1)
        xy = self.start + progress[..., None] * self.ahead + (self.side[:, None] * left)
        yaw = np.broadcast_to(np.arctan2(self.ahead[:, 1], self.ahead[:, 0]), progress.shape)
        return Walkers(xy, yaw.copy(), (progress > -_APPROACH) & (progress < self.length + _APPROACH))


def draw_crossers(
    rng: np.random.Generator,
    walks: tuple[Float[np.ndarray, "2 2"], ...],
    *,
    start: float,
    stop: float,
    per_minute: float,
) -> Crossers:
    """Draw the pedestrians who come to each crossing between two times (seconds), `per_minute` for each crossing."""
    count = rng.poisson(per_minute * (stop - start) / 60.0, len(walks))
    crossing = np.repeat(np.arange(len(walks)), count)
    when, pace, forward, side = rng.random((4, len(crossing)))
    ends = np.stack(walks)[crossing] if len(walks) else np.zeros((0, 2, 2))
    onward = forward < 0.5
    first = np.where(onward[:, None], ends[:, 0], ends[:, 1])
    step = np.where(onward[:, None], ends[:, 1], ends[:, 0]) - first
    length = np.hypot(*step.T)
    pace = 1.0 + 0.7 * pace
    return Crossers(
        start=first,
        ahead=step / np.maximum(length, 1e-9)[:, None],
        length=length,
        crossing=crossing,
        forward=onward,
        pace=pace,
        progress=-pace * when * (stop - start),
        side=1.6 * (side - 0.5),
    )
