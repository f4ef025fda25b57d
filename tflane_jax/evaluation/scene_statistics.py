"""Quantities of a frame's lanes, areas and road users, by which datasets are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from tflane_jax.geometry import line_lengths, resample_lines, segment_distances
from tflane_jax.scene import Areas, AreaType, Example, LaneGraph, LineType

FRAME_QUANTITIES = (
    "lanes",
    "connectors",
    "metres of lane",
    "topology links",
    "crossings",
    "road boundaries",
    "lanes beside the vehicle",
    "oncoming lanes beside the vehicle",
    "vehicle on a connector",
    "oblique fraction of lane length",
)
"""One value for each frame; those of road users follow, see `evaluation.example_statistics`.

Lanes beside the vehicle go its way, up to 45 degrees aside, where they pass it; its own counts too. Oncoming ones go
against it and are counted apart. The vehicle is on a connector (1, else 0) if that is the nearest lane. Oblique are
pieces of lanes at 15 to 75 degrees from the vehicle's axis.
"""
LANE_QUANTITIES = (
    "length, m",
    "width, m",
    "painted sides",
    "unpainted sides at the road's edge",
    "turn, degrees",
    "curvature, 1/100 m",
    "visible fraction",
)
"""One value for each lane; the curvature is the largest along the lane, of lanes of a metre and more.

Widths, and which fraction of the two sides has a marking: of lanes that are no connectors, if their boundaries are
known. Unpainted sides of these, in frames with road boundaries: 1 where half of the points or more are within 1 m of
one, else 0.
"""

_ALONG, _OBLIQUE = np.cos(np.radians(45.0)), np.cos(np.radians((15.0, 75.0)))
# Metres: a side nearer than this to a road boundary lies at it; the curvature of a shorter lane is rounding alone.
_AT_EDGE, _SHORTEST = 1.0, 1.0
# Half a metre apart on a road boundary along the whole of the largest box.
_EDGE_SAMPLES = 401


def frame_quantities(example: Example) -> dict[str, Float[np.ndarray, " 1"]]:
    """Return `FRAME_QUANTITIES` of one example."""
    lanes, areas = example.lanes, example.areas
    valid = np.asarray(lanes.valid)
    category, known = np.asarray(areas.category), np.asarray(areas.valid)
    found = {
        "lanes": valid.sum(),
        "connectors": (valid & np.asarray(lanes.is_connector)).sum(),
        "metres of lane": line_lengths(np.asarray(lanes.points, float)[valid]).sum(),
        "topology links": (np.asarray(lanes.successor) & valid[:, None] & valid).sum(),
        "crossings": (known & (category == AreaType.PEDESTRIAN_CROSSING)).sum(),
        "road boundaries": (known & (category == AreaType.ROAD_BOUNDARY)).sum(),
        **_around_the_vehicle(lanes),
    }
    return {name: np.array([value], float) for name, value in found.items()}


def lane_quantities(example: Example) -> dict[str, Float[np.ndarray, " n"]]:
    """Return `LANE_QUANTITIES` of the lanes of one example."""
    lanes, valid = example.lanes, np.asarray(example.lanes.valid)
    points = np.asarray(lanes.points, float)[valid][..., :2]
    between = valid & ~np.asarray(lanes.is_connector)
    sides = np.stack([np.asarray(side, float)[between] for side in (lanes.left, lanes.right)])
    width = np.linalg.norm(sides[0] - sides[1], axis=-1).mean(-1)
    types = np.stack([np.asarray(side)[between] for side in (lanes.left_type, lanes.right_type)])
    step = np.diff(points, axis=1)
    metres = np.linalg.norm(step, axis=-1)
    turn = np.diff(np.unwrap(np.arctan2(step[..., 1], step[..., 0])), axis=1)
    step_length = 0.5 * (metres[:, 1:] + metres[:, :-1])
    curvature = np.abs(turn) / np.maximum(step_length, 1e-6)
    length, bare = metres.sum(-1), (types == LineType.NONE) & (width > 0.0)
    return {
        "length, m": length,
        "width, m": width[width > 0.0],
        "painted sides": (types != LineType.NONE).mean(0)[width > 0.0],
        "unpainted sides at the road's edge": _at_edge(sides[bare], example.areas),
        "turn, degrees": np.degrees(np.abs(turn.sum(-1))),
        "curvature, 1/100 m": 100.0 * curvature.max(-1, initial=0.0)[length >= _SHORTEST],
        "visible fraction": np.asarray(lanes.visibility, float)[valid],
    }


def _at_edge(sides: Float[np.ndarray, "n p d"], areas: Areas) -> Float[np.ndarray, " m"]:
    """Return for each side whether it lies at a road boundary (1, else 0); nothing in a frame without boundaries."""
    known = np.asarray(areas.valid) & (np.asarray(areas.category) == AreaType.ROAD_BOUNDARY)
    if not known.any():
        return np.zeros(0)
    edges = resample_lines(list(np.asarray(areas.points, float)[known]), _EDGE_SAMPLES)[..., :2]
    distance = np.asarray(KDTree(edges.reshape(-1, 2)).query(sides[..., :2])[0])
    return (np.median(distance, axis=-1) < _AT_EDGE).astype(float)


def _around_the_vehicle(lanes: LaneGraph) -> dict[str, float]:
    """Return what lies beside and under the vehicle at the origin, and how the lanes lie to its axis x."""
    points = np.asarray(lanes.points, float)[np.asarray(lanes.valid)][..., :2]
    start, step = points[:, :-1], np.diff(points, axis=1)
    metres = np.linalg.norm(step, axis=-1)
    ahead = step[..., 0] / np.maximum(metres, 1e-6)
    # A half-open piece counts a lane once where it passes the vehicle.
    passes = (start[..., 0] <= 0.0) != (points[:, 1:, 0] <= 0.0)
    # The nearest point of every piece: none where there are no lanes.
    distance = segment_distances(np.zeros(2), start, step)[1].min(-1, initial=np.inf)
    on_connector = len(distance) > 0 and bool(np.asarray(lanes.is_connector)[lanes.valid][distance.argmin()])
    oblique = (np.abs(ahead) > _OBLIQUE[1]) & (np.abs(ahead) < _OBLIQUE[0])
    return {
        "lanes beside the vehicle": (passes & (ahead > _ALONG)).any(-1).sum(),
        "oncoming lanes beside the vehicle": (passes & (ahead < -_ALONG)).any(-1).sum(),
        "vehicle on a connector": float(on_connector),
        "oblique fraction of lane length": (metres * oblique).sum() / max(metres.sum(), 1e-6),
    }


def pooled(frames: Sequence[Mapping[str, Float[np.ndarray, " _"]]]) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the values of all frames by quantity, in the order in which quantities first appear."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    return {name: np.concatenate([frame[name] for frame in frames if name in frame]) for name in names}
