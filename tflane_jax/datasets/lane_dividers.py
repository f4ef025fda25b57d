"""Dividers of a vector map: the lines between two lanes.

nuScenes labels dividers as lines of their own. Argoverse 2 and the built-in world have the boundaries of lanes, cut
wherever a marking changes. As in MapTRv2's conversion of Argoverse 2, a divider is a boundary that two lanes outside
intersections share, painted or not; its stretches are joined end to end.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.datasets.map_geometry import join_ends
from tflane_jax.geometry import line_distances, line_lengths, resample_lines
from tflane_jax.scene.logs import LaneSegment

# Two boundaries are one line if all points of either lie this near to the other, metres.
_SAME_LINE = 0.3
_POINTS = 21


def lane_dividers(lanes: Sequence[LaneSegment]) -> list[np.ndarray]:
    """Return the dividers of a map's lane segments, polylines (n, 3), global metres."""
    outside = [(number, lane) for number, lane in enumerate(lanes) if not lane.is_intersection]
    sides = [(number, line) for number, lane in outside for line in (lane.left, lane.right) if len(line) > 1]
    if not sides:
        return []
    owner = np.array([number for number, _ in sides])
    lines = [line for _, line in sides]
    dense = resample_lines(lines, _POINTS)
    length = line_lengths(dense)
    kept: list[int] = []
    for i in np.argsort(-length, kind="stable").tolist():
        near = _touching(dense, i)
        there, back = _lies_on(dense, i, near)
        shared = (owner[near] != owner[i]) & (there | back)
        if shared.any() and not np.isin(near[there], kept).any():
            kept.append(i)
    return join_ends([lines[i] for i in sorted(kept)])


def _touching(lines: Float[np.ndarray, "n p 3"], number: int) -> Int[np.ndarray, " k"]:
    """Return the numbers of the other lines whose bounding boxes meet that of a line."""
    low, high = lines[..., :2].min(1) - _SAME_LINE, lines[..., :2].max(1)
    meets = ((low <= high[number]) & (low[number] <= high)).all(-1)
    meets[number] = False
    return np.flatnonzero(meets)


def _lies_on(
    lines: Float[np.ndarray, "n p 3"], number: int, others: Int[np.ndarray, " k"]
) -> tuple[Bool[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
    """Return whether a line lies on each of the others, and whether each of these lies on it."""
    if not len(others):
        return np.zeros(0, bool), np.zeros(0, bool)
    line = lines[number]
    there, _ = line_distances(line, lines[others])
    back, _ = line_distances(lines[others], line)
    return there.max(-1) < _SAME_LINE, back.max(-1) < _SAME_LINE
