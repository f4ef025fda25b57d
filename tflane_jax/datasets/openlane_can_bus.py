"""What published weights of TopoNet and LaneSegNet know of the vehicle: numbers of the frame's pose.

OpenLane-V2 has no CAN bus. The published code fills the vector that BEVFormer's encoder takes from the pose of a frame.
Source: `get_data_info` of the datasets of TopoNet and LaneSegNet, and pyquaternion, by which they take the pose apart.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import VehicleState

CanBus = Literal["none", "reference"]
"""No vector, or that of the published code."""
# OpenLane-V2 does not tell the lidar's pose: x right and y forward, as hosts in its axes take it where it is unknown.
_LIDAR_FROM_EGO = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float32)


def pose_can_bus(global_from_ego: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "18"]:
    """Return the vector of a frame as the published code makes it.

    [0:3] position, metres; [3:7] the real part of the orientation's quaternion, four times; [16] yaw, radians from 0 to
    2 pi; [17] yaw, degrees; the others are 0. `bevformer.can_bus_vector` zeroes what weights of single frames do not
    read.
    """
    rotation = np.asarray(global_from_ego, np.float64)[:3, :3]
    # A quaternion and its negative are the same rotation. pyquaternion's choice for a vehicle on its wheels:
    backwards = rotation[0, 0] + rotation[1, 1] < 0.0
    sign = np.sign(rotation[1, 0] - rotation[0, 1]) if backwards else 1.0
    # Not atan2(r10, r00), from which it differs on slopes: pyquaternion turns about z first.
    yaw = float(np.arctan2(-rotation[0, 1], rotation[0, 0])) % (2.0 * np.pi)
    found = np.zeros(18)
    found[:3] = np.asarray(global_from_ego)[:3, 3]
    found[3:7] = sign * 0.5 * np.sqrt(max(1.0 + np.trace(rotation), 0.0))
    found[16:] = yaw, np.degrees(yaw)
    return found


def vehicle_state(global_from_ego: Float[np.ndarray, "4 4"], can_bus: CanBus) -> VehicleState | None:
    """Return what published weights know of the vehicle in a frame; None with `can_bus` "none"."""
    if can_bus == "none":
        return None
    vector = pose_can_bus(global_from_ego).astype(np.float32)
    return VehicleState(_LIDAR_FROM_EGO.copy(), np.eye(4, dtype=np.float32), vector)
