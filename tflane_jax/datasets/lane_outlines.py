"""Left and right boundaries of lanes for maps that store only center lines and, for some lanes, outlines.

In nuScenes a center line may start and end inside the lane's outline, and lanes through intersections have no outline.
The boundaries run beside the center line: where a line across it meets the outline, or half a width away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Metres: half the width of a lane of which nothing is known.
HALF_WIDTH = 1.75
# Metres; an outline farther from the center line than this is not the side of a lane.
_FARTHEST = 8.0
# Of a lane's median half width; a smaller one is that of an end of the outline, which is slanted or ends here.
_NARROWEST = 0.6


@dataclass(frozen=True)
class LaneOutline:
    """A lane of such a map.

    Attributes:
        centerline: (n, 2) metres, n >= 2, different consecutive points, in driving direction.
        outline: (m, 2) closed or open ring, or None.
    """

    centerline: np.ndarray
    outline: np.ndarray | None


def half_widths(lane: LaneOutline) -> Float[np.ndarray, "2 n"] | None:
    """Return the distance from each point of the center line to the outline, to the left and to the right, metres.

    None without an outline, or where it is nowhere beside the center line.
    """
    if lane.outline is None or len(lane.outline) < 3:
        return None
    left = _left(lane.centerline)
    sides = [_filled(_to_outline(lane.centerline, across, lane.outline)) for across in (left, -left)]
    return None if sides[0] is None or sides[1] is None else np.stack([sides[0], sides[1]])


def boundaries(
    lanes: Mapping[int, LaneOutline], successors: Mapping[int, Sequence[int]]
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return the left and right boundary (n, 2) of each lane, points beside those of its center line.

    The width of a lane without an outline goes evenly from that of the lanes before it to that of the lanes after it.

    Args:
        lanes: by number.
        successors: numbers of the lanes that continue each lane; those that `lanes` lacks are passed over.
    """
    widths = {number: half_widths(lane) for number, lane in lanes.items()}
    before: dict[int, list[int]] = {number: [] for number in lanes}
    for number, after in successors.items():
        for other in after:
            if number in lanes and other in lanes:
                before[other].append(number)
    found = {}
    for number, lane in lanes.items():
        width = widths[number]
        if width is None:
            starts = [known[:, -1] for i in before[number] if (known := widths[i]) is not None]
            after = [known[:, 0] for i in successors.get(number, ()) if (known := widths.get(i)) is not None]
            start = np.mean(starts or after, axis=0) if starts or after else np.full(2, HALF_WIDTH)
            end = np.mean(after, axis=0) if after else start
            along = np.linspace(0.0, 1.0, len(lane.centerline))
            width = start[:, None] + (end - start)[:, None] * along
        left = _left(lane.centerline)
        found[number] = (lane.centerline + width[0, :, None] * left, lane.centerline - width[1, :, None] * left)
    return found


def _left(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Return the unit vector to the left of a line at each of its points."""
    step = np.diff(line, axis=0)
    step /= np.linalg.norm(step, axis=-1, keepdims=True)
    heading = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
    length = np.linalg.norm(heading, axis=-1, keepdims=True)
    # Where a line turns back by 180 degrees, the heading before the turn counts.
    heading = np.where(length > 1e-6, heading / np.maximum(length, 1e-6), np.concatenate([step[:1], step]))
    return np.stack([-heading[:, 1], heading[:, 0]], -1)


def _to_outline(
    points: Float[np.ndarray, "n 2"], direction: Float[np.ndarray, "n 2"], ring: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " n"]:
    """Return the distance along a ray from each point to a ring; infinite where it does not meet it."""
    a, b = ring, np.roll(ring, -1, axis=0)
    side = b - a
    apart = a - points[:, None]
    cross = direction[:, None, 0] * side[:, 1] - direction[:, None, 1] * side[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (apart[..., 0] * side[:, 1] - apart[..., 1] * side[:, 0]) / cross
        on_side = (apart[..., 0] * direction[:, None, 1] - apart[..., 1] * direction[:, None, 0]) / cross
        meets = (cross != 0.0) & (distance > 0.0) & (on_side >= 0.0) & (on_side <= 1.0)
    return np.where(meets, distance, np.inf).min(-1)


def _filled(width: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"] | None:
    """Return half widths with those that are missing, too large or too small interpolated; None if all are missing."""
    known = width < _FARTHEST
    if known.any():
        known &= width > _NARROWEST * np.median(width[known])
    if not known.any():
        return None
    places = np.arange(len(width))
    return np.interp(places, places[known], width[known])
