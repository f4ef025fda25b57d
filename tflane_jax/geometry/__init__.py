"""Ground floor: poses, polylines, ranges and cameras as pure array functions (no learning, no I/O).

Functions take numpy or jax arrays and answer in kind, so that the same line runs in float64 on the host and under jit.
"""

from tflane_jax.geometry.poses import (
    invert_pose,
    matrix_from_quaternion,
    pose_matrix,
    pose_yaw,
    relative_pose,
    transform_points,
    yaw_pose,
)
from tflane_jax.geometry.ranges import BevGrid, PerceptionRange

__all__ = [
    "BevGrid",
    "PerceptionRange",
    "invert_pose",
    "matrix_from_quaternion",
    "pose_matrix",
    "pose_yaw",
    "relative_pose",
    "transform_points",
    "yaw_pose",
]
