"""Random draws common to all scene kinds: cross-sections and bends of streets, and the arms of intersections."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import LineType
from tflane_jax.world.roads.config import Markings, Range, RoadConfig
from tflane_jax.world.roads.cross_sections import Place, SidePlan
from tflane_jax.world.roads.curves import direction, right_of
from tflane_jax.world.roads.intersections import Arm
from tflane_jax.world.roads.streets import StreetPlan

# A raised median keeps at least this width beside a turning lane carved out of it, metres.
LEAST_MEDIAN = 1.2


@dataclass(frozen=True)
class StreetStyle:
    """Cross-section of a street along a heading.

    Attributes:
        forward, backward: its two sides.
        median: width of the raised median, 0 without one, metres.
        speed: limit, m/s.
    """

    forward: SidePlan
    backward: SidePlan
    median: float
    speed: float

    def reversed(self) -> StreetStyle:
        """Return the same street seen against its heading."""
        return replace(self, forward=self.backward, backward=self.forward)

    @property
    def axis_shift(self) -> float:
        """How far the axis must move to the left for the road to lie in the middle, metres."""
        return 0.5 * float(self.forward.kerb(0.0) - self.backward.kerb(0.0))


@dataclass(frozen=True)
class ArmPlan:
    """A street from an intersection to the border of the map.

    Attributes:
        origin: where its axis starts, metres.
        heading: outwards, radians.
        style: seen outwards: `forward` leads out, `backward` in (with turning lanes).
        crossing: width of its pedestrian crossing, 0 without one.
        minor: its traffic gives way.
        no_left: left turns are forbidden.
        bend: turn of the axis beyond the intersection, radians, and the radius at which it turns, metres.
    """

    origin: Float[np.ndarray, "2"]
    heading: float
    style: StreetStyle
    crossing: float
    minor: bool
    no_left: bool
    bend: tuple[float, float]

    @property
    def arm(self) -> Arm:
        """Its geometry at the intersection."""
        style = self.style
        return Arm(
            self.origin,
            self.heading,
            style.backward.kerb_before_junction(),
            float(style.forward.kerb(0.0)),
            self.crossing,
        )

    def street(self, stop_distance: float, config: RoadConfig) -> StreetPlan:
        """Return the plan of the street that starts at the intersection's stop distance."""
        return StreetPlan(
            origin=self.origin,
            heading=self.heading,
            start=stop_distance,
            stop=config.reach,
            forward=self.style.forward,
            backward=self.style.backward,
            speed=self.style.speed,
            ego=(0.0, config.ego_reach),
            bends=bend_knots(stop_distance + 6.0, *self.bend),
            stops_at_start=True,
        )


def bend_knots(start: float, turn: float, radius: float) -> tuple[tuple[float, float], ...]:
    """Return curvature knots of a bend by `turn` radians: clothoid, arc of `radius`, clothoid."""
    peak = np.copysign(1.0 / radius, turn)
    length = abs(turn) * radius
    ramp = min(20.0, length)
    # Two clothoids of length `ramp` together turn by ramp / radius; the arc between them turns by the rest.
    arc = max(length - ramp, 0.0)
    stations = np.cumsum([start, ramp, arc, ramp])
    return tuple(zip(stations.tolist(), (0.0, float(peak), float(peak), 0.0), strict=True))


def draw(rng: np.random.Generator, span: Range) -> float:
    """Return a uniform draw."""
    return float(rng.uniform(*span))


def chance(rng: np.random.Generator, probability: float) -> bool:
    """Return True with a probability."""
    return bool(rng.random() < probability)


def draw_marking(rng: np.random.Generator, markings: Markings) -> LineType:
    """Return one of some markings; of a single one, nothing is drawn."""
    if len(markings) == 1:
        return markings[0][0]
    weight = np.array([weight for _, weight in markings])
    return markings[int(rng.choice(len(weight), p=weight / weight.sum()))][0]


def draw_style(
    rng: np.random.Generator,
    config: RoadConfig,
    lanes: tuple[int, int],
    *,
    speed: Range,
    median: Range | None = None,
    strips: float = 1.0,
) -> StreetStyle:
    """Draw the cross-section of a street with the given lanes per direction (0 = one-way).

    Args:
        rng: stream.
        config: ranges.
        lanes: forward, backward.
        speed: range of the limit.
        median: range of the raised median, None without one.
        strips: factor on the probabilities of bike lanes and parking strips.
    """
    single = config.single_lane_width if max(lanes) == 1 else None
    lane_width = draw(rng, config.lane_width if single is None else single)
    gutter = draw(rng, config.gutter)
    width = draw(rng, median) if median and min(lanes) > 0 else 0.0
    bike = draw(rng, config.bike_width) if chance(rng, strips * config.bike) else 0.0
    parking = draw(rng, config.parking_width)
    parked = [chance(rng, strips * config.parking) for _ in range(2)]
    markings = (draw_marking(rng, m) for m in (config.inner_marking, config.outer_marking, config.divider_marking))
    inner_marking, outer_marking, divider_marking = markings
    kerb_marking = None if config.kerb_marking is None else draw_marking(rng, config.kerb_marking)
    inner_kerb = width > 0.0 or min(lanes) == 0
    sides = [
        SidePlan(
            lanes=n,
            lane_width=lane_width,
            inner=0.5 * width,
            bike=bike if n else 0.0,
            parking=parking if n and p else 0.0,
            gutter=gutter,
            inner_marking=inner_marking if kerb_marking is None or not inner_kerb else kerb_marking,
            outer_marking=outer_marking if kerb_marking is None or bike or p else kerb_marking,
            divider_marking=divider_marking,
        )
        for n, p in zip(lanes, parked, strict=True)
    ]
    return StreetStyle(sides[0], sides[1], width, draw(rng, speed))


def left_pocket(style: StreetStyle) -> Place:
    """Return where a left-turning lane is placed: in the median if that is wide enough."""
    return Place.MEDIAN if style.median >= style.forward.lane_width + LEAST_MEDIAN else Place.LEFT


def centered(center: Float[np.ndarray, "2"], heading: float, style: StreetStyle) -> Float[np.ndarray, "2"]:
    """Return the origin of the axis that puts the middle of the road on `center`."""
    return np.asarray(center) - style.axis_shift * right_of(heading)


def along(center: Float[np.ndarray, "2"], heading: float, distance: float) -> Float[np.ndarray, "2"]:
    """Return the point at a distance in a direction."""
    return np.asarray(center) + distance * direction(heading)
