"""Beside the lanes of a recorded map: kerbs, walking lines, parking slots. Recorded maps hold none of them.

All of it follows from the border of the drivable area and the lanes. It is a guess about a real place: cars park where
the road is wide enough, and people walk behind every kerb.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.roads.curves import arc_length, cross, offset_polyline, points_at

if TYPE_CHECKING:
    from scipy.spatial import KDTree

# Distance between points on kerbs and lanes, metres.
_SPACING = 1.5
# A piece of border is a kerb where the nearest lane is between these distances, metres: nearer, it crosses the lane at
# the end of the map; farther, it belongs to something else.
_NEAREST_LANE, _FARTHEST_LANE = 1.4, 25.0
_SHORTEST_KERB = 8.0
# A walking line is nearer than this fraction of its distance to no kerb, its own one included.
_OWN_KERB = 0.8
# A smaller ring inside the road is an island, square metres.
_ISLAND = 400.0
# Room for a parked car beside a lane, metres: at least, at most; and from its middle to the kerb.
_LEAST_ROOM, _MOST_ROOM, _TO_KERB = 2.1, 4.5, 1.2
# Parked vehicles keep clear of ends and starts of lanes, crossings and centerlines, metres.
_CLEAR_BEFORE, _CLEAR_AFTER, _CLEAR_OF_CROSSING, _CLEAR_OF_LANE = 12.0, 7.0, 7.0, 2.6
# Recorded parked vehicles stand nearer to centerlines: a lane may include the strip on which they park.
_PARKED_OFF_LANE = 1.6
# Two of them nearer than this to each other were never there at one time, metres: no vehicle is narrower.
_ONE_PLACE = 1.7
_SLOT = 6.5


def lane_points(lanes: Iterable[LaneSegment]) -> Float[np.ndarray, "p 2"]:
    """Return points of all centerlines, at most 1.5 m apart."""
    return np.concatenate([np.zeros((0, 2)), *(evenly(lane.centerline[:, :2], _SPACING) for lane in lanes)])


def evenly(line: Float[np.ndarray, "n 2"], spacing: float) -> Float[np.ndarray, "k 2"]:
    """Return a line resampled at equal steps of at most `spacing` metres."""
    length = arc_length(line)[-1]
    return points_at(line, np.linspace(0.0, length, max(int(np.ceil(length / spacing)), 1) + 1))


def clip_border(
    lines: Sequence[Float[np.ndarray, "_ d"]], low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the parts of lines inside a box, in their direction; a ring that is cut becomes open pieces."""
    found = []
    for line in lines:
        xy = np.asarray(line, np.float64)[:, :2]
        inside = np.asarray(((xy >= low) & (xy <= high)).all(1))
        if inside.all():
            found.append(xy)
        elif np.linalg.norm(xy[0] - xy[-1]) < 0.05:
            start = int(np.argmin(inside))  # outside, so that no piece is cut at the seam
            found += _runs(np.roll(xy[:-1], -start, axis=0), np.roll(inside[:-1], -start), 2)
        else:
            found += _runs(xy, inside, 2)
    return found


def facing_lanes(
    lines: Sequence[Float[np.ndarray, "_ 2"]], lanes: Float[np.ndarray, "p 2"]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return border lines in the direction in which the road is on their left: where most of the nearest lanes are."""
    from scipy.spatial import KDTree

    tree = KDTree(lanes)
    found = []
    for line in lines:
        points = evenly(line, 2.0 * _SPACING)
        distance, nearest = map(np.asarray, tree.query(points[:-1]))
        near = distance < _FARTHEST_LANE
        side = np.sign(cross(np.diff(points, axis=0)[near], lanes[nearest[near]] - points[:-1][near]))
        found.append(line[::-1] if side.sum() < 0.0 else line)
    return found


def kerbs_of(
    border: Sequence[Float[np.ndarray, "_ 2"]], lanes: Float[np.ndarray, "p 2"]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the parts of oriented border lines that are kerbs beside lanes, without islands."""
    from scipy.spatial import KDTree

    tree = KDTree(lanes)
    found = []
    for line in border:
        if np.linalg.norm(line[0] - line[-1]) < 0.05 and 0.0 < -_area(line) < _ISLAND:
            continue
        points = evenly(line, _SPACING)
        distance = tree.query(points)[0]
        found += _runs(points, (distance > _NEAREST_LANE) & (distance < _FARTHEST_LANE), int(_SHORTEST_KERB / _SPACING))
    return found


def _area(ring: Float[np.ndarray, "n 2"]) -> float:
    """Return the signed area of a ring, square metres: negative for one whose left side is outside."""
    x, y = (ring - ring[0]).T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def _runs(points: Float[np.ndarray, "n 2"], keep: Bool[np.ndarray, " n"], least: int) -> list[np.ndarray]:
    """Return the stretches of consecutive points to keep that have at least `least` points."""
    edge = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(int)))
    return [points[a:b] for a, b in zip(edge[::2], edge[1::2], strict=True) if b - a >= least]


def walking_lines(
    kerbs: Sequence[Float[np.ndarray, "_ 2"]], behind: float, lanes: Float[np.ndarray, "p 2"]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the lines on which pedestrians walk, `behind` metres to the right of the kerbs.

    They leave out narrow medians, behind whose kerb the other carriageway begins.
    """
    from scipy.spatial import KDTree

    if not kerbs:
        return []
    every, tree = KDTree(np.concatenate(kerbs)), KDTree(lanes)
    found = []
    for kerb in kerbs:
        line = offset_polyline(kerb, behind)
        free = (every.query(line)[0] > _OWN_KERB * behind) & (tree.query(line)[0] > _CLEAR_OF_LANE)
        found += _runs(line, np.asarray(free), int(_SHORTEST_KERB / _SPACING))
    return found


def parking_places(
    segments: Mapping[int, LaneSegment],
    kerbs: Sequence[Float[np.ndarray, "_ 2"]],
    crossings: Sequence[Float[np.ndarray, "_ d"]],
    parked: Float[np.ndarray, "q 3"],
) -> Float[np.ndarray, "p 3"]:
    """Return x, y and yaw of slots: where vehicles were seen parked, and beside lanes where the road leaves room.

    Args:
        segments, kerbs, crossings: of the map.
        parked: x, y, yaw of places where vehicles were seen parked.
    """
    from scipy.spatial import KDTree

    lanes = KDTree(lane_points(segments.values()))
    parked = parked[lanes.query(parked[:, :2])[0] > _PARKED_OFF_LANE]
    parked = parked[_first_of_each(parked[:, :2], _ONE_PLACE)]
    slots = [np.zeros((0, 3))]
    if kerbs:
        tree = KDTree(np.concatenate(kerbs))
        beside = [s for s in segments.values() if s.vehicle and not s.is_intersection]
        slots += [_slots(segment, side, tree) for segment in beside for side in ("left", "right")]
    found = np.concatenate(slots)
    found = found[lanes.query(found[:, :2])[0] > _CLEAR_OF_LANE]
    rings = np.concatenate([np.full((1, 2), np.inf), *(evenly(ring[:, :2], _SPACING) for ring in crossings)])
    found = found[np.linalg.norm(found[:, None, :2] - rings, axis=-1).min(1) > _CLEAR_OF_CROSSING]
    if len(parked):
        found = found[KDTree(parked[:, :2]).query(found[:, :2])[0] > _SLOT]
    return np.concatenate([parked, found[_first_of_each(found[:, :2], 0.95 * _SLOT)]])


def _slots(segment: LaneSegment, side: str, kerbs: KDTree) -> Float[np.ndarray, "p 3"]:
    """Return the slots along one side of a lane: nothing if the next lane or no kerb is there."""
    edge = evenly(getattr(segment, side)[:, :2], 0.5)
    along = arc_length(edge)
    t = np.arange(_CLEAR_AFTER, along[-1] - _CLEAR_BEFORE, _SLOT)
    at, ahead = points_at(edge, t), points_at(edge, t + 1.0) - points_at(edge, t - 1.0)
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-6)
    outward = np.stack([ahead[:, 1], -ahead[:, 0]], -1) * (1.0 if side == "right" else -1.0)
    room, nearest = kerbs.query(at)
    kerb = kerbs.data[nearest]
    fits = (room > _LEAST_ROOM) & (room < _MOST_ROOM) & (((kerb - at) * outward).sum(-1) > 0.85 * room)
    xy = at + (room - _TO_KERB)[:, None] * outward
    return np.column_stack([xy, np.arctan2(ahead[:, 1], ahead[:, 0])])[fits]


def _first_of_each(xy: Float[np.ndarray, "n 2"], apart: float) -> Bool[np.ndarray, " n"]:
    """Return which places to keep: of those nearer than `apart` metres to each other, the first."""
    near = np.linalg.norm(xy[:, None] - xy, axis=-1) < apart
    keep = np.ones(len(xy), bool)
    for i in range(len(xy)):
        keep[i] = not (near[i, :i] & keep[:i]).any()
    return keep
