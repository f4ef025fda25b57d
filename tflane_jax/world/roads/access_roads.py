"""Access roads: driveways with lanes of their own, at which a map cuts the lanes of the street as at any junction.

A surveyor maps the mouth of a yard, a car park or a lane to some houses as a small junction: the street's lanes end
before it and start again behind it, and connectors lead across, in and out. Traffic passes it: vehicles drive on the
uncut lanes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.roads.curves import arc_length, blend, cross, right_of
from tflane_jax.world.roads.cuts import SHORTEST, cut_lane, draw_setback
from tflane_jax.world.roads.site import Driveway, Site

# Lanes up to this far from the mouth belong to the street, metres; lanes run along it if the cosine of the angle
# between them is larger than this.
_ACROSS, _ALONG = 30.0, 0.9
# No lane's middle is nearer to a kerb than this, metres.
_INSIDE = 0.5
# Lanes of an access road are no wider than this, metres.
_WIDEST = 4.0
# Points of a connector that turns.
_POINTS = 16


@dataclass(frozen=True)
class _Cut:
    """Where the lanes of one direction are cut.

    Attributes:
        lanes: ids of the lanes, nearest to the access road first.
        start, stop: distances along each, metres.
    """

    lanes: tuple[int, ...]
    start: tuple[float, ...]
    stop: tuple[float, ...]


def with_access_roads(
    rng: np.random.Generator, segments: dict[int, LaneSegment], site: Site, setback: float, no_left: float
) -> dict[int, LaneSegment]:
    """Return the lanes of a map that includes the access roads of a site; the given lanes are not changed.

    The piece of a cut lane that leads to the next junction keeps the lane's id. A driveway stays one without lanes
    where its street cannot be cut: near a junction, a change of lanes or another cut.

    Args:
        rng: stream.
        segments: all lanes, with paired boundary vertices.
        site: its driveways, kerbs and islands.
        setback: mean distance between the end of a corner's rounding and the lanes that are cut, metres.
        no_left: probability that left turns are forbidden there.
    """
    found = dict(segments)
    numbers = count(max(segments, default=0) + 1)
    walls = [*site.kerbs, *site.islands]
    for driveway in site.driveways:
        if driveway.lanes:
            setbacks = [draw_setback(rng, setback) for _ in range(5)]
            turns_left = rng.random() >= no_left
            cuts = _cuts(driveway, found, walls, setbacks)
            if cuts is not None:
                _cut_in(found, numbers, driveway, cuts, setbacks[-1], turns_left)
    return found


def _cuts(
    driveway: Driveway, segments: dict[int, LaneSegment], walls: Sequence[np.ndarray], setbacks: Sequence[float]
) -> tuple[_Cut, _Cut] | None:
    """Return the cuts of the lanes that run past the driveway and of oncoming ones, or None if there is no room."""
    mouth, outward, ahead = _mouth(driveway)
    # From inside the road, so that the driveway's own kerb is no wall, even if it bends a little.
    start = mouth - _INSIDE * outward
    wall = min((_meets(start, -outward, line)[0] for line in walls), default=np.inf)
    crossed = []
    for number, lane in segments.items():
        distance, station, heading = _meets(start, -outward, lane.centerline[:, :2])
        if lane.vehicle and distance < min(wall, _ACROSS):
            crossed.append((distance, number, station, float(heading @ ahead)))
    crossed.sort()
    near = [c for c in crossed if c[3] > _ALONG]
    oncoming = [c for c in crossed if c[3] < -_ALONG]
    apart = len(near) + len(oncoming) == len(crossed) and crossed[: len(near)] == near
    if not near or not apart or any(segments[number].is_intersection for _, number, _, _ in crossed):
        return None
    half = 0.5 * (driveway.stop - driveway.start)
    cuts = []
    for lanes, (before, behind) in ((near, setbacks[:2]), (oncoming, setbacks[2:4])):
        starts = tuple(station - half - before for _, _, station, _ in lanes)
        stops = tuple(station + half + behind for _, _, station, _ in lanes)
        ends = [arc_length(segments[number].centerline[:, :2])[-1] for _, number, _, _ in lanes]
        if any(a < SHORTEST for a in starts) or any(e - b < SHORTEST for b, e in zip(stops, ends, strict=True)):
            return None
        cuts.append(_Cut(tuple(number for _, number, _, _ in lanes), starts, stops))
    return cuts[0], cuts[1]


def _mouth(driveway: Driveway) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the middle of a driveway's mouth and the directions out of the road and along its kerb."""
    first, last = driveway.edge[0], driveway.edge[-1]
    ahead = (last - first) / np.linalg.norm(last - first)
    return 0.5 * (first + last), np.array([ahead[1], -ahead[0]]), ahead


def _meets(
    origin: Float[np.ndarray, "2"], ray: Float[np.ndarray, "2"], line: Float[np.ndarray, "n 2"]
) -> tuple[float, float, Float[np.ndarray, "2"]]:
    """Return where a ray first meets a line: distance along the ray, along the line, and the line's direction."""
    step = np.diff(line, axis=0)
    sine = cross(ray, step)
    parallel = np.abs(sine) < 1e-9
    sine = np.where(parallel, 1.0, sine)
    d = line[:-1] - origin
    # origin + t ray = line + u step
    t, u = cross(d, step) / sine, cross(d, ray) / sine
    t = np.where(~parallel & (u >= 0.0) & (u <= 1.0) & (t > 0.0), t, np.inf)
    k = int(t.argmin()) if len(t) else 0
    if not len(t) or np.isinf(t[k]):
        return np.inf, 0.0, np.zeros(2)
    length = float(np.linalg.norm(step[k]))
    return float(t[k]), float(arc_length(line)[k] + u[k] * length), step[k] / length


def _cut_in(
    found: dict[int, LaneSegment],
    numbers: Iterator[int],
    driveway: Driveway,
    cuts: tuple[_Cut, _Cut],
    setback: float,
    turns_left: bool,
) -> None:
    """Cut the street's lanes in `found`, and add the access road's two lanes and the connectors."""
    before, behind = [], []
    for cut in cuts:
        for number, start, stop in zip(cut.lanes, cut.start, cut.stop, strict=True):
            first = cut_lane(found, numbers, number, start, stop)
            if number == cut.lanes[0]:
                before.append(first)
                behind.append(number)
    entry, leaving = (_lane_of(driveway, next(numbers), setback, leaves=leaves) for leaves in (False, True))
    found[entry.id], found[leaving.id] = entry, leaving
    for side in range(len(before) if turns_left else 1):
        for a, b in ((before[side], entry.id), (leaving.id, behind[side])):
            turn = _turn(next(numbers), found[a], found[b])
            found[turn.id] = turn
            found[a] = replace(found[a], successors=(*found[a].successors, turn.id))


def _lane_of(driveway: Driveway, number: int, setback: float, *, leaves: bool) -> LaneSegment:
    """Return the lane of an access road that leads in, or out; traffic keeps to the right."""
    mouth, outward, ahead = _mouth(driveway)
    width = min(0.5 * driveway.lanes, _WIDEST)
    far = float(((driveway.edge - mouth) @ outward).max())
    # It starts behind the rounding of the corner.
    near = min(driveway.rounding + setback, far - SHORTEST)
    side = 1.0 if leaves else -1.0
    at = np.linspace(near, far, 5)[:, None] * outward + mouth + side * 0.25 * driveway.lanes * ahead
    at = at[::-1] if leaves else at
    half = 0.5 * width * right_of(np.arctan2(*(at[-1] - at[0])[::-1]))
    center, left, right = (np.pad(line, ((0, 0), (0, 1))) for line in (at, at - half, at + half))
    return LaneSegment(number, center, left, right, LineType.NONE, LineType.NONE, is_intersection=False, successors=())


def _turn(number: int, source: LaneSegment, sink: LaneSegment) -> LaneSegment:
    """Return the connector from the end of one lane to the start of another."""
    headings = [
        np.arctan2(*(line[k + 1] - line[k])[[1, 0]]) for line, k in ((source.centerline, -2), (sink.centerline, 0))
    ]
    a, b = source.centerline[-1, :2], sink.centerline[0, :2]
    center, heading = blend(a[None], np.array(headings[:1]), b[None], np.array(headings[1:]), _POINTS)
    wide = [float(np.linalg.norm(lane.left[k] - lane.right[k])) for lane, k in ((source, -1), (sink, 0))]
    side = 0.5 * np.linspace(wide[0], wide[1], _POINTS)[:, None] * right_of(heading[0])
    left, right = (np.pad(center[0] + sign * side, ((0, 0), (0, 1))) for sign in (-1.0, 1.0))
    left[[0, -1]], right[[0, -1]] = (source.left[-1], sink.left[0]), (source.right[-1], sink.right[0])
    middle = 0.5 * (left + right)
    none = LineType.NONE
    return LaneSegment(number, middle, left, right, none, none, is_intersection=True, successors=(sink.id,))
