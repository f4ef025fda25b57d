"""Rigid motions in 2-D and 3-D as homogeneous matrices.

`a_from_b` maps coordinates in frame b to frame a. City coordinates reach thousands of metres, where float32 resolves
only millimetres: compose poses in float64 numpy and hand the relative pose to the device.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry.namespace import AnyArray, ArrayT, namespace, product


def wrap_angle(angle: Float[np.ndarray, "*b"] | float) -> Float[np.ndarray, "*b"]:
    """Return the angle in [-pi, pi), or pi by rounding."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def pose_matrix(rotation: Float[AnyArray, "*b d d"], translation: Float[AnyArray, "*b d"]) -> Float[Any, "*b d+1 d+1"]:
    """Return the homogeneous matrix of `p -> rotation @ p + translation` (SE(2) for d = 2, SE(3) for d = 3)."""
    xp = namespace(rotation, translation)
    top = xp.concatenate([rotation, translation[..., None]], -1)
    row = xp.zeros_like(top[..., :1, :])
    bottom = xp.concatenate([row[..., :-1], xp.ones_like(row[..., -1:])], -1)
    return xp.concatenate([top, bottom], -2)


def invert_pose(pose: Float[AnyArray, "*b n n"]) -> Float[Any, "*b n n"]:
    """Return the inverse motion, using that the rotation is orthonormal."""
    xp = namespace(pose)
    rotation = xp.swapaxes(pose[..., :-1, :-1], -1, -2)
    translation = -product(rotation, pose[..., :-1, -1:])[..., 0]
    return pose_matrix(rotation, translation)


def relative_pose(
    global_from_target: Float[AnyArray, "*b n n"], global_from_source: Float[AnyArray, "*b n n"]
) -> Float[Any, "*b n n"]:
    """Return target_from_source: TF-Lane Eq. (1), T_{i-k}^i = Pose_i^-1 . Pose_{i-k}.

    Call it in float64: the two poses are far from the origin and their difference is small.
    """
    return product(invert_pose(global_from_target), global_from_source)


def transform_points(pose: Float[AnyArray, "*b n n"], points: Float[AnyArray, "*b k d"]) -> Float[Any, "*b k d"]:
    """Apply `pose` (n = d + 1) to points; leading axes broadcast."""
    xp = namespace(pose, points)
    rotated = product(points, xp.swapaxes(pose[..., :-1, :-1], -1, -2))
    shift = pose[..., None, :-1, -1]
    return rotated + shift.reshape((1,) * (rotated.ndim - shift.ndim) + shift.shape)


def matrix_from_quaternion(quaternion: Float[ArrayT, "*b 4"]) -> Float[ArrayT, "*b 3 3"]:
    """Return the rotation matrix of a quaternion (w, x, y, z) of any norm whose square is a normal number."""
    xp = namespace(quaternion)
    q = quaternion / xp.sqrt((quaternion**2).sum(-1, keepdims=True))
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def yaw_pose(x: Float[AnyArray, "*b"], y: Float[AnyArray, "*b"], yaw: Float[AnyArray, "*b"]) -> Float[Any, "*b 4 4"]:
    """Return the SE(3) pose on the ground plane at (x, y) with heading `yaw` (metres, radians)."""
    xp = namespace(x, y, yaw)
    x, y, yaw = xp.broadcast_arrays(xp.asarray(x), xp.asarray(y), xp.asarray(yaw))
    c, s, zero, one = xp.cos(yaw), xp.sin(yaw), xp.zeros_like(yaw), xp.ones_like(yaw)
    rotation = xp.stack([xp.stack(r, -1) for r in ([c, -s, zero], [s, c, zero], [zero, zero, one])], -2)
    return pose_matrix(rotation, xp.stack([x + zero, y + zero, zero], -1))


def pose_yaw(pose: Float[ArrayT, "*b n n"]) -> Float[ArrayT, "*b"]:
    """Return the heading of a pose: the direction of its x axis in the ground plane, radians in [-pi, pi]."""
    return namespace(pose).arctan2(pose[..., 1, 0], pose[..., 0, 0])
