"""Road center lines of a recorded map, the input of the SD map: one for each bundle of lanes side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.roads.curves import arc_length, cross, direction, points_at
from tflane_jax.world.roads.map_junctions import MapJunction

# Lanes of one road are side by side within these limits, metres, and parallel within acos of the last.
_BESIDE, _PARALLEL = 6.5, 0.9
# Fraction of the shorter lane beside the other one.
_SHARED = 0.5
_SPACING = 4.0
# Samples before and after each one over which the middle of a road is averaged.
_SMOOTH = 5
# A road ends in the middle of an intersection whose border is nearer than this, metres.
_MEETS = 12.0


def road_lines_of(
    lanes: Mapping[int, LaneSegment], junctions: Sequence[MapJunction]
) -> tuple[Float[np.ndarray, "_ 2"], ...]:
    """Return one line for each road between intersections, midway between its outermost lanes, metres.

    Lanes side by side, in either direction, are one road. Its line continues to the middle of the intersections at
    which it ends.

    Args:
        lanes: from `traffic_lanes`.
        junctions: of the map.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    driven = [lane.centerline[:, :2] for lane in lanes.values() if lane.vehicle and not lane.is_intersection]
    lines = [_sampled(line) for line in driven if arc_length(line)[-1] > _SPACING]
    if not lines:
        return ()
    pairs = [(i, j) for i in range(len(lines)) for j in range(i) if _side_by_side(lines[i], lines[j])]
    a, b = np.array(pairs, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(lines),) * 2)
    count, label = connected_components(graph, directed=False)
    roads = [_middle([lines[i] for i in np.flatnonzero(label == group)]) for group in range(count)]
    centers = [(np.concatenate([lanes[i].centerline[:, :2] for i in j.connectors]), j.center) for j in junctions]
    return tuple(_extended(road, centers) for road in roads)


def _sampled(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    length = arc_length(line)[-1]
    return points_at(line, np.linspace(0.0, length, max(int(length / _SPACING), 1) + 1))


def _side_by_side(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "m 2"]) -> bool:
    if len(a) > len(b):
        a, b = b, a
    if (a.min(0) > b.max(0) + _BESIDE).any() or (b.min(0) > a.max(0) + _BESIDE).any():
        return False
    apart = a[:, None] - b
    nearest = np.linalg.norm(apart, axis=-1).argmin(1)
    u, v = _ahead(a), _ahead(b)[nearest]
    offset = a - b[nearest]
    across, along = np.abs(cross(v, offset)), np.abs((v * offset).sum(-1))
    beside = (across < _BESIDE) & (along < _SPACING) & (np.abs((u * v).sum(-1)) > _PARALLEL)
    return float(beside.mean()) > _SHARED


def _ahead(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    step = np.gradient(line, axis=0)
    return step / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-9)


def _middle(lines: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "n 2"]:
    """Return the line midway between the outermost of parallel lines, along the longest one."""
    axis = max(lines, key=len)
    ahead = _ahead(axis)
    low = high = np.zeros(len(axis))
    for line in lines:
        offset = line[None] - axis[:, None]
        along = np.abs((offset * ahead[:, None]).sum(-1))
        nearest = along.argmin(1)
        rows = np.arange(len(axis))
        across = cross(ahead, offset[rows, nearest])
        beside = (along[rows, nearest] < _SPACING) & (np.abs(across) < 4.0 * _BESIDE)
        low, high = np.where(beside, np.minimum(low, across), low), np.where(beside, np.maximum(high, across), high)
    # Where a lane begins or ends, the middle moves over within a few samples, as a mapped road does.
    middle = np.pad(0.5 * (low + high), _SMOOTH, mode="edge")
    middle = np.convolve(middle, np.full(2 * _SMOOTH + 1, 1.0 / (2 * _SMOOTH + 1)), mode="valid")
    left = np.stack([-ahead[:, 1], ahead[:, 0]], -1)
    return axis + middle[:, None] * left


def _extended(
    road: Float[np.ndarray, "n 2"], centers: Sequence[tuple[np.ndarray, Float[np.ndarray, "2"]]]
) -> Float[np.ndarray, "m 2"]:
    """Return a road continued to the middle of the intersections that lie ahead of its ends."""
    before, after = [], []
    for points, center in centers:
        for end, inner, added in ((road[0], road[1], before), (road[-1], road[-2], after)):
            outward = direction(float(np.arctan2(*(end - inner)[::-1])))
            near = float(np.linalg.norm(points - end, axis=-1).min())
            if near < _MEETS and not added and float((center - end) @ outward) > 0.0:
                added.append(center)
    return np.stack([*before, *road, *after])
