"""What a frame is like: quantities of its lanes, areas and road users, to lay datasets beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import AreaType, Example, LaneGraph

FRAME_QUANTITIES = (
    "lanes",
    "connectors",
    "metres of lane",
    "topology links",
    "crossings",
    "road boundaries",
)
"""One value for each frame; those of road users follow, see `commands.data_stats`."""
LANE_QUANTITIES = ("length, m", "turn, degrees", "curvature, 1/100 m", "visible share")
"""One value for each lane; the curvature is the largest along the lane."""


def frame_quantities(example: Example) -> dict[str, Float[np.ndarray, " 1"]]:
    """Return `FRAME_QUANTITIES` of one example."""
    lanes, areas = example.lanes, example.areas
    valid = np.asarray(lanes.valid)
    category, known = np.asarray(areas.category), np.asarray(areas.valid)
    found = {
        "lanes": valid.sum(),
        "connectors": (valid & np.asarray(lanes.is_connector)).sum(),
        "metres of lane": _lengths(lanes).sum(),
        "topology links": (np.asarray(lanes.successor) & valid[:, None] & valid).sum(),
        "crossings": (known & (category == AreaType.PEDESTRIAN_CROSSING)).sum(),
        "road boundaries": (known & (category == AreaType.ROAD_BOUNDARY)).sum(),
    }
    return {name: np.array([value], float) for name, value in found.items()}


def lane_quantities(example: Example) -> dict[str, Float[np.ndarray, " n"]]:
    """Return `LANE_QUANTITIES` of the lanes of one example."""
    lanes = example.lanes
    points = np.asarray(lanes.points, float)[np.asarray(lanes.valid)][..., :2]
    step = np.diff(points, axis=1)
    metres = np.linalg.norm(step, axis=-1)
    turn = np.diff(np.unwrap(np.arctan2(step[..., 1], step[..., 0])), axis=1)
    between = 0.5 * (metres[:, 1:] + metres[:, :-1])
    curvature = np.abs(turn) / np.maximum(between, 1e-6)
    return {
        "length, m": metres.sum(-1),
        "turn, degrees": np.degrees(np.abs(turn.sum(-1))),
        "curvature, 1/100 m": 100.0 * curvature.max(-1, initial=0.0),
        "visible share": np.asarray(lanes.visibility, float)[np.asarray(lanes.valid)],
    }


def pooled(frames: Sequence[Mapping[str, Float[np.ndarray, " _"]]]) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the values of all frames by quantity, in the order in which quantities first appear."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    return {name: np.concatenate([frame[name] for frame in frames if name in frame]) for name in names}


def _lengths(lanes: LaneGraph) -> Float[np.ndarray, " n"]:
    points = np.asarray(lanes.points, float)[np.asarray(lanes.valid)][..., :2]
    return np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(-1)
