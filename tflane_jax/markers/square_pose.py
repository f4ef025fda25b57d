"""Pose of a square from its four corners, and the two poses that a distant square has."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from tflane_jax.files.images import opencv
from tflane_jax.geometry import pose_matrix, transform_points
from tflane_jax.geometry.cameras import project
from tflane_jax.markers.image_search import DetectorConfig

# Corners of a marker of size 2 in its own frame, in OpenCV's order: upper left, upper right, lower right, lower left.
_SQUARE = np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)])
# Rotations by quarters of a turn about z, which take each corner to the place of the one before it.
_QUARTERS = np.stack([np.linalg.matrix_power([[0, -1, 0], [1, 0, 0], [0, 0, 1]], k) for k in range(4)]).astype(float)
# Added to both errors of a pose ratio, so that the ratio of two perfect fits is 1, pixels.
_EXACT = 1e-3
# Moves the corners by less than a ten-thousandth of a pixel.
_NUDGE = 3e-8 * np.array([(1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (-1.0, 1.0)])


class SquarePose(NamedTuple):
    """The two candidate poses of a square.

    Attributes:
        camera_from_marker: (2, 4, 4) the preferred one first.
        error: (2,) root mean square distance between detected and projected corners, pixels.
    """

    camera_from_marker: Float[np.ndarray, "2 4 4"]
    error: Float[np.ndarray, "2"]

    @property
    def ambiguity(self) -> float:
        """Ratio of the smaller to the greater error: 0 (only one pose fits) to 1 (both fit equally well)."""
        return float((self.error.min() + _EXACT) / (self.error.max() + _EXACT))


def solve_square(
    corners: Float[np.ndarray, "4 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    camera_from_ego: Float[np.ndarray, "4 4"],
    config: DetectorConfig = DetectorConfig(),
) -> SquarePose:
    """Return both poses of a marker from its corners (in the order of `ImageMarkers`), the preferred one first.

    From afar a square looks nearly the same when its normal is mirrored about the line of sight, so four corners have
    two candidate poses (infinitesimal plane-based pose estimation, Collins and Bartoli 2014; OpenCV's IPPE_SQUARE).
    The pose with the smaller error is preferred, unless the ratio of both errors is above `config.ambiguous`.
    Then the prior prefers the one with the smaller (lean / tilt)^2 + (turned / turn)^2 + (error / least error)^2, with
    lean the angle between the marker's y axis and the ego frame's z axis (boards are upright), and
    turned the angle between its z axis and the direction to the camera (boards face the traffic).

    Corners that no square has, as four on a line, have no pose: both are the identity then, with infinite errors.
    """
    cv2 = opencv()
    square = 0.5 * config.size * _SQUARE
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(np.asarray(intrinsics, np.float64)).T
    # A marker that faces the camera is rotated by about 180 degrees, where OpenCV's rotation vectors are unstable
    # (always for an upright marker and a level camera). So the problem is solved with y of the image and z of the
    # marker mirrored, where the rotation is small; z does not matter for a flat square. A marker on its side or head
    # is solved as the upright one that looks the same, and turned back.
    seen = rays[:, :2] / rays[:, 2:] * [1.0, -1.0]
    height_of_side = [seen[[k, (k + 1) % 4]].mean(0)[1] for k in range(4)]
    quarters = int(np.argmax(height_of_side))
    seen = np.roll(seen, -quarters, axis=0)
    count, turns, places = _two_poses(cv2, square, seen)
    if not np.isfinite(turns).all():
        # Exactly from the front OpenCV takes the root of a number that rounding makes negative.
        count, turns, places = _two_poses(cv2, square, seen + _NUDGE)
    if count == 0:
        return SquarePose(np.tile(np.eye(4), (2, 1, 1)), np.full(2, np.inf))
    mirror, back = np.array([1.0, -1.0, 1.0]), np.array([1.0, 1.0, -1.0])
    rotation = mirror[:, None] * np.stack([cv2.Rodrigues(turn)[0] for turn in turns]) * back
    poses = pose_matrix(rotation @ _QUARTERS[quarters], mirror * places)
    if count == 1:
        poses = np.concatenate([poses, poses])
    pixels, _, _ = project(square[None], np.asarray(intrinsics, np.float64), poses)
    error = np.sqrt(((pixels - corners) ** 2).sum(-1).mean(-1))
    order = np.argsort(error, kind="stable")
    fit = SquarePose(poses[order], error[order])
    return fit if fit.ambiguity <= config.ambiguous else _by_prior(fit, camera_from_ego, config)


def _by_prior(fit: SquarePose, camera_from_ego: Float[np.ndarray, "4 4"], config: DetectorConfig) -> SquarePose:
    """Return both poses, that of the smaller cost by the prior first (see `solve_square`)."""
    up = np.asarray(camera_from_ego, np.float64)[:3, 2]
    toward = -fit.camera_from_marker[:, :3, 3]
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    lean = np.arccos(np.clip(fit.camera_from_marker[:, :3, 1] @ up, -1.0, 1.0))
    turned = np.arccos(np.clip((fit.camera_from_marker[:, :3, 2] * toward).sum(-1), -1.0, 1.0))
    worse = (fit.error + _EXACT) / (fit.error.min() + _EXACT)
    cost = (lean / config.tilt) ** 2 + (turned / config.turn) ** 2 + worse**2
    order = np.argsort(cost, kind="stable")
    return SquarePose(fit.camera_from_marker[order], fit.error[order])


def _two_poses(
    cv2: Any, square: Float[np.ndarray, "4 3"], seen: Float[np.ndarray, "4 2"]
) -> tuple[int, Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the number of poses, their rotation vectors and their translations."""
    count, turns, places, _ = cv2.solvePnPGeneric(
        square, np.ascontiguousarray(seen), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return count, np.reshape(turns, (-1, 3)), np.reshape(places, (-1, 3))


def marker_outline(
    pose: Float[np.ndarray, "4 4"],
    size: float,
    intrinsics: Float[np.ndarray, "3 3"],
    camera_from_ego: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "4 2"]:
    """Return the pixels of a marker's corners, in the order of `ImageMarkers`; corners behind the camera are zeros.

    Args:
        pose: ego_from_marker.
        size: side of the black square, metres.
        intrinsics, camera_from_ego: of the camera.
    """
    return project(transform_points(pose, 0.5 * size * _SQUARE), intrinsics, camera_from_ego)[0]
