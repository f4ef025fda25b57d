"""Pedestrian crossings and road boundaries of OpenLane-V2 from a vector map and an ego pose.

The conversion code of OpenLane-V2 is not public; docs/reference/openlane_v2_truth.md (steps 8 and 9) gives the rules
and their sources.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.prepared_map import PreparedMap
from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.polylines import clip_to_range, resample_lines
from tflane_jax.scene import Areas, AreaType

# Metres. MapTR cuts road boundaries this far inside the range; figures of OpenLane-V2 agree with it.
BOUNDARY_MARGIN = 0.2


def crop_areas(
    prepared: PreparedMap,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    *,
    capacity: int,
    points: int,
) -> tuple[Areas, int]:
    """Return the areas near the vehicle, ego frame, and how many of them (the farthest) exceeded the capacity.

    Crossings that meet the range stay whole; road boundaries are cut `BOUNDARY_MARGIN` inside the range.
    """
    crossings = prepared.crossings.moved(ego_from_global)
    # A ring that meets the range crosses its border or lies inside it; no crossing is large enough to surround it.
    rings = [crossings.line(i) for i in crossings.near(range_)]
    rings = [ring for ring in rings if clip_to_range(ring, range_)]
    low, high = BOUNDARY_MARGIN, -BOUNDARY_MARGIN
    inner = PerceptionRange((range_.x[0] + low, range_.x[1] + high), (range_.y[0] + low, range_.y[1] + high), range_.z)
    lines = prepared.boundaries.moved(ego_from_global)
    boundaries = [piece for i in lines.near(inner) for piece in clip_ring(lines.line(i), inner)]
    found = rings + boundaries
    category = [AreaType.PEDESTRIAN_CROSSING] * len(rings) + [AreaType.ROAD_BOUNDARY] * len(boundaries)
    distance = [np.linalg.norm(line[:, :2], axis=-1).min() for line in found]
    kept = sorted(np.argsort(distance, kind="stable")[:capacity].tolist())
    n, areas = len(kept), Areas.empty(capacity, points)
    if n:
        areas.points[:n] = resample_lines([found[i] for i in kept], points)
        areas.category[:n] = [category[i] for i in kept]
        areas.valid[:n] = True
    return areas, len(found) - n


def clip_ring(line: np.ndarray, range_: PerceptionRange) -> list[np.ndarray]:
    """Cut a line at the range. The pieces of a closed ring are joined again where its first point lies in the range."""
    pieces = clip_to_range(line, range_)
    closed = np.array_equal(line[0], line[-1])
    if closed and len(pieces) > 1 and all(np.array_equal(p, line[0]) for p in (pieces[0][0], pieces[-1][-1])):
        pieces = [np.concatenate([pieces[-1], pieces[0][1:]]), *pieces[1:-1]]
    return pieces
