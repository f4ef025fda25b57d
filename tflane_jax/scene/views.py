"""Sensor data of one frame: the bird's-eye-view evidence raster and calibrated camera images."""

from __future__ import annotations

import enum

from flax import struct
from jaxtyping import Bool, Float, Int, UInt8

from tflane_jax.scene.arrays import Array, check_shapes


class BevChannel(enum.IntEnum):
    """Channels of the bird's-eye-view evidence raster (`Example.bev`)."""

    LANE_PAINT = 0
    ROAD_EDGE = 1
    CROSSING = 2
    OBSTACLE = 3


@struct.dataclass
class VehicleState:
    """Frames and motion of the vehicle that published weights read beside the images; one frame.

    "ego" is the frame of the example, to which `CameraViews.camera_from_ego` leads.

    Attributes:
        lidar_from_ego: (4, 4) pose in the lidar's axes (nuScenes: x right, y forward, z up) with its height and tilt.
        vehicle_from_ego: (4, 4) pose in the vehicle's own frame: rear axle, x forward, y left, z up from the ground.
        can_bus: (18,) nuScenes' CAN bus (`datasets.nuscenes_can_bus`), or what stands for it in OpenLane-V2
            (`datasets.openlane_can_bus`); None if it was not read.
    """

    lidar_from_ego: Float[Array, "4 4"]
    vehicle_from_ego: Float[Array, "4 4"]
    can_bus: Float[Array, "18"] | None = None

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


@struct.dataclass
class CameraViews:
    """Images of V calibrated pinhole cameras in one frame.

    Camera 0 is the front camera; traffic elements are labelled in its image. All image arrays have the same size; a
    smaller image lies in the top-left corner of its array, and the rest is padding.

    Attributes:
        image: (V, H, W, 3) uint8, RGB, without lens distortion.
        size: (V, 2) width and height of each image, pixels.
        intrinsics: (V, 3, 3), pixels from the top-left corner of the image (see `geometry.cameras`).
        camera_from_ego: (V, 4, 4) extrinsics, metres.
        valid: (V,) the camera delivered an image.
        depth: (V, rows, columns) depth of the nearest surface in square cells of the image array, metres along the
            optical axis; only for training. None if it is not known.
        depth_valid: (V, rows, columns) a surface was measured in the cell.
        vehicle: frames and bus signals that published weights need; None if the data have none.
    """

    image: UInt8[Array, "v h w 3"]
    size: Int[Array, "v 2"]
    intrinsics: Float[Array, "v 3 3"]
    camera_from_ego: Float[Array, "v 4 4"]
    valid: Bool[Array, " v"]
    depth: Float[Array, "v rows columns"] | None = None
    depth_valid: Bool[Array, "v rows columns"] | None = None
    vehicle: VehicleState | None = None

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)
        if (self.depth is None) != (self.depth_valid is None):
            raise AssertionError("depth and depth_valid go together, and one of them is None")
