"""Roadside objects of a front view: walls, rails, trees, lamps, signs, bridges, buildings."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tflane_jax.world.front_view.road import Beside, Highway
from tflane_jax.world.render.camera import lift
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import box

# Long objects are cut at these stations, so that each piece is sorted by its own distance when drawn, metres.
_CUTS = np.array([-9.0, -3.0, 3.0, 8.0, 14.0, 22.0, 34.0, 52.0, 80.0, 120.0, 180.0, 280.0])
_CONCRETE = (0.6, 0.59, 0.56)
_STEEL = (0.62, 0.64, 0.66)
_POST = (0.4, 0.41, 0.42)


@dataclass(frozen=True)
class Roadside:
    """Solids beside the road, and the objects among them that cast shadows on it.

    Attributes:
        solids: of all objects.
        crowns: (t, 4) x, y, height of the middle and radius of tree crowns, metres.
        bridges: station and half length along the road of each bridge.
    """

    solids: list[Solid]
    crowns: np.ndarray
    bridges: list[tuple[float, float]]


def draw_roadside(rng: np.random.Generator, road: Highway) -> Roadside:
    """Draw the roadside objects; the same stream and road give the same bits."""
    solids: list[Solid] = []
    for (kind, offset), hand in ((road.left, -1.0), (road.right, 1.0)):
        if kind is Beside.BARRIER:
            solids += _wall(road, offset, hand, rng.uniform(0.8, 1.15), _CONCRETE)
        elif kind is Beside.RAIL:
            solids += _rail(road, offset, hand)
    outer_left, outer_right = road.edges[0] - 1.5, max(road.edges[3], road.right[1]) + 1.5
    if rng.random() < 0.12:
        height = rng.uniform(2.5, 4.5)
        solids += _wall(road, outer_right + 1.0, 1.0, height, (0.55, 0.5, 0.44))
    trees, crowns = _trees(rng, road, outer_left, outer_right)
    solids += trees
    solids += _lamps(rng, road, outer_right)
    solids += _signs(rng, road, outer_right)
    solids += _buildings(rng, road, outer_left, outer_right)
    bridges = []
    if rng.random() < 0.16:
        station, half = rng.uniform(35.0, 150.0), rng.uniform(4.0, 8.0)
        solids += _bridge(rng, road, station, half, outer_left, outer_right)
        bridges.append((station, half))
    return Roadside(solids, crowns, bridges)


def _sheet(road: Highway, s0: float, s1: float, offset: float, hand: float, z: tuple[float, float]) -> np.ndarray:
    """Return an upright sheet along the road that faces it; `hand` is 1 for one on the right."""
    s = np.linspace(s0, s1, 5)
    base = road.at(s, np.full(5, offset))
    low = lift(base, z[0])
    high = lift(base, z[1])
    # Counter-clockwise as seen from the road.
    ring = np.concatenate([low[::-1], high])
    # The first three corners define the normal, so they must not be collinear.
    return np.roll(ring if hand > 0 else ring[::-1], 1, axis=0)


def _wall(road: Highway, offset: float, hand: float, height: float, colour) -> list[Solid]:
    solids = []
    for s0, s1 in pairwise(_CUTS.tolist()):
        solid = Solid(max(0.5 * (s0 + s1), abs(offset - road.ego_offset)))
        solid.add(_sheet(road, s0, s1, offset, hand, (0.0, height)), colour)
        top = np.concatenate(
            [
                road.at(np.array([s0, s1]), np.full(2, offset)),
                road.at(np.array([s1, s0]), np.full(2, offset + 0.3 * hand)),
            ]
        )
        top = lift(top, height)
        solid.add(top if hand < 0 else top[::-1], colour)
        solids.append(solid)
    return solids


def _rail(road: Highway, offset: float, hand: float) -> list[Solid]:
    solids = []
    for s0, s1 in pairwise(_CUTS.tolist()):
        solid = Solid(max(0.5 * (s0 + s1), abs(offset - road.ego_offset)))
        for s in np.arange(np.ceil(s0 / 4.0) * 4.0, min(s1, 70.0), 4.0):
            solid.add(_sheet(road, s, s + 0.15, offset + 0.05 * hand, hand, (0.0, 0.7)), _POST)
        solid.add(_sheet(road, s0, s1, offset, hand, (0.42, 0.74)), _STEEL)
        solid.add(_sheet(road, s0, s1, offset - 0.01 * hand, hand, (0.55, 0.61)), (0.4, 0.42, 0.44))
        solids.append(solid)
    return solids


def _disc(center: np.ndarray, radius: float, squash: float) -> np.ndarray:
    """Return a disc that faces the camera."""
    angle = np.linspace(0.0, 2.0 * np.pi, 11)[:-1]
    away = center[:2] / max(float(np.hypot(*center[:2])), 1e-6)
    right = np.array([away[1], -away[0], 0.0])
    up = np.array([0.0, 0.0, squash])
    return center + radius * (np.cos(angle)[:, None] * right + np.sin(angle)[:, None] * up)


def _trees(rng: np.random.Generator, road: Highway, left: float, right: float) -> tuple[list[Solid], np.ndarray]:
    solids, crowns = [], []
    density = rng.choice([0.0, 0.3, 1.0], p=[0.3, 0.4, 0.3])
    green = np.array([0.16, 0.24, 0.1]) * rng.uniform(0.7, 1.3) + rng.uniform(0.0, 0.05, 3)
    count = rng.poisson(26 * density)
    side, s = rng.random(count) < 0.5, 12.0 + 180.0 * rng.random(count) ** 1.5
    beyond, size = rng.uniform(2.0, 22.0, count), rng.uniform(1.6, 3.8, count)
    offset = np.where(side, left - beyond, right + beyond)
    for xy, radius in zip(road.at(s, offset), size, strict=True):
        distance, middle = float(np.hypot(*xy)), radius * rng.uniform(1.2, 2.2)
        solid = Solid(distance)
        box(solid, xy, 0.0, (0.35, 0.35), (0.0, middle), (0.2, 0.15, 0.1))
        blobs = 7 if distance < 90 else 3
        for k in range(blobs):
            shift = radius * np.array([0.0, *rng.uniform(-0.55, 0.55, 2)])
            tone = 0.75 + 0.12 * k / blobs * 4 + rng.uniform(-0.1, 0.1)
            blob = _disc(np.array([*xy, middle]) + shift, radius * rng.uniform(0.45, 0.8), 1.15)
            solid.add(blob, tuple(green * tone))
        solids.append(solid)
        crowns.append((*xy, middle, radius))
    return solids, np.array(crowns).reshape(-1, 4)


def _lamps(rng: np.random.Generator, road: Highway, right: float) -> list[Solid]:
    solids = []
    if rng.random() > 0.35:
        return solids
    spacing, side = rng.uniform(35.0, 60.0), rng.random() < 0.5
    offset = road.left[1] - 0.8 if side else right + 0.5
    hand = 1.0 if side else -1.0
    for s in np.arange(rng.uniform(5.0, spacing), 220.0, spacing):
        xy, arm = road.at(np.array([s, s]), np.array([offset, offset + hand * 1.3]))
        solid = Solid(float(np.hypot(*xy)))
        box(solid, xy, 0.0, (0.22, 0.22), (0.0, 9.0), _POST)
        box(solid, 0.5 * (xy + arm), float(np.arctan2(*(arm - xy)[::-1])), (2.6, 0.2), (8.9, 9.1), _POST)
        solids.append(solid)
    return solids


def _signs(rng: np.random.Generator, road: Highway, right: float) -> list[Solid]:
    solids = []
    for _ in range(rng.poisson(0.7)):
        s, high = rng.uniform(20.0, 150.0), rng.uniform(1.0, 2.6)
        (xy,) = road.at(np.array([s]), np.array([right + rng.uniform(0.5, 3.0)]))
        colour = [(0.05, 0.35, 0.2), (0.1, 0.25, 0.55), (0.85, 0.7, 0.1), (0.85, 0.85, 0.85)][rng.integers(4)]
        solid = Solid(float(np.hypot(*xy)))
        width = high * rng.uniform(0.7, 1.5)
        box(solid, xy, 0.0, (0.1, 0.1), (0.0, 2.2), _POST)
        box(solid, xy, 0.0, (0.06, width), (2.0, 2.0 + high), colour)
        solids.append(solid)
    if rng.random() < 0.15:
        s = rng.uniform(40.0, 160.0)
        left_end, right_end = road.left[1] - 0.5, right
        posts = road.at(np.array([s, s]), np.array([left_end, right_end]))
        solid = Solid(float(np.hypot(*posts.mean(0))))
        _, heading = road.axis.at(np.array([s]))
        for post in posts:
            box(solid, post, heading[0], (0.4, 0.4), (0.0, 7.2), _POST)
        box(solid, posts.mean(0), heading[0], (0.4, right_end - left_end), (6.4, 7.2), _POST)
        for fraction in rng.uniform(0.15, 0.85, rng.integers(1, 4)):
            center = posts[0] + fraction * (posts[1] - posts[0])
            solid_sign = Solid(solid.distance - 1.0)
            box(solid_sign, center, heading[0], (0.2, rng.uniform(2.5, 5.0)), (5.6, 7.8), (0.05, 0.33, 0.2))
            solids.append(solid_sign)
        solids.append(solid)
    return solids


def _buildings(rng: np.random.Generator, road: Highway, left: float, right: float) -> list[Solid]:
    solids = []
    if rng.random() > 0.35:
        return solids
    for _ in range(rng.integers(1, 9)):
        s, beyond, side = rng.uniform(35.0, 250.0), rng.uniform(14.0, 60.0), rng.random() < 0.5
        (xy,) = road.at(np.array([s]), np.array([left - beyond if side else right + beyond]))
        length, width, height = rng.uniform(8.0, 24.0, 3) * [1.0, 0.9, 0.9]
        tone = rng.uniform(0.4, 0.75) * np.array([1.0, rng.uniform(0.86, 1.0), rng.uniform(0.75, 1.0)])
        solid = Solid(float(np.hypot(*xy)))
        heading = rng.uniform(-0.3, 0.3)
        box(solid, xy, heading, (length, width), (0.0, height), tuple(tone))
        u = np.array([np.cos(heading), np.sin(heading)])
        v = np.array([-u[1], u[0]])
        for z in np.arange(1.5, height - 1.5, 3.2):
            face = xy - (0.5 * length + 0.05) * u
            ends = np.array([face + 0.44 * width * v, face - 0.44 * width * v])
            solid.add(np.concatenate([lift(ends, z), lift(ends, z + 1.4)[::-1]]), (0.2, 0.24, 0.28))
        solids.append(solid)
    return solids


def _bridge(
    rng: np.random.Generator, road: Highway, station: float, half: float, left: float, right: float
) -> list[Solid]:
    low, high = rng.uniform(5.2, 6.0), rng.uniform(7.2, 8.5)
    _, heading = road.axis.at(np.array([station]))
    middle, reach = 0.5 * (left + right), 0.5 * (right - left) + 60.0
    (center,) = road.at(np.array([station]), np.array([middle]))
    distance = station - half
    deck = Solid(distance)
    box(deck, center, heading[0], (2.0 * half, 2.0 * reach), (low, high), _CONCRETE)
    solids = [deck]
    for offset in (left - 1.0, right + 2.0, road.left[1] - 0.6):
        if offset == road.left[1] - 0.6 and road.edges[1] >= road.edges[2]:
            continue
        (foot,) = road.at(np.array([station]), np.array([offset]))
        pier = Solid(distance + 0.5)
        box(pier, foot, heading[0], (1.2, 0.9), (0.0, low), (0.52, 0.51, 0.49))
        solids.append(pier)
    return solids
