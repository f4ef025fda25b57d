"""Center lines of the nuScenes map expansion: chains of arcs and straight pieces, integrated exactly.

A path has three pieces of curvature +1/radius (L), -1/radius (R) or 0 (S); a lane is a list of paths. Points lie at
equal steps of at most the resolution, by the rule of the devkit (`map_expansion/arcline_path_utils.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.plausible import FARTHEST_STEP
from tflane_jax.errors import UserError
from tflane_jax.files.fields import member, numbers
from tflane_jax.geometry import without_repeats

SHAPES = ("LRL", "RLR", "LSL", "LSR", "RSL", "RSR")
_TURN = {"L": 1.0, "S": 0.0, "R": -1.0}
# Metres; consecutive points that are nearer are one point: a path may start a little before or behind the end of the
# one that it continues, and such a step has any direction.
_SAME_POINT = 0.01


def lane_points(paths: Sequence[Any], resolution: float, where: str) -> Float[np.ndarray, "n 2"]:
    """Return the points of a lane's paths to a millimetre, without repeated ones where a path continues another.

    Args:
        paths: records of the map's `arcline_path_3`.
        resolution: greatest distance of two points, metres.
        where: place in the file, for messages.
    """
    parts = [path_poses(path, resolution, f"{where}[{number}]") for number, path in enumerate(paths)]
    points = np.concatenate([np.zeros((0, 3)), *parts])[:, :2].round(3)
    found = without_repeats(points, _SAME_POINT)
    if len(found) > 1:  # the end stays where it is, for the lanes that start there
        found[-1] = points[-1]
    return found


def path_poses(path: Any, resolution: float, where: str) -> Float[np.ndarray, "n 3"]:
    """Return x, y (metres) and yaw (radians, continuous) along one path of length L, both ends included.

    There are max(ceil(L / resolution) + 1, 2) points at equal steps: the devkit's int(max(ceil(L / resolution) + 1.5,
    2)).

    Raises:
        UserError: an entry is missing or malformed.
    """
    start = numbers(member(path, "start_pose", where), (3,), f"{where}.start_pose").astype(np.float64)
    lengths = numbers(member(path, "segment_length", where), (3,), f"{where}.segment_length").astype(np.float64)
    radius = float(numbers(member(path, "radius", where), (), f"{where}.radius"))
    shape = member(path, "shape", where)
    if shape not in SHAPES:
        raise UserError(f"{where}.shape is {shape!r:.40}, expected one of {', '.join(SHAPES)}")
    if radius <= 0.0 or (lengths < 0.0).any():
        raise UserError(f"{where}: radius {radius:g} and segment lengths {lengths.tolist()} must be positive")
    curvature = np.array([_TURN[letter] for letter in shape]) / radius
    total = float(lengths.sum())
    if total > FARTHEST_STEP:
        raise UserError(f"{where}: segment lengths {lengths.tolist()} add up to {total / 1e3:g} km: restore the file")
    along = np.linspace(0.0, total, int(max(math.ceil(total / resolution) + 1.5, 2)))
    # Poses at the start of each piece, then of the piece that holds each point.
    starts = [start]
    for bend, length in zip(curvature[:2], lengths[:2], strict=True):
        starts.append(_moved(starts[-1][None], np.array([bend]), np.array([length]))[0])
    ends = np.cumsum(lengths)
    piece = np.minimum(np.searchsorted(ends, along), 2)
    return _moved(np.stack(starts)[piece], curvature[piece], along - (ends - lengths)[piece])


def _moved(pose: np.ndarray, curvature: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return poses (n, 3) after a distance along a circle: its chord has the mean heading."""
    turn = curvature * distance
    chord = distance * np.sinc(turn / (2.0 * np.pi))  # numpy's sinc(x) is sin(pi x) / (pi x)
    heading = pose[:, 2] + turn / 2.0
    step = np.stack([chord * np.cos(heading), chord * np.sin(heading), turn], -1)
    return pose + step
