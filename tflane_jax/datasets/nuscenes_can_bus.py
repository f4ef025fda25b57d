"""The 18 numbers of the CAN bus that BEVFormer's encoder takes (MapTR uses it with its attention encoder).

Source: BEVFormer's data converter and dataset (https://github.com/fundamentalvision/BEVFormer), as MapTR copied them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.files.fields import load_json, member, numbers, whole_number
from tflane_jax.geometry import matrix_from_quaternion, pose_yaw

CAN_BUS_SIZE = 18
WITHOUT_CAN_BUS = frozenset(f"scene-{n:04d}" for n in (*range(161, 169), *range(170, 177), *range(309, 315)))
"""Scenes of which the vehicle's messages were lost; they get zeros."""
_MOTION = ("accel", "rotation_rate", "vel")


def can_bus(
    folder: Path,
    scene: str,
    timestamp_ns: int,
    ego_translation: Float[np.ndarray, "3"],
    ego_rotation: Float[np.ndarray, "4"],
    *,
    rules: Literal["plain", "reference"] = "plain",
) -> Float[np.ndarray, "18"]:
    """Return the CAN-bus vector of a key frame.

    [0:3] position, metres; [3:7] orientation, quaternion w, x, y, z; [7:10] acceleration, m/s2; [10:13] rates of
    rotation, rad/s; [13:16] velocity, m/s; [16] yaw, radians from 0 to 2 pi; [17] yaw, degrees. Position and
    orientation are those of `ego_pose`, not the CAN bus's. Before the first message the first one counts.

    Args:
        folder: with <scene>_pose.json, nuScenes' can_bus.
        scene: name.
        timestamp_ns: of the key frame.
        ego_translation, ego_rotation: the row of `ego_pose`.
        rules: "plain" takes the motion from the last message up to the key frame. "reference" does as the published
            code: the motion of the message after it, and the real part of the quaternion four times.

    Raises:
        UserError: the scene's file is missing or malformed, and the scene is none of `WITHOUT_CAN_BUS`.
    """
    found = np.zeros(CAN_BUS_SIZE)
    path = Path(folder) / f"{scene}_pose.json"
    if path.is_file() or scene not in WITHOUT_CAN_BUS:
        found[7:16] = _motion(path, timestamp_ns, following=rules == "reference")
    rotation = np.asarray(ego_rotation, np.float64)
    yaw = float(pose_yaw(matrix_from_quaternion(rotation))) % (2.0 * np.pi)
    found[:3] = ego_translation
    found[3:7] = rotation[0] if rules == "reference" else rotation
    found[16:] = yaw, np.degrees(yaw)
    return found


def _motion(path: Path, timestamp_ns: int, *, following: bool) -> Float[np.ndarray, "9"]:
    """Return the motion in the last message up to a time, or in the one after it."""
    messages = load_json(path)
    if not isinstance(messages, list) or not messages:
        raise UserError(f"{path} holds no list of messages")
    times = np.array([_time(message, f"{path}[{number}]") for number, message in enumerate(messages)])
    if (np.diff(times) < 0).any():
        raise UserError(f"{path}: the messages are not in the order of utime")
    # Number of messages up to the time: the next one follows them.
    until = int(np.searchsorted(times, timestamp_ns // 1000, side="right"))
    number = min(until, len(messages) - 1) if following else max(until - 1, 0)
    where = f"{path}[{number}]"
    return np.concatenate([numbers(member(messages[number], key, where), (3,), f"{where}.{key}") for key in _MOTION])


def _time(message: Any, where: str) -> int:
    return whole_number(member(message, "utime", where), 0, 2**62, f"{where}.utime")
