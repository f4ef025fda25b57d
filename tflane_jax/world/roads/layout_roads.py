"""Plans of networks without intersections: roads, changing lane counts, ramps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.cross_sections import ExtraLane, Place, SidePlan
from tflane_jax.world.roads.layouts import StreetStyle, centered, chance, draw, draw_style, left_pocket
from tflane_jax.world.roads.streets import StreetPlan

# Roads extend beyond the map by this much, because bends bring their ends nearer to its center, metres.
_BEYOND = 14.0
_LONGEST_ARC = 90.0


@dataclass(frozen=True)
class RampPlan:
    """A one-lane ramp at the first extra lane of a road's forward side.

    Attributes:
        enters: the ramp leads onto the road (else it leaves it).
        turn: angle between the ramp's far end and the road, radians.
        radius: of its arc, metres.
        speed: limit, m/s.
    """

    enters: bool
    turn: float
    radius: float
    speed: float


@dataclass(frozen=True)
class RoadPlan:
    """A road through the map.

    Attributes:
        street: the road.
        style: its cross-section.
        ramp: a ramp beside it.
        crossing: station of a mid-block pedestrian crossing and its width, metres.
        urban: pedestrians walk beside it, and buildings are close to it.
    """

    street: StreetPlan
    style: StreetStyle
    ramp: RampPlan | None = None
    crossing: tuple[float, float] | None = None
    urban: bool = True


def plan_road(rng: np.random.Generator, kind: SceneKind, config: RoadConfig) -> RoadPlan:
    """Draw a road of a kind without intersections."""
    if kind is SceneKind.ROAD:
        return _plan_plain(rng, config)
    if kind in (SceneKind.LANE_DROP, SceneKind.LANE_GAIN):
        return _plan_changing(rng, kind, config)
    return _plan_ramp(rng, kind, config)


def _plan_plain(rng: np.random.Generator, config: RoadConfig) -> RoadPlan:
    lanes = int(rng.integers(1, 4))
    backward = 0 if chance(rng, config.one_way) else int(np.clip(lanes + rng.integers(-1, 2), 1, 3))
    median = None
    if lanes + backward > 2 and chance(rng, config.median):
        median = config.wide_median if chance(rng, 0.4) else config.narrow_median
    style = draw_style(
        rng, config, (max(lanes, 2 if not backward else 1), backward), speed=config.urban_speed, median=median
    )
    street = _through(style, _winding(rng, config, config.bend_radius), rng, config)
    crossing = None
    if chance(rng, config.mid_block_crossing):
        crossing = (draw(rng, (-30.0, 30.0)), draw(rng, config.crossing_width))
    return RoadPlan(street, style, crossing=crossing)


def _plan_changing(rng: np.random.Generator, kind: SceneKind, config: RoadConfig) -> RoadPlan:
    """Draw a road on which one forward lane opens or closes near the middle."""
    fast = chance(rng, 0.5)
    lanes = int(rng.integers(1, 3))
    backward = 0 if chance(rng, config.one_way) else lanes
    median = config.wide_median if backward and chance(rng, 0.5) else None
    style = draw_style(
        rng,
        config,
        (lanes, backward),
        median=median,
        strips=0.0,
        speed=config.fast_speed if fast else config.urban_speed,
    )
    place = Place.RIGHT if chance(rng, 0.6) else left_pocket(style)
    taper = draw(rng, config.fast_taper if fast else config.taper)
    half = config.reach + _BEYOND
    middle, length = half + draw(rng, (-25.0, 25.0)), 2 * half
    if kind is SceneKind.LANE_DROP:
        extra = ExtraLane(place, 0.0, middle, merges=taper)
    else:
        extra = ExtraLane(place, middle, length, forks=taper)
    style = replace(style, forward=replace(style.forward, extras=(extra,)))
    radius = config.fast_bend_radius if fast else config.bend_radius
    return RoadPlan(_through(style, _winding(rng, config, radius), rng, config), style, urban=not fast)


def _plan_ramp(rng: np.random.Generator, kind: SceneKind, config: RoadConfig) -> RoadPlan:
    lanes = int(rng.integers(2, 4))
    backward = 0 if chance(rng, 0.5) else lanes
    style = draw_style(rng, config, (lanes, backward), speed=config.fast_speed, median=config.narrow_median, strips=0.0)
    taper = draw(rng, config.fast_taper)
    enters = kind is SceneKind.ON_RAMP
    # The lane beside the road lies around the middle of the map; the ramp runs off towards its border.
    half = config.reach + _BEYOND
    near, far = half + draw(rng, (-35.0, -15.0)), half + draw(rng, (30.0, 50.0))
    if enters:
        extra = ExtraLane(Place.RIGHT, near, far, merges=taper)
    else:
        extra = ExtraLane(Place.RIGHT, 2 * half - far, 2 * half - near, forks=taper)
    style = replace(style, forward=replace(style.forward, extras=(extra,)))
    street = _through(style, _winding(rng, config, config.fast_bend_radius), rng, config)
    ramp = RampPlan(
        enters,
        turn=np.deg2rad(draw(rng, (22.0, 50.0))),
        radius=draw(rng, (60.0, 110.0)),
        speed=draw(rng, config.ramp_speed),
    )
    return RoadPlan(street, style, ramp=ramp, urban=False)


def ramp_side(road: StreetStyle) -> SidePlan:
    """Return the cross-section of a ramp: one lane, as wide and painted as the road's, its left line on the axis."""
    side = road.forward
    return SidePlan(
        lanes=1,
        lane_width=side.lane_width,
        gutter=side.gutter,
        inner_marking=side.inner_marking,
        outer_marking=side.outer_marking,
    )


def _through(
    style: StreetStyle, bends: tuple[tuple[float, float], ...], rng: np.random.Generator, config: RoadConfig
) -> StreetPlan:
    heading, half = draw(rng, (-np.pi, np.pi)), config.reach + _BEYOND
    return StreetPlan(
        origin=centered(np.zeros(2), heading, style),
        heading=heading,
        start=-half,
        stop=half,
        forward=style.forward,
        backward=style.backward,
        speed=style.speed,
        ego=(-config.ego_reach, config.ego_reach),
        bends=bends,
    )


def _winding(
    rng: np.random.Generator, config: RoadConfig, radius: tuple[float, float]
) -> tuple[tuple[float, float], ...]:
    """Draw the curvature of a road: straight, or arcs of either hand joined by clothoids."""
    if chance(rng, 0.25):
        return ((0.0, 0.0),)
    knots: list[tuple[float, float]] = []
    turned = 0.0
    half = config.reach + _BEYOND
    station = -half
    while station < half:
        # A road that has turned far turns back, so that it does not cross itself.
        hand = rng.uniform(-1, 1) if abs(turned) < 0.4 else -turned
        peak = 0.0 if chance(rng, 0.25) else float(np.copysign(1.0 / draw(rng, radius), hand))
        longest = 1.0 / max(abs(peak), 1.0 / _LONGEST_ARC)
        arc = draw(rng, (0.4, 1.0)) * longest
        turned += peak * arc
        knots += [(station, peak), (station + arc, peak)]
        station += arc + draw(rng, (20.0, 35.0))
    return tuple(knots)
