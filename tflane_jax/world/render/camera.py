"""Pinhole cameras above flat ground: projection, ground lookup, random mounting of one behind a windscreen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry.cameras import ground_points
from tflane_jax.geometry.poses import invert_pose
from tflane_jax.limits import PositiveOrZero, PositiveRange, Range, counted

# Image size to which focal lengths and rows refer: TuSimple's, pixels.
REFERENCE_WIDTH, REFERENCE_HEIGHT = 1280, 720
# Near plane: nothing at a smaller depth is drawn, metres.
NEAR = 0.6


@dataclass(frozen=True)
class FrontCameraConfig:
    """Ranges from which a scene's camera is drawn.

    The defaults put the vanishing points where TuSimple's labels have them: rows 205 to 285 and columns 520 to 770 of
    1280 x 720.

    Attributes:
        width, height: size of the image, pixels.
        focal: focal length at 1280 pixels of width; a guess, as are the 714 pixels that `datasets.photos` assumes for
            TuSimple's camera.
        above_ground: height above the ground, metres.
        pitch: how far the optical axis points below the horizon, degrees.
        yaw: largest deviation of the axis from the vehicle's heading, degrees.
        roll: largest rotation about the optical axis, degrees.
        centre: largest shift of the principal point at 1280 pixels of width, pixels.
    """

    width: Annotated[int, counted(16)] = 640
    height: Annotated[int, counted(16)] = 360
    focal: PositiveRange = (900.0, 1100.0)
    above_ground: PositiveRange = (1.45, 1.75)
    pitch: Range = (4.6, 7.6)
    yaw: PositiveOrZero = 3.0
    roll: PositiveOrZero = 1.0
    centre: PositiveOrZero = 12.0


@dataclass(frozen=True)
class PinholeCamera:
    """One camera at a known pose in the ego frame, whose origin lies on the ground.

    Attributes:
        width, height: of the image, pixels.
        intrinsics: (3, 3).
        camera_from_ego: (4, 4).
    """

    width: int
    height: int
    intrinsics: Float[np.ndarray, "3 3"]
    camera_from_ego: Float[np.ndarray, "4 4"]

    @cached_property
    def above_ground(self) -> float:
        """Height of the camera, metres."""
        return float(invert_pose(self.camera_from_ego)[2, 3])

    @cached_property
    def _projection(self) -> Float[np.ndarray, "4 3"]:
        return (self.intrinsics @ self.camera_from_ego[:3]).T

    def image_of(self, points: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Return pixels and depths of points in the ego frame; pixels at depths below `NEAR` are arbitrary."""
        # Faster than `geometry.project`: this is called for every polygon.
        image = points @ self._projection[:3] + self._projection[3]
        depth = image[:, 2]
        return image[:, :2] / np.maximum(depth, NEAR)[:, None], depth

    def ground_at(self, pixels: Float[np.ndarray, "k 2"]) -> tuple[Float[np.ndarray, "k 2"], Bool[np.ndarray, " k"]]:
        """Return the ground points seen at pixels (x, y in the ego frame) and which pixels see ground."""
        points, valid = ground_points(pixels, self.intrinsics, self.camera_from_ego)
        return points[:, :2], valid

    def horizon_rows(self, columns: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return the row of the horizon in each column."""
        up = self._rise
        return -(up[0] * columns + up[2]) / up[1]

    def ground_depth(
        self, columns: Float[np.ndarray, " w"], rows: Float[np.ndarray, " h"], most: float
    ) -> Float[np.ndarray, "h w"]:
        """Return the depth of the ground at pixels (metres, float32), at most `most`; above the horizon `most`."""
        up = -self._rise / self.above_ground
        inverse = (up[0] * columns + up[2]).astype(np.float32) + (up[1] * rows).astype(np.float32)[:, None]
        return 1.0 / np.maximum(inverse, np.float32(1.0 / most))

    @cached_property
    def _rise(self) -> Float[np.ndarray, "3"]:
        """Coefficients: the ray of pixel (u, v) rises by their product with (u, v, 1), metres per metre of depth."""
        return self.camera_from_ego[:3, 2] @ np.linalg.inv(self.intrinsics)


def lift(xy: Float[np.ndarray, "k 2"], z: float = 0.0) -> Float[np.ndarray, "k 3"]:
    """Return points at height z above points of the ground."""
    points = np.empty((len(xy), 3))
    points[:, :2], points[:, 2] = xy, z
    return points


def draw_camera(rng: np.random.Generator, config: FrontCameraConfig) -> PinholeCamera:
    """Draw a camera; the same stream and config give the same bits."""
    scale = np.array([config.width / REFERENCE_WIDTH, config.height / REFERENCE_HEIGHT])
    focal = rng.uniform(*config.focal) * scale
    center = 0.5 * np.array([config.width, config.height]) + rng.uniform(-1, 1, 2) * config.centre * scale
    intrinsics = np.array([[focal[0], 0.0, center[0]], [0.0, focal[1], center[1]], [0.0, 0.0, 1.0]])
    above = rng.uniform(*config.above_ground)
    pitch = np.deg2rad(rng.uniform(*config.pitch))
    # Triangular: most cameras are mounted nearly straight.
    yaw, roll = np.deg2rad(rng.triangular(-1.0, 0.0, 1.0, 2) * [config.yaw, config.roll])
    return PinholeCamera(config.width, config.height, intrinsics, camera_pose(above, pitch, yaw, roll))


def camera_pose(above_ground: float, pitch: float, yaw: float = 0.0, roll: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """Return camera_from_ego of a camera above the origin.

    Args:
        above_ground: metres.
        pitch: downwards, radians.
        yaw: to the left, radians.
        roll: clockwise as seen along the axis, radians.
    """
    cos, sin = np.cos([pitch, yaw, roll]), np.sin([pitch, yaw, roll])
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # camera axes of a level one
    turn = np.array([[cos[1], sin[1], 0.0], [-sin[1], cos[1], 0.0], [0.0, 0.0, 1.0]])
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, cos[0], -sin[0]], [0.0, sin[0], cos[0]]])
    lean = np.array([[cos[2], sin[2], 0.0], [-sin[2], cos[2], 0.0], [0.0, 0.0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3] = lean @ tilt @ axes @ turn
    pose[:3, 3] = pose[:3, :3] @ [0.0, 0.0, -above_ground]
    return pose
