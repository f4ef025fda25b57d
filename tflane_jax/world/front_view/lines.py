"""TuSimple labels of a front view: which lane lines are annotated, and their points in the image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.scene import LaneLines
from tflane_jax.world.front_view.ground import image_columns
from tflane_jax.world.front_view.road import Highway
from tflane_jax.world.render.camera import PinholeCamera

# TuSimple's rows, as fractions of the image's height: 160, 170, ..., 710 of 720.
ROW_FRACTIONS = np.arange(160, 720, 10) / 720.0
CAPACITY = 8
# Two lines on each side of the vehicle are annotated; five if it is nearer than this to a line, metres.
_ON_LINE = 0.6
_MOST = 5
# A line with fewer points is not annotated.
_FEWEST_POINTS = 3


def label_lines(camera: PinholeCamera, road: Highway, reach: float) -> LaneLines:
    """Return the lane lines in the image, left to right; occlusion, dashes and wear leave no gaps.

    Args:
        camera: of the image.
        road: with its lane lines.
        reach: lines are annotated up to this station, metres.
    """
    lines = LaneLines.empty(CAPACITY, len(ROW_FRACTIONS))
    lines.points[..., 1] = ROW_FRACTIONS
    found = [_points(camera, road, number, reach) for number in marked_lines(road)]
    found = [(u, valid) for u, valid in found if valid.sum() >= _FEWEST_POINTS]
    for slot, (u, valid) in enumerate(found):
        lines.points[slot, :, 0] = np.where(valid, u, 0.0)
        lines.point_valid[slot] = valid
        lines.valid[slot] = True
    return lines


def marked_lines(road: Highway) -> Int[np.ndarray, " k"]:
    """Return the indices of the annotated lines, left to right."""
    here = np.array([np.interp(0.0, road.axis.s, line) for line in road.lines]) - road.ego_offset
    there = np.array([np.interp(0.0, road.axis.s, line) for line in road.present.astype(float)]) > 0.5
    numbers, beside = np.flatnonzero(there), here[there]
    order = np.arange(len(numbers))
    nearest = int(np.argmin(np.abs(beside)))
    if np.abs(beside[nearest]) < _ON_LINE:
        chosen = numbers[(order >= nearest - 2) & (order <= nearest + 2)]
    else:
        right = int(np.argmax(beside > 0.0))
        chosen = numbers[(order >= right - 2) & (order <= right + 1)]
    # The line of a lane that opens ahead is annotated if it lies between two annotated lines.
    later = np.flatnonzero(~there)
    return np.sort(np.append(chosen, later[(later > chosen[0]) & (later < chosen[-1])]))[:_MOST]


def _points(
    camera: PinholeCamera, road: Highway, number: int, reach: float
) -> tuple[Float[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """Return u (fraction of the width) of one line at `ROW_FRACTIONS`, and where it has a point."""
    u, s = image_columns(camera, road, road.lines[number], ROW_FRACTIONS * camera.height, reach)
    there = np.interp(np.nan_to_num(s), road.axis.s, road.present[number].astype(float)) > 0.5
    u = u / camera.width
    with np.errstate(invalid="ignore"):
        return u, np.isfinite(u) & there & (u >= 0.0) & (u < 1.0)
