"""Poses, polylines, ranges and cameras as pure array functions, without parameters and without files.

Poses, ranges and cameras return arrays of the library of their arguments, so the same line runs in float64 on the host
and under jit. Polylines and `wrap_angle` are numpy only.
"""

from tflane_jax.geometry.cameras import (
    crop_intrinsics,
    ground_points,
    inside_image,
    project,
    resize_intrinsics,
)
from tflane_jax.geometry.polylines import (
    arc_length,
    clip_to_range,
    line_distances,
    line_lengths,
    nearest_lines,
    resample,
    resample_lines,
    sample_at,
    segment_distances,
    simplify,
    without_repeats,
)
from tflane_jax.geometry.poses import (
    invert_pose,
    matrix_from_quaternion,
    pose_matrix,
    pose_yaw,
    relative_pose,
    transform_points,
    wrap_angle,
    yaw_pose,
)
from tflane_jax.geometry.ranges import BevGrid, PerceptionRange

__all__ = [
    "BevGrid",
    "PerceptionRange",
    "arc_length",
    "clip_to_range",
    "crop_intrinsics",
    "ground_points",
    "inside_image",
    "invert_pose",
    "line_distances",
    "line_lengths",
    "matrix_from_quaternion",
    "nearest_lines",
    "pose_matrix",
    "pose_yaw",
    "project",
    "relative_pose",
    "resample",
    "resample_lines",
    "resize_intrinsics",
    "sample_at",
    "segment_distances",
    "simplify",
    "transform_points",
    "without_repeats",
    "wrap_angle",
    "yaw_pose",
]
