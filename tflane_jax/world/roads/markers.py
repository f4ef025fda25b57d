"""Placement of fiducial markers: beside the road, before junctions, splits and merges (marker paper, section IV-A).

The positions depend on the map alone. Ids and small deviations of the boards are drawn from a separate stream, so
markers change nothing else in a scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import arc_length, line_lengths, pose_matrix, segment_distances, wrap_angle
from tflane_jax.limits import Positive, PositiveOrZero, within
from tflane_jax.scene.logs import LaneSegment, PlacedMarkers, VectorMap
from tflane_jax.world.roads.curves import cross

ROOT = 20_251_122
# Two lane ends are side by side within these limits: along and across the road (metres) and in heading.
_ALONG, _ACROSS, _TURNED = 10.0, 25.0, np.deg2rad(30.0)
# A kerb farther from the lane than this belongs to another area such as a parking lot, metres.
_FARTHEST_KERB = 8.0
# Without a kerb: from the lane's right boundary to the edge of the road, metres.
_NO_KERB = 0.5
# A board nearer than this to a centerline would be on the road, metres.
_CLEAR = 2.0
# Where a surveyor looks for a clear place: distances along the lane, and farther behind the kerb, metres. The first
# place of which drivers see this fraction is taken.
_AWAY, _FARTHER_BACK, _ENOUGH = (0.0, 3.0, 6.0, 10.0, 15.0, 20.0), 0.8, 0.98
# Metres before a board at which drivers should see it, and to the side of the line along which its traffic comes.
_NEAREST, _FARTHEST, _ASIDE = 8.0, 50.0, 15.0


@dataclass(frozen=True)
class PlacementConfig:
    """How markers are placed.

    Attributes:
        per: "approach": a marker at every approach of a junction, split or merge; "scene": one of these per map, as in
            the paper: the one that most frames of the drive approach.
        side: "near": before the junction only; "both": also beyond it, to the right of the lanes that leave it, facing
            traffic that crosses the junction, which sees it from farther away and for longer.
        size: side of the black square, metres (paper: 1).
        height: of the marker's middle above the road, metres.
        setback: from the kerb to the marker's middle, metres.
        toe_in: yaw of the board from facing the traffic towards the road, degrees.
        jitter: largest deviation of a board's yaw (uniform), degrees.
        dictionary: number of ids, from 0; a map never has more markers than ids.
        site: "junction": at the end of the lane, whatever stands before it. "clear": where a surveyor would put it, the
            first place along the lane that drivers see from `world.cameras.marker_sites.VIEWS` without a mast, sign,
            lamp post, tree or building before it (needs OpenCV).
    """

    per: Literal["approach", "scene"] = "approach"
    side: Literal["near", "both"] = "near"
    size: Positive = 1.0
    height: PositiveOrZero = 3.0
    setback: PositiveOrZero = 0.8
    toe_in: PositiveOrZero = 5.0
    jitter: PositiveOrZero = 3.0
    dictionary: Annotated[int, within(1, 100)] = 100
    site: Literal["junction", "clear"] = "junction"


Visible = Callable[[Float[np.ndarray, "3"], float], float]
"""(middle of a board, heading of the traffic it faces) -> fraction of it that drivers see, 0 to 1."""


def place_markers(
    vector_map: VectorMap,
    seed: int,
    config: PlacementConfig = PlacementConfig(),
    visible: Visible | None = None,
    poses: Float[np.ndarray, "f 4 4"] | None = None,
) -> PlacedMarkers:
    """Return the markers of a map, in no particular order: to the right of each approach, facing its traffic.

    An approach is all lanes that end side by side where an intersection, a split or a merge begins. The marker stands
    behind the kerb to the right of the lanes' end, and also beyond the junction with `side` "both". A position in the
    middle of another lane is skipped.

    The same map and seed give the same bits. A map without approaches has no markers.

    Args:
        vector_map, seed, config: see above.
        visible: chooses among places along a lane; None takes the end of each lane.
        poses: global_from_ego of the drive, for `per` "scene"; None, and markers that equally many frames approach, are
            chosen among at random.
    """
    lanes = vector_map.segments
    ends = [(lanes[i], -1) for i in _approach_lanes(lanes)], [(lanes[i], 0) for i in _exit_lanes(lanes)]
    chosen = [_rightmost_lanes(side) for side in ends[: 2 if config.side == "both" else 1]]
    sites = [site for side in chosen for site in side]
    place, heading, clear = _places(sites, 0.0, config.setback, vector_map, config)
    if visible is not None:
        place, heading, clear = _most_visible(sites, (place, heading, clear), vector_map, config, visible)
    place, heading = place[clear], heading[clear]

    rng = np.random.default_rng([ROOT, seed])
    number = rng.permutation(config.dictionary).astype(np.int32)
    kept = rng.permutation(len(place))
    if config.per == "scene":
        frames = [0 if poses is None else len(approaching(poses, place[i], float(heading[i]))) for i in kept]
        kept = kept[np.argsort(np.negative(frames), kind="stable")[:1]]
    kept = kept[: config.dictionary]
    facing = heading + np.pi - np.deg2rad(config.toe_in + rng.uniform(-config.jitter, config.jitter, len(place)))
    return PlacedMarkers(number[: len(kept)], marker_pose(place, facing)[kept], config.size)


def approaching(
    poses: Float[np.ndarray, "f 4 4"], place: Float[np.ndarray, "3"], heading: float
) -> Int[np.ndarray, " k"]:
    """Return the frames, by number, in which a vehicle drives towards a board from 50 to 8 m before it.

    Args:
        poses: global_from_ego.
        place, heading: the board's middle, metres, and the heading of the traffic that it faces, radians.
    """
    away = poses[:, :2, 3] - place[:2]
    before = -(away @ [np.cos(heading), np.sin(heading)])
    aside = np.abs(away @ [-np.sin(heading), np.cos(heading)])
    same_way = poses[:, :2, 0] @ [np.cos(heading), np.sin(heading)] > 0.5
    return np.flatnonzero((before >= _NEAREST) & (before <= _FARTHEST) & (aside <= _ASIDE) & same_way)


def marker_pose(place: Float[np.ndarray, "m 3"], facing: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 4 4"]:
    """Return the poses of upright markers at `place` whose z axis has the heading `facing` (metres, radians)."""
    zero, one = np.zeros_like(facing), np.ones_like(facing)
    out = np.stack([np.cos(facing), np.sin(facing), zero], -1)
    up = np.stack([zero, zero, one], -1)
    return pose_matrix(np.stack([np.cross(up, out), up, out], -1), place)


def _approach_lanes(segments: dict[int, LaneSegment]) -> list[int]:
    """Return the ids of the lanes outside of intersections at whose end an intersection, a split or a merge begins."""
    open_ = {i: [j for j in s.successors if j in segments and segments[j].vehicle] for i, s in segments.items()}
    entries: dict[int, int] = {}
    for i, onward in open_.items():
        for j in onward if segments[i].vehicle else ():
            entries[j] = entries.get(j, 0) + 1
    return [
        i
        for i, onward in open_.items()
        if segments[i].vehicle
        and not segments[i].is_intersection
        and (len(onward) > 1 or any(segments[j].is_intersection or entries[j] > 1 for j in onward))
    ]


def _exit_lanes(segments: dict[int, LaneSegment]) -> list[int]:
    """Return the ids of the lanes outside of intersections that begin where an intersection ends."""
    onward = {j for s in segments.values() if s.vehicle and s.is_intersection for j in s.successors}
    return [i for i, s in segments.items() if i in onward and s.vehicle and not s.is_intersection]


_Site = tuple[LaneSegment, int]
_Places = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]


def _places(sites: list[_Site], away: float, setback: float, vector_map: VectorMap, config: PlacementConfig) -> _Places:
    """Return places of boards, the headings of their traffic, and which places are not on a lane.

    Args:
        sites: lanes, each with its end (-1) or its start (0) at the junction.
        away: from the junction along the lane, metres.
        setback: from the kerb, metres.
        vector_map, config: see `place_markers`.
    """
    ends = [_roadside(lane, end, away) for lane, end in sites]
    right = np.array([point for point, _ in ends]).reshape(-1, 3)
    heading = np.array([angle for _, angle in ends])
    sideways = np.stack([np.sin(heading), -np.cos(heading)], -1)
    to_kerb = _kerb_distance(right[:, :2], sideways, vector_map.road_boundaries)
    place = right + np.pad((to_kerb + setback)[:, None] * sideways, ((0, 0), (0, 1)))
    place[:, 2] += config.height
    return place, heading, _off_lanes(place[:, :2], vector_map)


def _most_visible(
    sites: list[_Site], start: _Places, vector_map: VectorMap, config: PlacementConfig, visible: Visible
) -> _Places:
    """Return the first clear place of each site, or the one that is seen best."""
    place, heading, clear = (array.copy() for array in start)
    best = np.array([visible(p, h) if c else -1.0 for p, h, c in zip(place, heading, clear, strict=True)])
    for away in _AWAY:
        for setback in (config.setback, config.setback + _FARTHER_BACK):
            waiting = np.flatnonzero(best < _ENOUGH)
            if not len(waiting) or (away == 0.0 and setback == config.setback):
                continue
            others = _places([sites[i] for i in waiting], away, setback, vector_map, config)
            for i, there, angle, free in zip(waiting.tolist(), *others, strict=True):
                long_enough = line_lengths(sites[i][0].right) > away + _CLEAR
                seen = visible(there, float(angle)) if free and long_enough else -1.0
                if seen > best[i]:
                    place[i], heading[i], clear[i], best[i] = there, angle, True, seen
    return place, heading, clear


def _roadside(lane: LaneSegment, end: int, away: float) -> tuple[Float[np.ndarray, "3"], float]:
    """Return a point of a lane's right boundary, `away` metres from its end (-1) or its start (0), and the heading."""
    if away > 0.0:
        line = lane.right if end == 0 else lane.right[::-1]
        along = arc_length(line)
        point, after = (np.array([np.interp(s, along, line[:, k]) for k in range(3)]) for s in (away, away + 1.0))
        step = after - point if end == 0 else point - after
        if np.hypot(step[0], step[1]) > 0.0:
            return point, float(np.arctan2(step[1], step[0]))
    first = -2 if end else 0
    step = lane.centerline[first + 1] - lane.centerline[first]
    return lane.right[end], float(np.arctan2(step[1], step[0]))


def _rightmost_lanes(sites: list[_Site]) -> list[_Site]:
    ends = [_roadside(lane, end, 0.0) for lane, end in sites]
    right = np.array([point for point, _ in ends]).reshape(-1, 3)
    return [sites[i] for i in _rightmost(right, np.array([angle for _, angle in ends])).tolist()]


def _rightmost(right: Float[np.ndarray, "n 3"], heading: Float[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Return the rightmost end of each set of lane ends that are side by side."""
    delta = right[None, :, :2] - right[:, None, :2]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    along = cos * delta[..., 0] + sin * delta[..., 1]
    to_right = sin * delta[..., 0] - cos * delta[..., 1]
    turned = np.abs(wrap_angle(heading[None] - heading[:, None]))
    beside = (np.abs(along) < _ALONG) & (np.abs(to_right) < _ACROSS) & (turned < _TURNED)
    # Of two coinciding ends (a duplicated lane) the first counts as the one to the right.
    index = np.arange(len(right))
    further = (to_right > 1e-6) | ((np.abs(to_right) <= 1e-6) & (index[None] < index[:, None]))
    return np.flatnonzero(~(beside & further).any(-1))


def _kerb_distance(
    start: Float[np.ndarray, "m 2"], direction: Float[np.ndarray, "m 2"], boundaries: tuple[np.ndarray, ...]
) -> Float[np.ndarray, " m"]:
    """Return the distance from each point, along its direction, to the next road boundary."""
    lines = [line for line in boundaries if len(line) > 1]
    a = np.concatenate([np.zeros((0, 2)), *(line[:-1, :2] for line in lines)])
    step = np.concatenate([np.zeros((0, 2)), *(line[1:, :2] for line in lines)]) - a
    # start + t direction = a + s step
    sine = cross(direction[:, None], step[None])
    parallel = sine == 0.0
    sine = np.where(parallel, 1.0, sine)
    away = a[None] - start[:, None]
    t, s = cross(away, step[None]) / sine, cross(away, direction[:, None]) / sine
    # From half a metre behind the start: the lane's boundary may lie on the kerb.
    meets = ~parallel & (s >= 0.0) & (s <= 1.0) & (t >= -0.5) & (t <= _FARTHEST_KERB)
    nearest = np.where(meets, t, np.inf).min(-1, initial=np.inf)
    return np.where(np.isfinite(nearest), nearest, _NO_KERB)


def _off_lanes(place: Float[np.ndarray, "m 2"], vector_map: VectorMap) -> Bool[np.ndarray, " m"]:
    """Return which places do not lie in the middle of a lane open to motor vehicles."""
    lines = [s.centerline for s in vector_map.segments.values() if s.vehicle and len(s.centerline) > 1]
    a = np.concatenate([np.zeros((0, 2)), *(line[:-1, :2] for line in lines)])
    step = np.concatenate([np.zeros((0, 2)), *(line[1:, :2] for line in lines)]) - a
    return segment_distances(place, a, step)[1].min(-1, initial=np.inf) > _CLEAR
