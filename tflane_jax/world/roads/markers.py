"""Placement of fiducial markers: beside the road, before junctions, splits and merges (marker paper, section IV-A).

The positions depend on the map alone. Ids and small deviations of the boards are drawn from a separate stream, so
markers change nothing else in a scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import pose_matrix
from tflane_jax.scene.logs import LaneSegment, PlacedMarkers, VectorMap

ROOT = 20_251_122
# Two lane ends are side by side within these limits: along and across the road (metres) and in heading.
_ALONG, _ACROSS, _TURNED = 10.0, 25.0, np.deg2rad(30.0)
# A kerb farther from the lane than this belongs to another area such as a parking lot, metres.
_FARTHEST_KERB = 8.0
# Without a kerb: from the lane's right boundary to the edge of the road, metres.
_NO_KERB = 0.5
# A board nearer than this to a centerline would be on the road, metres.
_CLEAR = 2.0


@dataclass(frozen=True)
class PlacementConfig:
    """How markers are placed.

    Attributes:
        per: "approach": a marker at every approach of a junction, split or merge; "scene": one of these per map, as in
            the paper.
        side: "near": before the junction only; "both": also beyond it, to the right of the lanes that leave it, facing
            traffic that crosses the junction, which sees it from farther away and for longer.
        size: side of the black square, metres (paper: 1).
        height: of the marker's middle above the road, metres.
        setback: from the kerb to the marker's middle, metres.
        toe_in: yaw of the board from facing the traffic towards the road, degrees.
        jitter: largest deviation of a board's yaw (uniform), degrees.
        dictionary: number of ids, from 0; a map never has more markers than ids.
    """

    per: Literal["approach", "scene"] = "approach"
    side: Literal["near", "both"] = "near"
    size: float = 1.0
    height: float = 3.0
    setback: float = 0.8
    toe_in: float = 5.0
    jitter: float = 3.0
    dictionary: int = 100


def place_markers(vector_map: VectorMap, seed: int, config: PlacementConfig = PlacementConfig()) -> PlacedMarkers:
    """Return the markers of a map, in no particular order: to the right of each approach, facing its traffic.

    An approach is all lanes that end side by side where an intersection, a split or a merge begins. The marker stands
    behind the kerb to the right of the lanes' end, and also beyond the junction with `side` "both". A position in the
    middle of another lane is skipped.

    The same map and seed give the same bits. A map without approaches has no markers.
    """
    lanes = vector_map.segments
    sides = [_roadside([lanes[i] for i in _approach_lanes(lanes)], end=-1)]
    if config.side == "both":
        sides.append(_roadside([lanes[i] for i in _exit_lanes(lanes)], end=0))
    right, heading = (np.concatenate(values) for values in zip(*sides, strict=True))
    sideways = np.stack([np.sin(heading), -np.cos(heading)], -1)
    to_kerb = _kerb_distance(right[:, :2], sideways, vector_map.road_boundaries)
    place = right + np.pad((to_kerb + config.setback)[:, None] * sideways, ((0, 0), (0, 1)))
    place[:, 2] += config.height
    clear = _off_lanes(place[:, :2], vector_map)
    place, heading = place[clear], heading[clear]

    rng = np.random.default_rng([ROOT, seed])
    number = rng.permutation(config.dictionary).astype(np.int32)
    kept = rng.permutation(len(place))[: 1 if config.per == "scene" else config.dictionary]
    facing = heading + np.pi - np.deg2rad(config.toe_in + rng.uniform(-config.jitter, config.jitter, len(place)))
    return PlacedMarkers(number[: len(kept)], marker_pose(place, facing)[kept], config.size)


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


def _roadside(segments: list[LaneSegment], *, end: int) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return the end (-1) or the start (0) of the right boundary of the rightmost lanes, and their headings there."""
    right = np.array([s.right[end] for s in segments]).reshape(-1, 3)
    first = -2 if end else 0
    step = np.array([s.centerline[first + 1] - s.centerline[first] for s in segments]).reshape(-1, 3)
    heading = np.arctan2(step[:, 1], step[:, 0])
    chosen = _rightmost(right, heading)
    return right[chosen], heading[chosen]


def _rightmost(right: Float[np.ndarray, "n 3"], heading: Float[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Return the rightmost end of each set of lane ends that are side by side."""
    delta = right[None, :, :2] - right[:, None, :2]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    along = cos * delta[..., 0] + sin * delta[..., 1]
    to_right = sin * delta[..., 0] - cos * delta[..., 1]
    turned = np.abs((heading[None] - heading[:, None] + np.pi) % (2 * np.pi) - np.pi)
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
    sine = _cross(direction[:, None], step[None])
    parallel = sine == 0.0
    sine = np.where(parallel, 1.0, sine)
    away = a[None] - start[:, None]
    t, s = _cross(away, step[None]) / sine, _cross(away, direction[:, None]) / sine
    # From half a metre behind the start: the lane's boundary may lie on the kerb.
    meets = ~parallel & (s >= 0.0) & (s <= 1.0) & (t >= -0.5) & (t <= _FARTHEST_KERB)
    nearest = np.where(meets, t, np.inf).min(-1, initial=np.inf)
    return np.where(np.isfinite(nearest), nearest, _NO_KERB)


def _off_lanes(place: Float[np.ndarray, "m 2"], vector_map: VectorMap) -> Bool[np.ndarray, " m"]:
    """Return which places do not lie in the middle of a lane open to motor vehicles."""
    lines = [s.centerline for s in vector_map.segments.values() if s.vehicle and len(s.centerline) > 1]
    a = np.concatenate([np.zeros((0, 2)), *(line[:-1, :2] for line in lines)])
    step = np.concatenate([np.zeros((0, 2)), *(line[1:, :2] for line in lines)]) - a
    square = (step**2).sum(-1)
    t = np.clip(((place[:, None] - a) * step).sum(-1) / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
    distance = np.linalg.norm(a + t[..., None] * step - place[:, None], axis=-1)
    return distance.min(-1, initial=np.inf) > _CLEAR


def _cross(a: Float[np.ndarray, "*b 2"], b: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
