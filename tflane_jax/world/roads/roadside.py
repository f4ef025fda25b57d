"""Roadside of a network: walking lines behind the kerbs, parking slots, buildings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import without_repeats
from tflane_jax.world.roads.config import Range
from tflane_jax.world.roads.curves import arc_length, direction, offset_polyline, points_at, right_of
from tflane_jax.world.roads.site import Site
from tflane_jax.world.roads.streets import Side

# Parked vehicles keep clear of stop lines, junctions and crossings by these distances, metres.
_CLEAR_BEFORE_STOP, _CLEAR_AFTER_JUNCTION, _CLEAR_OF_CROSSING = 14.0, 8.0, 7.0
_SLOT = 6.5
# Distance of buildings from every kerb, those around a corner included, metres.
_BUILDING_CLEARANCE = 3.2
# Points of a kerb this near to the one before are left out: their direction is rounding, metres.
_SAME_POINT = 0.05


def sidewalks(kerbs: Sequence[Float[np.ndarray, "n 2"]], behind: float) -> list[Float[np.ndarray, "n 2"]]:
    """Return the lines on which pedestrians walk, `behind` metres to the right of the kerbs."""
    return [offset_polyline(without_repeats(kerb, _SAME_POINT), behind) for kerb in kerbs]


def parking_slots(site: Site) -> Float[np.ndarray, "p 3"]:
    """Return x, y and yaw of the slots along all parking strips."""
    slots = [_side_slots(side, site) for street in site.streets for side in (street.forward, street.backward)]
    return np.concatenate([*slots, np.zeros((0, 3))])


def _side_slots(side: Side, site: Site) -> Float[np.ndarray, "p 3"]:
    plan = side.plan
    if not plan.parking:
        return np.zeros((0, 3))
    t = np.arange(_CLEAR_AFTER_JUNCTION, side.line.s[-1] - _CLEAR_BEFORE_STOP, _SLOT)
    # Extra lanes replace the parking strip.
    for extra in plan.extras:
        t = t[(t < extra.start - _SLOT) | (t > extra.stop + _SLOT)]
    xy, heading = side.line.at(t)
    xy = xy + (plan.outer + plan.bike + 0.5 * plan.parking) * right_of(heading)
    keep = np.ones(len(t), bool)
    for ring in site.crossings:
        keep &= np.linalg.norm(xy[:, None] - ring[None], axis=-1).min(1, initial=np.inf) > _CLEAR_OF_CROSSING
    return np.concatenate([xy, np.remainder(heading + np.pi, 2 * np.pi)[:, None] - np.pi], -1)[keep]


def buildings(rng: np.random.Generator, site: Site, setback: Range, density: float) -> Float[np.ndarray, "b 5"]:
    """Return x, y, length, width and yaw of buildings along the kerbs, clear of roads, driveways and car parks.

    Args:
        rng: stream.
        site: with its kerbs.
        setback: behind the kerb, metres.
        density: probability that a plot is built on.
    """
    used = [s.forward.line.xy[::2] for s in site.streets]
    used += [points_at(one.edge, np.arange(0.0, arc_length(one.edge)[-1], 2.0)) for one in site.driveways]
    used.append(site.car_parks[:, :2])
    return buildings_along(rng, site.kerbs, used, setback, density)


def buildings_along(
    rng: np.random.Generator,
    kerbs: Sequence[Float[np.ndarray, "_ 2"]],
    axes: Sequence[Float[np.ndarray, "_ 2"]],
    setback: Range,
    density: float,
) -> Float[np.ndarray, "b 5"]:
    """Return buildings to the right of kerbs, see `buildings`; none stands on a kerb or on a point of `axes`."""
    plots = [_plots(rng, kerb, setback, density) for kerb in kerbs]
    boxes = np.concatenate([*plots, np.zeros((0, 5))])
    road = [points_at(k, np.arange(0.0, arc_length(k)[-1] + 2.0, 2.0)) for k in kerbs]
    free = ~_contains(boxes, np.concatenate([*road, *axes]), _BUILDING_CLEARANCE).any(1)
    boxes = boxes[free]
    return boxes[_apart(boxes)]


def _plots(
    rng: np.random.Generator, kerb: Float[np.ndarray, "n 2"], setback: Range, density: float
) -> Float[np.ndarray, "b 5"]:
    """Return boxes in a row along a kerb, fronts parallel to it."""
    line = without_repeats(kerb, _SAME_POINT)
    total = arc_length(line)[-1]
    count = int(total / 14.0) + 1
    length, depth = rng.uniform(9.0, 24.0, count), rng.uniform(8.0, 16.0, count)
    gap = rng.uniform(1.0, 7.0, count)
    back, built = rng.uniform(*setback, count), rng.random(count) < density
    middle = np.cumsum(length + gap) - 0.5 * length
    keep = built & (middle < total)
    front = points_at(line, middle + 3.0) - points_at(line, middle - 3.0)
    heading = np.arctan2(front[:, 1], front[:, 0])
    xy = points_at(line, middle) + (back + 0.5 * depth)[:, None] * right_of(heading)
    return np.concatenate([xy, np.stack([length, depth, heading], -1)], -1)[keep]


def _contains(
    boxes: Float[np.ndarray, "b 5"], points: Float[np.ndarray, "p 2"], margin: float
) -> Bool[np.ndarray, "b p"]:
    """Return which points lie in which boxes grown by a margin."""
    delta = points[None] - boxes[:, None, :2]
    along, across = direction(boxes[:, 4]), right_of(boxes[:, 4])
    x = np.abs((delta * along[:, None]).sum(-1))
    y = np.abs((delta * across[:, None]).sum(-1))
    return (x < 0.5 * boxes[:, None, 2] + margin) & (y < 0.5 * boxes[:, None, 3] + margin)


def _apart(boxes: Float[np.ndarray, "b 5"]) -> Bool[np.ndarray, " b"]:
    """Return which boxes to keep: a box that overlaps an earlier kept one is dropped."""
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.5, 0.5, 5)), -1).reshape(-1, 2)
    along, across = direction(boxes[:, 4]), right_of(boxes[:, 4])
    points = (
        boxes[:, None, :2]
        + (grid[:, :1] * boxes[:, None, 2:3]) * along[:, None]
        + (grid[:, 1:] * boxes[:, None, 3:4]) * across[:, None]
    )
    hit = _contains(boxes, points.reshape(-1, 2), 0.0).reshape(len(boxes), len(boxes), len(grid)).any(-1)
    hit = np.logical_or(hit, hit.T)
    keep = np.ones(len(boxes), bool)
    for i, row in enumerate(hit):
        keep[i] = not np.any(row[:i] & keep[:i])
    return keep
