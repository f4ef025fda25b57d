"""Hosts that work in the axes of nuScenes' lidar (x right, y forward), as published weights of MapTR and MapTRv2 do.

Such a host turns its inputs into the lidar's frame and its lines back into the frame of the example, so that data,
losses, metrics and pictures stay in one frame. Cameras take the lidar's whole pose, with height and tilt, as the
published code does, and so do the lines of masks in the images. All else takes the level pose: the lidar's place and
heading above the ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange, invert_pose, pose_yaw, transform_points, yaw_pose
from tflane_jax.geometry.namespace import product
from tflane_jax.models.prior import BevCells, HostQueries, Prior
from tflane_jax.scene import CameraViews, Example, MapLines, SdMap, TrafficFlow, VehicleState

# Height of the lines of MapTRv2's masks in the images, in the lidar's axes, metres.
_PLANE = -1.6


def range_in_lidar_axes(range_: PerceptionRange) -> PerceptionRange:
    """Return the box of the ego axes (x forward, y left) in the lidar's: (x, y) is (-y, x) there."""
    return PerceptionRange((-range_.y[1], -range_.y[0]), range_.x, range_.z)


def range_in_ego_axes(range_: PerceptionRange) -> PerceptionRange:
    """Return the box of the lidar's axes in the ego axes, the inverse of `range_in_lidar_axes`."""
    return PerceptionRange(range_.y, (-range_.x[1], -range_.x[0]), range_.z)


def raster_in_ego_axes(raster: Float[Array, "*b y x"]) -> Float[Array, "*b x y"]:
    """Return cells of the lidar's axes as cells of the ego axes; rows run along y, columns along x in both."""
    return jnp.flip(jnp.swapaxes(raster, -1, -2), -2)


def lidar_from_ego(example: Example) -> Float[Array, "4 4"]:
    """Return the lidar's pose, to which cameras are moved; for data without one, a quarter turn."""
    vehicle = None if example.cameras is None else example.cameras.vehicle
    if vehicle is None:
        return invert_pose(yaw_pose(*jnp.array([0.0, 0.0, -math.pi / 2])))
    return jnp.asarray(vehicle.lidar_from_ego)


def level_pose(example: Example) -> Float[Array, "4 4"]:
    """Return ego_from_lidar without tilt."""
    pose = invert_pose(lidar_from_ego(example))
    level = yaw_pose(pose[0, 3], pose[1, 3], pose_yaw(pose))
    return level.at[2, 3].set(pose[2, 3])


def in_lidar_axes(example: Example) -> Example:
    """Return cameras, traffic flow, SD map and motion of an example in the lidar's frame; the truth stays as it is."""
    level = level_pose(example)
    lidar = invert_pose(level)
    return replace(
        example,
        cameras=None if example.cameras is None else _cameras(example.cameras, lidar_from_ego(example)),
        traffic_flow=None if example.traffic_flow is None else _traffic(example.traffic_flow, lidar),
        sd_map=None if example.sd_map is None else _sd_map(example.sd_map, lidar),
        previous_from_ego=product(product(lidar, jnp.asarray(example.previous_from_ego)), level),
    )


def lines_beside_lidar(lines: MapLines, example: Example) -> MapLines:
    """Return map lines in the frame that `raster_in_ego_axes` gives a raster: ego axes with the lidar's place, heading.

    Args:
        lines: of the example's frame; padding may hold anything.
        example: knows the lidar's pose.
    """
    turn = yaw_pose(*jnp.array([0.0, 0.0, -math.pi / 2]))
    return _moved(lines, partial(lines_in_ego_axes, level=product(turn, invert_pose(level_pose(example)))))


def lines_below_lidar(lines: MapLines, example: Example) -> MapLines:
    """Return map lines in the plane that MapTRv2's masks in the images have: 1.6 m below the lidar, tilted as it is.

    The published code takes (x, y) of the level frame for those of the lidar's axes.

    Args:
        lines: of the example's frame; padding may hold anything.
        example: knows the lidar's pose; without one, the lines stay as they are.
    """
    if example.cameras is None or example.cameras.vehicle is None:
        return lines
    into, back = invert_pose(level_pose(example)), invert_pose(lidar_from_ego(example))

    def dropped(points: Float[Array, "l p 3"]) -> Float[Array, "l p 3"]:
        plane = lines_in_ego_axes(points, into).at[..., 2].set(_PLANE)
        return lines_in_ego_axes(plane, back)

    return _moved(lines, dropped)


def _moved(lines: MapLines, move: Callable[[Float[Array, "l p 3"]], Float[Array, "l p 3"]]) -> MapLines:
    """Return map lines with both of their forms moved."""
    dense = None if lines.dense is None else move(jnp.asarray(lines.dense))
    return replace(lines, points=move(jnp.asarray(lines.points)), dense=dense)


def lines_in_ego_axes(points: Float[Array, "*b p d"], level: Float[Array, "4 4"]) -> Float[Array, "*b p d"]:
    """Return points (x, y or x, y, z) of the lidar's frame in that of the example, see `level_pose`."""
    size = points.shape[-1]
    pose = level if size == 3 else level[jnp.array([0, 1, 3])][:, jnp.array([0, 1, 3])]
    return transform_points(pose, points.reshape(-1, size)).reshape(points.shape)


def _cameras(cameras: CameraViews, lidar: Float[Array, "4 4"]) -> CameraViews:
    ego, vehicle = invert_pose(lidar), cameras.vehicle
    own = jnp.eye(4, dtype=lidar.dtype) if vehicle is None else jnp.asarray(vehicle.vehicle_from_ego)
    can_bus = None if vehicle is None else vehicle.can_bus
    state = VehicleState(jnp.eye(4, dtype=lidar.dtype), product(own, ego), can_bus)
    return replace(cameras, camera_from_ego=product(jnp.asarray(cameras.camera_from_ego), ego), vehicle=state)


def _traffic(flow: TrafficFlow, lidar: Float[Array, "4 4"]) -> TrafficFlow:
    position = transform_points(lidar, jnp.asarray(flow.position))
    return replace(flow, position=position, yaw=jnp.asarray(flow.yaw) + pose_yaw(lidar))


def _sd_map(sd_map: SdMap, lidar: Float[Array, "4 4"]) -> SdMap:
    return replace(sd_map, points=lines_in_ego_axes(jnp.asarray(sd_map.points), lidar))


class InLidarAxes(Prior):
    """A prior of a host in the lidar's axes: it observes the turned example.

    Args:
        prior: built with the ranges of the lidar's axes.
    """

    def __init__(self, prior: Prior):
        self.prior = prior
        self.reads = prior.reads  # pyright: ignore[reportAttributeAccessIssue]

    def modules(self) -> dict[str, nn.Module]:
        return self.prior.modules()

    def start(self) -> Any:
        return self.prior.start()

    def observe(self, example: Example, memory: Any) -> tuple[Any, Any]:
        return self.prior.observe(in_lidar_axes(example), memory)

    def encode(self, observation: Any, *, deterministic: bool) -> Any:
        return self.prior.encode(observation, deterministic=deterministic)

    def into_bev(self, tokens: Any, layer: int, cells: BevCells) -> Float[Array, "q c"]:
        return self.prior.into_bev(tokens, layer, cells)

    def into_queries(self, tokens: Any, layer: int, queries: HostQueries) -> Float[Array, "q d"]:
        return self.prior.into_queries(tokens, layer, queries)

    def fuses_into_bev(self) -> bool:
        return self.prior.fuses_into_bev()
