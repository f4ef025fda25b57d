"""Poses of an Argoverse 2 log: city_SE3_egovehicle.feather, and the columns of a pose in its other files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.plausible import FARTHEST, check_motion
from tflane_jax.errors import UserError
from tflane_jax.files.feather_table import Kind, read_columns
from tflane_jax.geometry import matrix_from_quaternion, pose_matrix

POSES = "city_SE3_egovehicle.feather"
_QUATERNION = ("qw", "qx", "qy", "qz")
POSE_COLUMNS: Mapping[str, Kind] = {
    "timestamp_ns": "integer",
    **dict.fromkeys((*_QUATERNION, "tx_m", "ty_m", "tz_m"), "number"),
}
# Deviation of a quaternion's norm from 1.
_UNIT = 1e-2


def read_poses(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return timestamps (P,), ascending, and global_from_ego (P, 4, 4).

    Raises UserError for a damaged file, two poses of one time, or a vehicle that jumps.
    """
    path = folder / POSES
    table = read_columns(path, POSE_COLUMNS)
    order = np.argsort(table["timestamp_ns"], kind="stable")
    times, poses = table["timestamp_ns"][order], poses_of(path, table)[order]
    if (same := np.diff(times) == 0).any():
        raise UserError(f"{path} has two poses at {times[same.argmax()]}: download it again")
    check_motion(poses[:, :2, 3], times, [f"{path}: time {time}" for time in times.tolist()])
    return times, poses


def poses_of(path: Path, table: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses in the columns of a file; raise UserError for what is no unit quaternion, or not in metres."""
    quaternion = np.stack([table[c] for c in _QUATERNION], -1)
    if (odd := np.abs(np.linalg.norm(quaternion, axis=-1) - 1.0) > _UNIT).any():
        row = int(odd.argmax())
        raise UserError(
            f"{path}: qw, qx, qy, qz of row {row} are {quaternion[row].tolist()}, no unit quaternion: download it again"
        )
    place = np.stack([table[c] for c in ("tx_m", "ty_m", "tz_m")], -1)
    if (far := np.abs(place).max(-1, initial=0.0) > FARTHEST).any():
        row = int(far.argmax())
        raise UserError(
            f"{path}: tx_m, ty_m, tz_m of row {row} are {place[row].tolist()}, no metres: download it again"
        )
    return pose_matrix(matrix_from_quaternion(quaternion), place)


def poses_at(times: np.ndarray, pose_times: np.ndarray, poses: np.ndarray, folder: Path) -> np.ndarray:
    """Return the poses whose timestamps are exactly `times`."""
    if not len(pose_times):
        raise UserError(f"{folder / POSES} holds no pose: download it again")
    row = np.minimum(np.searchsorted(pose_times, times), len(pose_times) - 1)
    missing = times[pose_times[row] != times]
    if len(missing):
        raise UserError(
            f"{folder / POSES} has no pose at {len(missing)} of {len(times)} frames (first {missing[0]}): "
            "annotations and poses are not of the same log; download both again"
        )
    return poses[row]
