"""Where a map cuts lanes: before and behind intersections, not always at the stop line.

Traffic drives on lanes that end at stop lines. Annotators of maps cut them at the stop line, where the kerb starts to
turn, or some metres before. The road in between is then part of the connectors, and has no markings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.roads.curves import arc_length

SHORTEST = 3.0
"""A lane keeps pieces at least this long where it is cut, metres."""
# Lanes that end, or start, side by side are cut together: the cosine of the angle between them, how far one may be
# ahead of the other, and how far beside it, metres.
_ALONG, _AHEAD, _BESIDE = 0.95, 1.0, 20.0
# Cuts are moved by at least this much, metres.
_LEAST = 0.2


def draw_setback(rng: np.random.Generator, mean: float) -> float:
    """Return a distance with an exponential distribution, metres."""
    return float(rng.exponential(mean)) if mean > 0.0 else 0.0


def set_back(rng: np.random.Generator, segments: dict[int, LaneSegment], mean: float) -> dict[int, LaneSegment]:
    """Return lanes that end before and start behind intersections at some distance from the stop lines.

    Connectors grow by what lanes lose. The lanes of one direction of a street are cut side by side.

    Args:
        rng: stream.
        segments: all lanes, with paired boundary vertices.
        mean: of the distances, metres.
    """
    found = dict(segments)
    entries: dict[int, list[int]] = {}
    for number, lane in segments.items():
        for j in lane.successors:
            entries.setdefault(j, []).append(number)
    leads = {i: lane.successors for i, lane in segments.items()}
    for at_end in (True, False):
        beyond, back = (leads, entries) if at_end else (entries, leads)
        cut = {
            i: tuple(beyond[i])
            for i, lane in segments.items()
            if lane.vehicle
            and not lane.is_intersection
            and beyond.get(i)
            and all(segments[j].is_intersection and len(back.get(j, ())) == 1 for j in beyond[i])
        }
        for group in _side_by_side(cut, segments, at_end=at_end):
            room = min(_length(found[i]) for i in group) - SHORTEST
            distance = min(draw_setback(rng, mean), room)
            if distance >= _LEAST:
                for i in group:
                    _move_end(found, i, cut[i], distance, at_end=at_end)
    return found


def cut_lane(found: dict[int, LaneSegment], numbers: Iterator[int], number: int, start: float, stop: float) -> int:
    """Cut a lane in `found` into three, the middle one a connector, and return the id of the first.

    The last keeps the lane's id.

    Args:
        found: all lanes.
        numbers: unused ids.
        number: id of the lane.
        start, stop: distances along it at which it is cut, metres.
    """
    lane = found[number]
    first, middle = next(numbers), next(numbers)
    for other in list(found.values()):
        if number in other.successors:
            onward = tuple(first if j == number else j for j in other.successors)
            found[other.id] = replace(other, successors=onward)
    stops = 0.0, start, stop, _length(lane)
    before, between, behind = (part_of(lane, a, b) for a, b in pairwise(stops))
    found[first] = replace(before, id=first, successors=(middle,))
    found[middle] = replace(unmarked(between), id=middle, successors=(number,))
    found[number] = behind
    return first


def part_of(lane: LaneSegment, start: float, stop: float) -> LaneSegment:
    """Return a lane between two distances along its centerline, metres; its boundaries are cut at the same vertices."""
    along = arc_length(lane.centerline[:, :2])
    at = np.concatenate([[start], along[(along > start + 1e-6) & (along < stop - 1e-6)], [stop]])

    def part(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        return np.stack([np.interp(at, along, line[:, k]) for k in range(3)], -1)

    return replace(lane, centerline=part(lane.centerline), left=part(lane.left), right=part(lane.right))


def unmarked(lane: LaneSegment) -> LaneSegment:
    """Return a lane as one inside an intersection."""
    return replace(lane, left_type=LineType.NONE, right_type=LineType.NONE, is_intersection=True)


def _side_by_side(
    numbers: dict[int, tuple[int, ...]], segments: dict[int, LaneSegment], *, at_end: bool
) -> list[list[int]]:
    """Return lanes grouped with those that end, or start, beside them in the same direction."""
    groups: list[list[int]] = []
    for number in numbers:
        place, heading = _tip(segments[number], at_end=at_end)
        for group in groups:
            other, ahead = _tip(segments[group[0]], at_end=at_end)
            step = other - place
            if heading @ ahead > _ALONG and abs(step @ heading) < _AHEAD and np.hypot(*step) < _BESIDE:
                group.append(number)
                break
        else:
            groups.append([number])
    return groups


def _tip(lane: LaneSegment, *, at_end: bool) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the last, or first, point of a lane and its direction there."""
    a, b = lane.centerline[-2:, :2] if at_end else lane.centerline[:2, :2]
    return (b if at_end else a), (b - a) / np.linalg.norm(b - a)


def _move_end(
    found: dict[int, LaneSegment], number: int, connectors: tuple[int, ...], distance: float, *, at_end: bool
) -> None:
    """Give the last, or first, metres of a lane to the connectors beyond it."""
    lane, length = found[number], _length(found[number])
    if at_end:
        found[number], piece = part_of(lane, 0.0, length - distance), part_of(lane, length - distance, length)
    else:
        found[number], piece = part_of(lane, distance, length), part_of(lane, 0.0, distance)
    for j in connectors:
        pair = (piece, found[j]) if at_end else (found[j], piece)
        lines = {
            name: np.concatenate([getattr(pair[0], name)[:-1], getattr(pair[1], name)])
            for name in ("centerline", "left", "right")
        }
        found[j] = replace(found[j], **lines)


def _length(lane: LaneSegment) -> float:
    return float(arc_length(lane.centerline[:, :2])[-1])
