"""Rings of calibrated cameras on the vehicle, as in Argoverse 2 and nuScenes.

The mounts are rounded, typical values of the two vehicles. The calibration of each scene deviates slightly from them.
"""

from __future__ import annotations

import functools
import zlib
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from tflane_jax.limits import NOT_EMPTY, Count, Fraction, Positive, PositiveOrZero, Rules, check_settings
from tflane_jax.world.render.camera import PinholeCamera, camera_pose
from tflane_jax.world.render.weather import FrontWeatherConfig

ROOT = 20_251_121
# Standard deviations at `jitter` 1: focal length and principal point (fractions of the focal length), position
# (metres), angles (degrees).
_FOCAL, _CENTER, _PLACE, _ANGLE = 0.003, 0.004, 0.01, 0.35
# Images below this fraction of the native size are drawn twice as large and averaged.
_SMALL = 0.35
# Pixels: a frame of seven such images takes some gigabytes to draw.
_LARGEST = 8192


@dataclass(frozen=True)
class CameraMount:
    """One camera of a ring.

    Attributes:
        name: as the dataset calls it.
        x, y, z: position in the ego frame, metres.
        yaw: of the optical axis, to the left of ahead, degrees.
        pitch: of the optical axis, downwards, degrees.
        focal: pixels of the native image.
        width, height: of the native image, pixels.
    """

    name: str
    x: float
    y: float
    z: Positive
    yaw: float
    pitch: float
    focal: Positive
    width: Count
    height: Count


ARGOVERSE2_RING = (
    CameraMount("ring_front_center", 1.64, 0.0, 1.40, 0.0, 0.0, 1776.0, 1550, 2048),
    CameraMount("ring_front_left", 1.55, 0.20, 1.40, 45.0, 2.8, 1688.0, 2048, 1550),
    CameraMount("ring_front_right", 1.55, -0.20, 1.40, -45.0, 2.8, 1688.0, 2048, 1550),
    CameraMount("ring_rear_left", 1.10, 0.13, 1.42, 153.0, 0.0, 1686.0, 2048, 1550),
    CameraMount("ring_rear_right", 1.10, -0.13, 1.42, -153.0, 0.0, 1686.0, 2048, 1550),
    CameraMount("ring_side_left", 1.31, 0.28, 1.40, 99.0, 2.8, 1687.0, 2048, 1550),
    CameraMount("ring_side_right", 1.31, -0.28, 1.40, -99.0, 2.8, 1687.0, 2048, 1550),
)
NUSCENES_RING = (
    CameraMount("CAM_FRONT", 1.70, 0.0, 1.51, 0.0, 0.3, 1266.0, 1600, 900),
    CameraMount("CAM_FRONT_RIGHT", 1.55, -0.49, 1.50, -56.0, 0.5, 1261.0, 1600, 900),
    CameraMount("CAM_FRONT_LEFT", 1.52, 0.49, 1.51, 55.5, 0.2, 1267.0, 1600, 900),
    CameraMount("CAM_BACK", 0.03, 0.0, 1.58, 180.0, -0.5, 809.0, 1600, 900),
    CameraMount("CAM_BACK_LEFT", 1.04, 0.48, 1.58, 109.0, 0.9, 1257.0, 1600, 900),
    CameraMount("CAM_BACK_RIGHT", 1.02, -0.48, 1.56, -110.5, 0.9, 1260.0, 1600, 900),
)


@dataclass(frozen=True)
class CameraRigConfig:
    """A ring of cameras and how its images are drawn.

    Attributes:
        cameras: the first one faces forward; traffic elements are labelled in its image.
        scale: scale of the images; 1 is native.
        multiple: widths and heights are rounded up to multiples of this, which extends the view to the right and
            downwards.
        jitter: scales the deviation of a scene's calibration from the mounts (1: 0.35 degrees, 1 cm).
        severity: scales the log's own weather and paint wear; 0 gives a clear day, fresh paint and a perfect camera.
        weather: kinds of weather, and the camera's noise, blur and tone.
        element_pixels: smallest height of a light or sign in the native image that is part of the truth.
        markers: draw the scene's fiducial markers, whose boards may hide objects behind them.
        depth_cell: side of the square cells for which images have the depth of the nearest surface, pixels (MapTRv2
            learns it in cells of 32); None leaves it out.
    """

    cameras: Annotated[tuple[CameraMount, ...], NOT_EMPTY] = NUSCENES_RING
    scale: Positive = 0.1
    multiple: Count = 1
    jitter: PositiveOrZero = 1.0
    severity: Fraction = 1.0
    weather: FrontWeatherConfig = FrontWeatherConfig()
    element_pixels: PositiveOrZero = 8.0
    markers: bool = False
    depth_cell: Count | None = None

    @property
    def supersample(self) -> int:
        """Factor by which an image is drawn larger before it is averaged down."""
        return 2 if self.scale < _SMALL else 1

    def size(self, mount: CameraMount) -> tuple[int, int]:
        """Return width and height of a camera's image, pixels."""
        width, height = (
            -(-round(side * self.scale) // self.multiple) * self.multiple for side in (mount.width, mount.height)
        )
        return width, height

    def limits(self) -> Rules:
        """Images are not too small to show anything, nor too large to be drawn."""
        sizes = [size for mount in self.cameras for size in self.size(mount)]
        yield "scale", min(sizes) >= 8, "so large that images have at least 8 pixels in each direction"
        yield "scale", max(sizes) <= _LARGEST, f"so small that images have at most {_LARGEST} pixels in each direction"


@functools.lru_cache(maxsize=16)
def draw_rig(seed: int, config: CameraRigConfig) -> tuple[PinholeCamera, ...]:
    """Return the calibrated cameras of a scene, one for each mount.

    A camera depends on the seed, its own mount, scale, multiple and jitter alone, not on the other cameras.
    """
    check_settings(config, "CameraRigConfig.")
    return tuple(_draw_camera(seed, mount, config) for mount in config.cameras)


def camera_stream(seed: int, mount: CameraMount, *more: int) -> np.random.Generator:
    """Return the random stream of one camera of a scene."""
    return np.random.default_rng([ROOT, seed, zlib.crc32(mount.name.encode()), *more])


def _draw_camera(seed: int, mount: CameraMount, config: CameraRigConfig) -> PinholeCamera:
    focal, u, v, dx, dy, dz, yaw, pitch, roll = config.jitter * camera_stream(seed, mount).standard_normal(9)
    angles = np.deg2rad([mount.yaw + _ANGLE * yaw, mount.pitch + _ANGLE * pitch, _ANGLE * roll])
    pose = camera_pose(0.0, angles[1], angles[0], angles[2])
    pose[:3, 3] = -pose[:3, :3] @ (np.array([mount.x, mount.y, mount.z]) + _PLACE * np.array([dx, dy, dz]))
    scale = [round(mount.width * config.scale) / mount.width, round(mount.height * config.scale) / mount.height]
    center = 0.5 * np.array([mount.width, mount.height]) + _CENTER * mount.focal * np.array([u, v])
    length = mount.focal * (1.0 + _FOCAL * focal)
    native = np.array([[length, 0.0, center[0]], [0.0, length, center[1]], [0.0, 0.0, 1.0]])
    return PinholeCamera(*config.size(mount), np.diag([*scale, 1.0]) @ native, pose)


def enlarged(camera: PinholeCamera, factor: int) -> PinholeCamera:
    """Return the camera with `factor` times as many pixels along both sides."""
    if factor == 1:
        return camera
    scale: Float[np.ndarray, "3 3"] = np.diag([float(factor), float(factor), 1.0])
    return PinholeCamera(
        factor * camera.width, factor * camera.height, scale @ camera.intrinsics, camera.camera_from_ego
    )
