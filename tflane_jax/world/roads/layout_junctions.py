"""Plans of networks with intersections: T junctions, four-way and five-leg intersections, two of them, staggered
junctions, roundabouts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.cross_sections import Place
from tflane_jax.world.roads.curves import direction, right_of
from tflane_jax.world.roads.intersections import radius_beyond, stop_distances
from tflane_jax.world.roads.layouts import (
    ArmPlan,
    StreetStyle,
    along,
    centered,
    chance,
    draw,
    draw_style,
    left_pocket,
)

# How far the street across leans where a fifth arm comes in, degrees. The fifth arm halves the wide quarter, and is
# then too far from straight on (50 degrees) of every other arm.
_LEAN, _FIFTH = (20.0, 34.0), 2.0
# Kerbs at the acute corners of a fifth arm are rounded with this fraction of the usual radius.
_ACUTE = 0.7
# Side streets of two junctions bend by this many radians for each degree that they may lean.
_BEND = 0.015
# The corner between a fifth arm and the side street beside it keeps this distance from the main road's kerb, metres.
_BESIDE = 0.3
# Side streets nearer than this share one intersection, whose traffic crosses the main road in one S-shaped movement;
# else there are two junctions with at least this much road between their stop lines, metres.
_ONE_JUNCTION, _SHORTEST_LINK = 16.0, 12.0
# Two staggered junctions nearer than this have no signals: the lanes between them hold too few vehicles, metres.
_APART_FOR_SIGNALS = 45.0


@dataclass(frozen=True)
class JunctionPlan:
    """An intersection.

    Attributes:
        center: metres.
        arms: streets that end at the border of the map, in any order.
        corner_radius: metres.
        signalised: has traffic lights.
        nodes: where the center lines of its streets meet, if not at the center.
    """

    center: Float[np.ndarray, "2"]
    arms: tuple[ArmPlan, ...]
    corner_radius: float
    signalised: bool
    nodes: tuple[Float[np.ndarray, "2"], ...] = ()


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
    plan = _plan_kind(rng, kind, config)
    if not config.lane_changes or plan.ring is not None:
        return plan
    changed = (
        replace(junction, arms=tuple(_with_changes(rng, arm, config) for arm in junction.arms))
        for junction in plan.junctions
    )
    return replace(plan, junctions=tuple(changed))


def _plan_kind(rng: np.random.Generator, kind: SceneKind, config: RoadConfig) -> JunctionsPlan:
    heading = draw(rng, (-np.pi, np.pi))
    if kind is SceneKind.TWO_JUNCTIONS:
        return _plan_two(rng, heading, config)
    if kind is SceneKind.ROUNDABOUT:
        return _plan_roundabout(rng, heading, config)
    if kind is SceneKind.FIVE_LEGS:
        return _plan_five_legs(rng, heading, config)
    if kind is SceneKind.STAGGERED:
        return _plan_staggered(rng, heading, config)
    four = kind is SceneKind.FOUR_WAY
    major = int(rng.choice([1, 2, 3], p=[0.35, 0.5, 0.15] if four else [0.4, 0.4, 0.2]))
    major = _allowed(rng, major, config)
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


def _plan_five_legs(rng: np.random.Generator, heading: float, config: RoadConfig) -> JunctionsPlan:
    """Draw a four-way intersection whose side streets lean, with a fifth street in the quarter that this opens."""
    major = _allowed(rng, int(rng.choice([1, 2], p=[0.4, 0.6])), config)
    main, side = _draw_main(rng, major, config), _draw_side(rng, 1, config)
    fifth = _draw_side(rng, 1, config)
    signalised = chance(rng, config.signals)
    hand = float(np.copysign(1.0, rng.uniform(-1, 1)))
    lean = np.deg2rad(draw(rng, _LEAN))
    left = heading + np.pi / 2 + hand * lean
    halfway = heading + hand * 0.5 * (np.pi / 2 + lean) + np.pi * chance(rng, 0.5)
    halfway += np.deg2rad(draw(rng, (-_FIFTH, _FIFTH)))
    center = np.zeros(2)
    # A lane that only turns right would lead into the corner behind the first street on the right.
    pockets = 0.4 if major > 1 else 0.0
    mains = [
        _with_pockets(rng, _arm(rng, center, heading, main, config, minor=False), pockets, 0.0, config),
        _with_pockets(
            rng, _arm(rng, center, heading + np.pi, main.reversed(), config, minor=False), pockets, 0.0, config
        ),
    ]
    sides = [_arm(rng, center, left, side, config, minor=True)]
    sides.append(_arm(rng, center, left + np.pi, side.reversed(), config, minor=True))
    between = _arm(rng, center, halfway, fifth, config, minor=True)
    radius = max(_ACUTE * draw(rng, config.corner_radius), _radius_beside(mains, sides, between))
    return JunctionsPlan((JunctionPlan(center, _spread([*mains, *sides, between]), radius, signalised),))


def _radius_beside(mains: list[ArmPlan], sides: list[ArmPlan], fifth: ArmPlan) -> float:
    """Return the radius with which the corner between the fifth arm and a side street stays beside the main road."""
    normal = right_of(mains[0].heading)
    normal = normal * np.sign(normal @ direction(fifth.heading))
    kerbs = [one.kerb_corner(0.0, side) for one in (m.arm for m in mains) for side in (one.right, -one.left)]
    (side,) = (one for one in sides if normal @ direction(one.heading) > 0.0)
    first = (side.heading - fifth.heading) % (2 * np.pi) < np.pi
    pair = (fifth.arm, side.arm) if first else (side.arm, fifth.arm)
    return radius_beyond(*pair, normal, max(float(kerb @ normal) for kerb in kerbs) + _BESIDE)


def _plan_staggered(rng: np.random.Generator, heading: float, config: RoadConfig) -> JunctionsPlan:
    """Draw two side streets on opposite sides of a main road, offset along it: one intersection or two T junctions."""
    major = _allowed(rng, int(rng.choice([1, 2], p=[0.6, 0.4])), config)
    # A wide median leaves no room for its noses between the two junctions.
    median = config.narrow_median if chance(rng, config.median) else None
    main = draw_style(rng, config, (major, major), speed=config.urban_speed, median=median)
    hand = float(np.copysign(np.pi / 2, rng.uniform(-1, 1)))
    sides = [_draw_side(rng, 1, config, one_way=0.0) for _ in range(2)]
    lean = (-config.side_lean, config.side_lean)
    turns = [hand + np.deg2rad(draw(rng, lean)), -hand + np.deg2rad(draw(rng, lean))]
    stagger, radius = draw(rng, config.stagger), draw(rng, config.corner_radius)
    signals = chance(rng, 0.5 * major * config.signals)
    arms = [_arm(rng, np.zeros(2), heading + turns[k], sides[k], config, minor=True) for k in range(2)]
    ahead = _arm(rng, np.zeros(2), heading, main, config, minor=False)
    back = _arm(rng, np.zeros(2), heading + np.pi, main.reversed(), config, minor=False)
    if stagger < _ONE_JUNCTION:
        centers = [along(np.zeros(2), heading, d) for d in (-0.5 * stagger, 0.5 * stagger)]
        arms = [replace(arm, origin=arm.origin + center) for arm, center in zip(arms, centers, strict=True)]
        whole = JunctionPlan(np.zeros(2), _spread([ahead, back, *arms]), radius, signals, tuple(centers))
        return JunctionsPlan((whole,))
    # No pedestrian crossing on the short lanes between the two.
    link = replace(ahead, crossing=0.0)
    least = _to_stop(link, (back, arms[0]), radius) + _to_stop(seen_from_end(link, 0.0), (ahead, arms[1]), radius)
    stagger = max(stagger, least + _SHORTEST_LINK)
    junctions = []
    for outer, arm, distance in zip((back, ahead), arms, (-0.5 * stagger, 0.5 * stagger), strict=True):
        center = along(np.zeros(2), heading, distance)
        own = [_bent_at_most(replace(a, origin=a.origin + center), _BEND * config.side_lean) for a in (outer, arm)]
        junctions.append(JunctionPlan(center, tuple(own), radius, signals and stagger > _APART_FOR_SIGNALS))
    link = replace(link, origin=along(link.origin, heading, -0.5 * stagger))
    return JunctionsPlan(tuple(junctions), link=link, distance=stagger)


def _bent_at_most(arm: ArmPlan, radians: float) -> ArmPlan:
    return replace(arm, bend=(np.clip(arm.bend[0], -radians, radians), arm.bend[1]))


def _to_stop(arm: ArmPlan, others: tuple[ArmPlan, ...], radius: float) -> float:
    """Return the distance of an arm's stop line from the intersection that it forms with others."""
    around = sorted((arm, *others), key=lambda a: a.heading % (2 * np.pi))
    distances = stop_distances([a.arm for a in around], radius)
    return float(distances[[a is arm for a in around].index(True)])


def _plan_two(rng: np.random.Generator, heading: float, config: RoadConfig) -> JunctionsPlan:
    """Draw two intersections on one street, T or four-way."""
    major = _or_another(rng, max(int(rng.integers(1, 3)), config.least_junction_lanes), config)
    main = _draw_main(rng, major, config)
    distance = draw(rng, config.junction_distance)
    centers = [along(np.zeros(2), heading, d) for d in (-0.5 * distance, 0.5 * distance)]
    junctions = []
    for center, outward, style in zip(centers, (heading + np.pi, heading), (main.reversed(), main), strict=True):
        arms = [_arm(rng, center, outward, style, config, minor=False)]
        side = _draw_side(rng, 1, config, one_way=0.0)
        hand = float(np.copysign(np.pi / 2, rng.uniform(-1, 1)))
        skew = np.deg2rad(draw(rng, (-config.side_lean, config.side_lean)))
        arms.append(_arm(rng, center, heading + hand + skew, side, config, minor=True))
        if chance(rng, config.second_sides):
            arms.append(_arm(rng, center, heading - hand + skew, side.reversed(), config, minor=True))
        arms = [_bent_at_most(arm, _BEND * config.side_lean) for arm in arms]
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


def _allowed(rng: np.random.Generator, lanes: int, config: RoadConfig) -> int:
    return _or_another(rng, max(min(lanes, config.junction_lanes), config.least_junction_lanes), config)


def _or_another(rng: np.random.Generator, lanes: int, config: RoadConfig) -> int:
    # Nothing is drawn for presets without it, whose roads stay what they were.
    return lanes + int(config.another_lane > 0.0 and chance(rng, config.another_lane))


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
        origin=centered(center, heading, style),
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


def _with_changes(rng: np.random.Generator, arm: ArmPlan, config: RoadConfig) -> ArmPlan:
    """Let a lane open on the way out of the intersection, and one close on the way in, with their probability."""
    out, incoming = arm.style.forward, arm.style.backward
    if out.lanes and chance(rng, config.lane_changes):
        place = _place_of_change(rng, out.bike)
        out = replace(out, opens=((place, draw(rng, config.change_distance)),), taper=draw(rng, config.taper))
    if incoming.lanes and chance(rng, config.lane_changes):
        before = draw(rng, config.change_distance) + incoming.pocket_length * bool(incoming.pockets)
        place = _place_of_change(rng, incoming.bike)
        taper = incoming.taper if incoming.pockets else draw(rng, config.taper)
        incoming = replace(incoming, closes=((place, before),), taper=taper)
    return replace(arm, style=replace(arm.style, forward=out, backward=incoming))


def _place_of_change(rng: np.random.Generator, bike: float) -> Place:
    """Return where a lane opens or closes: never in a median, in which the other direction may have one too."""
    return Place.LEFT if chance(rng, 0.5) or bike else Place.RIGHT


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

    The axis is the same line: `centered` shifts it to the same place from both ends.
    """
    origin = along(link.origin, link.heading, distance)
    return replace(link, origin=origin, heading=link.heading + np.pi, style=link.style.reversed())
