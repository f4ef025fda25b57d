"""Pinhole cameras: from the ego frame to pixels and from pixels back to the ground.

Camera frame: x right, y down, z along the optical axis, metres. Pixels: (u right, v down) from the top-left **corner**
of the image, so that the center of the first pixel is (0.5, 0.5) and resizing is a plain multiplication. Intrinsics
are the 3 x 3 matrix K, the extrinsic is `camera_from_ego` (SE(3)). Leading axes broadcast; numpy or jax.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Bool, Float

from tflane_jax.geometry.namespace import AnyArray, ArrayT, constants, namespace, product
from tflane_jax.geometry.poses import invert_pose, transform_points

MIN_DEPTH = 1e-5
"""Least depth of a point in front of a camera, metres (BEVFormer)."""


def project(
    points: Float[AnyArray, "*b k 3"],
    intrinsics: Float[AnyArray, "*b 3 3"],
    camera_from_ego: Float[AnyArray, "*b 4 4"],
    min_depth: float = MIN_DEPTH,
) -> tuple[Float[Any, "*b k 2"], Float[Any, "*b k"], Bool[Any, "*b k"]]:
    """Return pixel and depth (metres along the optical axis) of points in the ego frame, and whether they are valid.

    A point is valid if its depth exceeds `min_depth` (default: BEVFormer's); `inside_image` checks the pixel. The pixel
    of an invalid point is finite and arbitrary.
    """
    xp = namespace(points, intrinsics, camera_from_ego)
    local = transform_points(camera_from_ego, points)
    depth = local[..., 2]
    valid = depth > min_depth
    image = product(local, xp.swapaxes(intrinsics, -1, -2))[..., :2]
    pixels = image / xp.where(valid, depth, 1.0)[..., None]
    return xp.where(valid[..., None], pixels, 0.0), depth, valid


def ground_points(
    pixels: Float[AnyArray, "*b k 2"],
    intrinsics: Float[AnyArray, "*b 3 3"],
    camera_from_ego: Float[AnyArray, "*b 4 4"],
    height: float = 0.0,
) -> tuple[Float[Any, "*b k 3"], Bool[Any, "*b k"]]:
    """Return where the rays of pixels meet the plane z = `height` of the ego frame, metres, and which of them do.

    A ray parallel to the plane or away from it (above the horizon) is not valid; its point is finite and arbitrary.
    """
    xp = namespace(pixels, intrinsics, camera_from_ego)
    ego_from_camera = invert_pose(camera_from_ego)
    homogeneous = xp.concatenate([pixels, xp.ones_like(pixels[..., :1])], -1)
    rays = product(homogeneous, xp.swapaxes(xp.linalg.inv(intrinsics), -1, -2))
    rays = product(rays, xp.swapaxes(ego_from_camera[..., :3, :3], -1, -2))
    origin = ego_from_camera[..., None, :3, 3]
    slope, drop = rays[..., 2], height - origin[..., 2]
    valid = slope * drop > 0.0
    distance = xp.where(valid, drop, 0.0) / xp.where(valid, slope, 1.0)
    ground = origin[..., :2] + distance[..., None] * rays[..., :2]
    return xp.concatenate([ground, xp.full_like(ground[..., :1], height)], -1), valid


def inside_image(pixels: Float[ArrayT, "*b 2"], width: int, height: int) -> Bool[ArrayT, "*b"]:
    """Return whether pixels lie in an image of this size, left and top border included, right and bottom excluded."""
    u, v = pixels[..., 0], pixels[..., 1]
    return (u >= 0) & (u < width) & (v >= 0) & (v < height)


def resize_intrinsics(intrinsics: Float[ArrayT, "*b 3 3"], scale: tuple[float, float]) -> Float[ArrayT, "*b 3 3"]:
    """Return the intrinsics after the image's width and height were multiplied by `scale`."""
    xp = namespace(intrinsics)
    return product(xp.diag(constants([*scale, 1.0], intrinsics)), intrinsics)


def crop_intrinsics(intrinsics: Float[ArrayT, "*b 3 3"], corner: tuple[float, float]) -> Float[ArrayT, "*b 3 3"]:
    """Return the intrinsics after the image was cut so that pixel `corner` (u, v) became its top-left corner."""
    u, v = corner
    return product(constants([[1.0, 0.0, -u], [0.0, 1.0, -v], [0.0, 0.0, 1.0]], intrinsics), intrinsics)
