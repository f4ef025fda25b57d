"""Pedestrian crossings and road boundaries of OpenLane-V2 from a vector map and an ego pose.

The conversion code of OpenLane-V2 is not public; docs/reference/openlane_v2_truth.md (steps 8 and 9) gives the rules
and their sources.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.map_geometry import BOUNDARY_MARGIN, clip_ring, shrunken
from tflane_jax.datasets.prepared_map import PreparedMap
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.polylines import clip_to_range, nearest_lines, resample, resample_lines
from tflane_jax.scene import Areas, AreaType

# Metres between both ends of a ring; files have a tenth of this.
_CLOSED = 1e-3


def crop_areas(
    prepared: PreparedMap,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    *,
    capacity: int,
    points: int,
    crossings: Literal["ring", "sides"] = "ring",
) -> tuple[Areas, int]:
    """Return the areas near the vehicle, ego frame, and how many of them (the farthest) exceeded the capacity.

    Crossings that meet the range stay whole; road boundaries are cut `BOUNDARY_MARGIN` inside the range.

    Args:
        prepared, ego_from_global, range_: map, pose, and perception range in the ego frame.
        capacity, points: areas in the result, and points on each.
        crossings: form of crossings, see `ExampleConfig`.
    """
    outlines = prepared.crossings.moved(ego_from_global)
    # A ring that meets the range crosses its border or lies inside it; no crossing is large enough to surround it.
    rings = [outlines.line(i) for i in outlines.near(range_)]
    rings = [ring for ring in rings if clip_to_range(ring, range_)]
    inner = shrunken(range_, BOUNDARY_MARGIN)
    lines = prepared.boundaries.moved(ego_from_global)
    boundaries = [piece for i in lines.near(inner) for piece in clip_ring(lines.line(i), inner)]
    found = rings + boundaries
    category = [AreaType.PEDESTRIAN_CROSSING] * len(rings) + [AreaType.ROAD_BOUNDARY] * len(boundaries)
    kept = nearest_lines(found, capacity)
    n, areas = len(kept), Areas.empty(capacity, points)
    if n:
        areas.points[:n] = resample_lines([found[i] for i in kept], points)
        areas.category[:n] = [category[i] for i in kept]
        areas.valid[:n] = True
        if crossings == "sides":
            with_sides(areas, [found[i] for i in kept])
    return areas, len(found) - n


def is_closed(outline: Float[np.ndarray, "n 3"]) -> bool:
    """Return whether a line ends where it begins, within a millimetre."""
    return bool(np.abs(outline[0] - outline[-1]).max() < _CLOSED)


def with_sides(areas: Areas, outlines: Sequence[np.ndarray]) -> None:
    """Replace the crossings among the first rows of `areas` (numpy, in place) by the long sides of their outlines."""
    for row, outline in enumerate(outlines):
        if areas.category[row] == AreaType.PEDESTRIAN_CROSSING:
            areas.points[row] = crossing_sides(outline, areas.points.shape[1])


def crossing_sides(outline: Float[np.ndarray, "n 3"], points: int) -> Float[np.ndarray, "points 3"]:
    """Return the left side of a crossing followed by its reversed right side, half of the points on each.

    The long sides of an outline of four corners are its first and its third edge, as in Argoverse 2 and OpenLane-V2;
    other outlines are cut in two halves of equal length. As in LaneSegNet's loader, the left side is the edge that runs
    in a direction between -45 and 135 degrees, in the order of the outline.

    Args:
        outline: closed ring, metres, ego frame.
        points: an even number.

    Raises:
        UserError: the number of points is odd.
    """
    if points % 2:
        raise UserError(f"ExampleConfig.area_points = {points} cannot be shared by two sides: give an even number")
    if len(outline) == 5:
        first, second = outline[:2], outline[2:4]
    else:
        dense = resample(outline, 2 * points)
        first, second = dense[:points], dense[points:]
    step = first[-1, :2] - first[0, :2]
    if not -45.0 <= np.rad2deg(np.arctan2(step[1], step[0])) <= 135.0:
        first, second = second, first
    return np.concatenate([resample(first, points // 2), resample(second, points // 2)])
