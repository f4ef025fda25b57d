"""Plans of networks with intersections: T junctions, four-way intersections, two of them, roundabouts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.cross_sections import Place
from tflane_jax.world.roads.layouts import (
    ArmPlan,
    StreetStyle,
    along,
    centred,
    chance,
    draw,
    draw_style,
    left_pocket,
)


@dataclass(frozen=True)
class JunctionPlan:
    """An intersection.

    Attributes:
        center: metres.
        arms: streets that end at the border of the map, in any order.
        corner_radius: metres.
        signalised: has traffic lights.
    """

    center: Float[np.ndarray, "2"]
    arms: tuple[ArmPlan, ...]
    corner_radius: float
    signalised: bool


@dataclass(frozen=True)
class JunctionsPlan:
    """One or two intersections and the street between them.

    Attributes:
        junctions: one or two.
        link: the arm of the first that is also, seen from its other end, an arm of the second.
        distance: between the two, metres.
        ring: radius of the middle of the lane and its width where the intersection is a roundabout, metres.
    """

    junctions: tuple[JunctionPlan, ...]
    link: ArmPlan | None = None
    distance: float = 0.0
    ring: tuple[float, float] | None = None


def plan_junctions(rng: np.random.Generator, kind: SceneKind, config: RoadConfig) -> JunctionsPlan:
    """Draw a network with intersections."""
    heading = draw(rng, (-np.pi, np.pi))
    if kind is SceneKind.TWO_JUNCTIONS:
        return _plan_two(rng, heading, config)
    if kind is SceneKind.ROUNDABOUT:
        return _plan_roundabout(rng, heading, config)
    four = kind is SceneKind.FOUR_WAY
    major = int(rng.choice([1, 2, 3], p=[0.35, 0.5, 0.15] if four else [0.4, 0.4, 0.2]))
    major = min(major, config.junction_lanes)
    minor = int(rng.integers(1, 3)) if major == 2 else 1
    main = _draw_main(rng, major, config)
    signalised = chance(rng, config.signals if major > 1 else 0.5 * config.signals)
    # The road ahead and back need not be in one line.
    kink = np.deg2rad(draw(rng, (-12.0, 12.0))) if chance(rng, 0.4) else 0.0
    arms = [
        _arm(rng, np.zeros(2), heading, main, config, minor=False),
        _arm(rng, np.zeros(2), heading + np.pi + kink, main.reversed(), config, minor=False),
    ]
    side = _draw_side(rng, minor, config)
    # The side streets lie to the left of `heading` and, at a four-way intersection, to its right.
    into_left, into_right = side.forward.lanes > 0, four and side.backward.lanes > 0
    probability = 0.5 if major > 1 else 0.25
    arms = [
        _with_pockets(rng, arms[0], probability * into_right, probability * into_left, config),
        _with_pockets(rng, arms[1], probability * into_left, probability * into_right, config),
    ]
    skew = np.deg2rad(draw(rng, (-config.skew, config.skew))) if chance(rng, 0.5) else 0.0
    left = heading + np.pi / 2 + skew
    shift = draw(rng, (-config.arm_offset, config.arm_offset)) if chance(rng, 0.4) else 0.0
    arms.append(_arm(rng, along(np.zeros(2), heading, shift), left, side, config, minor=True))
    if four:
        right = left + np.pi + np.deg2rad(draw(rng, (-8.0, 8.0)))
        arms.append(_arm(rng, along(np.zeros(2), heading, -shift), right, side.reversed(), config, minor=True))
    return JunctionsPlan((JunctionPlan(np.zeros(2), _spread(arms), draw(rng, config.corner_radius), signalised),))


def _plan_two(rng: np.random.Generator, heading: float, config: RoadConfig) -> JunctionsPlan:
    """Draw two intersections on one street, T or four-way, with 65 to 95 m between them."""
    major = int(rng.integers(1, 3))
    main = _draw_main(rng, major, config)
    distance = draw(rng, (65.0, 95.0))
    centers = [along(np.zeros(2), heading, d) for d in (-0.5 * distance, 0.5 * distance)]
    junctions = []
    for center, outward, style in zip(centers, (heading + np.pi, heading), (main.reversed(), main), strict=True):
        arms = [_arm(rng, center, outward, style, config, minor=False)]
        side = _draw_side(rng, 1, config, one_way=0.0)
        hand = float(np.copysign(np.pi / 2, rng.uniform(-1, 1)))
        skew = np.deg2rad(draw(rng, (-10.0, 10.0)))
        arms.append(_arm(rng, center, heading + hand + skew, side, config, minor=True))
        if chance(rng, 0.25):
            arms.append(_arm(rng, center, heading - hand + skew, side.reversed(), config, minor=True))
        arms = [replace(arm, bend=(np.clip(arm.bend[0], -0.15, 0.15), arm.bend[1])) for arm in arms]
        signalised = chance(rng, 0.5 * config.signals * major)
        junctions.append(JunctionPlan(center, tuple(arms), draw(rng, config.corner_radius), signalised))
    link = _arm(rng, centers[0], heading, main, config, minor=False)
    return JunctionsPlan(tuple(junctions), link=link, distance=distance)


def _plan_roundabout(rng: np.random.Generator, heading: float, config: RoadConfig) -> JunctionsPlan:
    count = int(rng.integers(3, 5))
    arms = []
    for k in range(count):
        style = draw_style(rng, config, (1, 1), speed=config.urban_speed, strips=0.5)
        outward = heading + 2 * np.pi * k / count + np.deg2rad(draw(rng, (-7.0, 7.0)))
        arms.append(_arm(rng, np.zeros(2), outward, style, config, minor=True))
    arms = [replace(arm, no_left=False) for arm in _spread(arms)]
    ring = draw(rng, (13.0, 17.0)), draw(rng, config.ring_lane_width)
    junction = JunctionPlan(np.zeros(2), tuple(arms), 0.0, signalised=False)
    return JunctionsPlan((junction,), ring=ring)


def _draw_main(rng: np.random.Generator, lanes: int, config: RoadConfig) -> StreetStyle:
    median = None
    if chance(rng, config.median):
        median = config.wide_median if lanes > 1 and chance(rng, 0.6) else config.narrow_median
    return draw_style(
        rng, config, (lanes, lanes), speed=config.urban_speed, median=median, strips=1.0 if lanes < 3 else 0.0
    )


def _draw_side(rng: np.random.Generator, lanes: int, config: RoadConfig, one_way: float | None = None) -> StreetStyle:
    one_way = config.one_way if one_way is None else one_way
    ways = (lanes, lanes)
    if chance(rng, one_way):
        ways = (lanes + 1, 0) if chance(rng, 0.5) else (0, lanes + 1)
    return draw_style(rng, config, ways, speed=config.urban_speed, strips=0.6)


def _arm(
    rng: np.random.Generator,
    center: Float[np.ndarray, "2"],
    heading: float,
    style: StreetStyle,
    config: RoadConfig,
    *,
    minor: bool,
) -> ArmPlan:
    crossing = draw(rng, config.crossing_width) if chance(rng, config.crossings) else 0.0
    bend = 0.0
    if chance(rng, 0.6):
        bend = np.deg2rad(draw(rng, (-40.0, 40.0)))
    return ArmPlan(
        origin=centred(center, heading, style),
        heading=heading,
        style=style,
        crossing=crossing,
        minor=minor,
        no_left=chance(rng, config.turn_restriction),
        bend=(bend, draw(rng, config.bend_radius)),
    )


def _with_pockets(rng: np.random.Generator, arm: ArmPlan, left: float, right: float, config: RoadConfig) -> ArmPlan:
    """Give the incoming side of an arm turning lanes to the left and to the right with these probabilities."""
    pockets: list[Place] = []
    if chance(rng, left) and not arm.no_left:
        pockets.append(left_pocket(arm.style))
    incoming = arm.style.backward
    if chance(rng, 0.5 * right) and not incoming.bike and incoming.lanes < 3:
        pockets.append(Place.RIGHT)
    incoming = replace(
        incoming, pockets=tuple(pockets), pocket_length=draw(rng, config.pocket), taper=draw(rng, config.taper)
    )
    return replace(arm, style=replace(arm.style, backward=incoming))


def _spread(arms: list[ArmPlan]) -> tuple[ArmPlan, ...]:
    """Limit the bends of arms so that neighbours do not run into each other."""
    headings = np.array([arm.heading for arm in arms])
    out = []
    for i, arm in enumerate(arms):
        gaps = np.delete((headings - arm.heading) % (2 * np.pi), i)
        margin = np.deg2rad(50.0)
        leftmost = max(0.5 * (gaps.min() - margin), 0.0)
        rightmost = max(0.5 * ((2 * np.pi - gaps).min() - margin), 0.0)
        out.append(replace(arm, bend=(float(np.clip(arm.bend[0], -rightmost, leftmost)), arm.bend[1])))
    return tuple(out)


def seen_from_end(link: ArmPlan, distance: float) -> ArmPlan:
    """Return a link as an arm of the intersection at its far end.

    The axis is the same line: `centred` shifts it to the same place from both ends.
    """
    origin = along(link.origin, link.heading, distance)
    return replace(link, origin=origin, heading=link.heading + np.pi, style=link.style.reversed())
