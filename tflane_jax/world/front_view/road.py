"""Motorways and trunk roads of front views: axis, lane lines, paint and edges of the pavement.

The axis is a clothoid along the left edge line of the ego's carriageway. Lines lie at offsets from it (metres to the
right), which vary where a lane opens or closes. Everything is in the ego frame, on flat ground.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.limits import Fraction, PositiveOrZero, PositiveRange, Range, Shares
from tflane_jax.world.roads.cross_sections import ExtraLane, Place
from tflane_jax.world.roads.curves import ReferenceLine, clothoid_line

# Where the drawn road starts and ends, metres along its axis; beyond, haze and horizon hide it.
_START, _END = -12.0, 420.0
_SPACING = 1.0
# Curvature fades to 0 between these stations, so that no road closes a circle, metres.
_FADE = (220.0, 330.0)
# An opening lane has its own line where it has more than this fraction of its full width.
_SEPARATED = 0.5

Colour = tuple[float, float, float]
WHITE: Colour = (0.92, 0.92, 0.9)
YELLOW: Colour = (0.88, 0.68, 0.2)


class Beside(enum.Enum):
    """Kinds of edge of a carriageway."""

    VERGE = "grass or earth"
    BARRIER = "concrete wall"
    RAIL = "guard rail"


@dataclass(frozen=True)
class HighwayConfig:
    """Dimensions and probabilities of front-view roads. Lengths in metres.

    Attributes:
        lanes: relative frequency of 2, 3, 4 and 5 lanes on the ego's carriageway.
        lane_width: width of all lanes of a road.
        between: probability that the ego drives on an inner lane where there is one.
        straight: probability of a straight road.
        radius: radius of curves at the ego; its inverse is drawn uniformly.
        curvature_change: largest change of the curvature within 100 m, 1/m.
        sway: standard deviation of the ego's distance from the middle of its lane.
        lane_change: probability that the ego's lateral position in its lane is uniform.
        two_way: probability of an undivided road with oncoming traffic beyond a double line.
        extra_lane: probability that a lane opens or closes on the right within sight.
        inner_shoulder, outer_shoulder: width of the shoulders beside the edge lines.
        opposite: distance between the edge lines of the two carriageways.
    """

    lanes: Shares = (0.16, 0.32, 0.32, 0.2)
    lane_width: PositiveRange = (3.3, 3.8)
    between: Fraction = 0.35
    straight: Fraction = 0.35
    radius: PositiveRange = (260.0, 4000.0)
    curvature_change: PositiveOrZero = 1.0 / 900.0
    sway: PositiveOrZero = 0.22
    lane_change: Fraction = 0.06
    two_way: Fraction = 0.12
    extra_lane: Fraction = 0.1
    inner_shoulder: Range = (0.5, 3.2)
    outer_shoulder: Range = (0.6, 3.4)
    opposite: Range = (3.0, 22.0)


@dataclass(frozen=True)
class Stripe:
    """A narrow strip on the ground along the road: paint, a seam, a tyre mark.

    Attributes:
        offset: (n,) of its middle at the axis' vertices.
        width: metres.
        colour: linear RGB, 0 to 1.
        opacity: (n,) 0 to 1 at the axis' vertices.
        period, dash, phase: dashes of `dash` metres every `period` metres, from `phase` on; period 0: solid.
    """

    offset: Float[np.ndarray, " n"]
    width: float
    colour: Colour
    opacity: Float[np.ndarray, " n"]
    period: float = 0.0
    dash: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True)
class Highway:
    """One road in the ego frame.

    Attributes:
        axis: left edge line of the ego's carriageway; n vertices, station 0 beside the ego.
        ego_offset: of the ego.
        lane_width: metres.
        lines: (k, n) offsets of the lane lines of the ego's carriageway, left to right.
        present: (k, n) where each line exists.
        paint: the lines' paint, and that of the opposite carriageway.
        lanes: (l,) offsets of the middles of the lanes on the ego's carriageway.
        oncoming: (o,) those of the opposite carriageway.
        left, right: kind of edge of the carriageway, and its offset; the median is to the left.
        edges: (4,) offsets of the pavement: opposite carriageway from, to; own from, to. Equal where there is none.
    """

    axis: ReferenceLine
    ego_offset: float
    lane_width: float
    lines: Float[np.ndarray, "k n"]
    present: Bool[np.ndarray, "k n"]
    paint: tuple[Stripe, ...]
    lanes: Float[np.ndarray, " l"]
    oncoming: Float[np.ndarray, " o"]
    left: tuple[Beside, float]
    right: tuple[Beside, float]
    edges: Float[np.ndarray, "4"]

    def at(self, s: Float[np.ndarray, " k"], offset: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 2"]:
        """Return the ground points at stations and offsets."""
        xy, heading = self.axis.at(s)
        return xy + np.asarray(offset)[..., None] * np.stack([np.sin(heading), -np.cos(heading)], -1)


def draw_highway(rng: np.random.Generator, config: HighwayConfig, wear: float) -> Highway:
    """Draw a road; the same stream, config and wear give the same bits.

    Args:
        rng: stream.
        config: what to draw.
        wear: 0 (fresh paint) to 1 (partly gone).
    """
    count = 2 + int(rng.choice(4, p=np.asarray(config.lanes) / np.sum(config.lanes)))
    width = rng.uniform(*config.lane_width)
    two_way = rng.random() < config.two_way
    count = min(count, 2) if two_way else count
    lane = rng.integers(1, count - 1) if count > 2 and rng.random() < config.between else rng.integers(count)
    ego_offset = (lane + 0.5) * width + _sway(rng, config, width)
    axis = _draw_axis(rng, config, ego_offset)
    n = len(axis.s)

    lines = np.repeat(width * np.arange(count + 1.0)[:, None], n, axis=1)
    present = np.ones((count + 1, n), bool)
    extra = _extra_lane(rng, config)
    fraction = np.zeros(n) if extra is None else extra.presence(axis.s)
    outer = count * width
    if extra is not None:
        lines = np.concatenate([lines, (outer + width * fraction)[None]])
        present = np.concatenate([present, np.ones((1, n), bool)])
        present[-2] = fraction > _SEPARATED

    inner = 0.0 if two_way else rng.uniform(*config.inner_shoulder)
    apron = rng.uniform(*config.outer_shoulder)
    right_edge = outer + apron + (width if extra is not None else 0.0)
    ends = list(Beside)
    left = Beside.VERGE if two_way else ends[rng.choice(3, p=[0.3, 0.45, 0.25])]
    right = ends[rng.choice(3, p=[0.45, 0.25, 0.3])]
    gap = 0.0 if two_way else rng.uniform(*config.opposite)
    oncoming = 1 if two_way else int(rng.integers(2, 5))
    if left is Beside.BARRIER:
        gap = min(gap, 2.0 * inner + 0.8)  # a single wall between the two
    far = -gap - oncoming * width - rng.uniform(*config.outer_shoulder)
    paint = [
        *_paint_own(rng, lines, present, two_way, wear),
        *_paint_oncoming(rng, axis, -gap, width, oncoming, two_way, wear),
    ]
    return Highway(
        axis=axis,
        ego_offset=ego_offset,
        lane_width=width,
        lines=lines,
        present=present,
        paint=tuple(paint),
        lanes=width * (np.arange(count) + 0.5),
        oncoming=-gap - width * (np.arange(oncoming) + 0.5),
        left=(left, -inner - 0.3),
        right=(right, right_edge + 0.2),
        edges=np.array([far, -inner if two_way else min(inner - gap, -inner), -inner, right_edge]),
    )


def _sway(rng: np.random.Generator, config: HighwayConfig, width: float) -> float:
    """Draw the ego's distance to the right of the middle of its lane."""
    usual = np.clip(config.sway * rng.standard_normal(), -0.25 * width, 0.25 * width)
    anywhere = rng.uniform(-0.5, 0.5) * width
    return float(anywhere if rng.random() < config.lane_change else usual)


def _draw_axis(rng: np.random.Generator, config: HighwayConfig, ego_offset: float) -> ReferenceLine:
    s = np.arange(_START, _END + _SPACING, _SPACING)
    low, high = 1.0 / config.radius[1], 1.0 / config.radius[0]
    here = rng.choice([-1.0, 1.0]) * rng.uniform(low, high)
    change = config.curvature_change * rng.uniform(-1.0, 1.0)
    if rng.random() < config.straight:
        here, change = 0.0, change * float(rng.random() < 0.3)
    there = float(np.clip(here + 1.5 * change, -high, high))
    knots = ((0.0, here), (150.0, there), (_FADE[0], there), (_FADE[1], 0.0))
    # The ego drives along its lane, so the road beside it runs along the x axis.
    return clothoid_line(np.array([0.0, ego_offset]), 0.0, s, knots)


def _extra_lane(rng: np.random.Generator, config: HighwayConfig) -> ExtraLane | None:
    opens, at, taper = rng.random() < 0.5, rng.uniform(25.0, 110.0), rng.uniform(40.0, 70.0)
    if rng.random() >= config.extra_lane:
        return None
    if opens:
        return ExtraLane(Place.RIGHT, at, 2.0 * _END, forks=taper)
    return ExtraLane(Place.RIGHT, 2.0 * _START, at, merges=taper)


def _paint_own(
    rng: np.random.Generator, lines: np.ndarray, present: np.ndarray, two_way: bool, wear: float
) -> list[Stripe]:
    period, dash = _DASHES[rng.choice(len(_DASHES), p=_DASH_SHARE)]
    width = rng.uniform(0.1, 0.17)
    left_colour = YELLOW if two_way or rng.random() < 0.6 else WHITE
    phase = rng.uniform(0.0, period)
    stripes = []
    for number, (offset, there) in enumerate(zip(lines, present, strict=True)):
        edge = number in (0, len(lines) - 1)
        opacity = there * _worn(rng, len(offset), wear)
        solid = edge or rng.random() < 0.1
        colour = left_colour if number == 0 else WHITE
        double = 0.1 + width if (number == 0 and two_way) or rng.random() < 0.08 else 0.0
        for side in (-0.5, 0.5) if double else (0.0,):
            # Dashes of neighbouring lines stand side by side.
            stripes.append(
                Stripe(offset + side * double, width, colour, opacity, 0.0 if solid else period, dash, phase)
            )
    return stripes


def _paint_oncoming(
    rng: np.random.Generator, axis: ReferenceLine, start: float, width: float, count: int, two_way: bool, wear: float
) -> list[Stripe]:
    stripes = []
    for number in range(1 if two_way else 0, count + 1):
        edge = number in (0, count)
        opacity = _worn(rng, len(axis.s), wear)
        offset = np.full(len(axis.s), start - number * width)
        colour = YELLOW if number == 0 else WHITE
        stripes.append(Stripe(offset, 0.13, colour, opacity, 0.0 if edge else 12.0, 3.5))
    return stripes


# Period and dash of broken lines, metres: United States, Europe, Britain, short dashes, raised dots.
_DASHES = ((12.2, 3.05), (12.0, 4.0), (18.0, 6.0), (9.0, 2.0), (9.0, 3.0), (6.0, 3.0), (3.6, 0.35))
_DASH_SHARE = (0.3, 0.15, 0.15, 0.12, 0.12, 0.08, 0.08)


def _worn(rng: np.random.Generator, n: int, wear: float) -> Float[np.ndarray, " n"]:
    """Draw the opacity of a worn line: lower in places, and rarely almost 0 everywhere."""
    base = 1.0 - wear * rng.uniform(0.0, 0.6)
    coarse = rng.uniform(0.0, 1.0, n // 12 + 2)
    waves = np.interp(np.arange(n) / 12.0, np.arange(len(coarse)), coarse)
    gone = rng.random() < 0.06 * wear
    return np.clip(base - wear * np.maximum(waves - 0.5, 0.0), 0.0, 1.0) * (0.12 if gone else 1.0)
