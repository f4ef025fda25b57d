"""Depth of what a camera of the world sees, on a grid of cells: the nearest surface in each.

The stand-in for a lidar projected into the image, which teaches MapTRv2's lift (LSS) its depth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import invert_pose
from tflane_jax.world.cameras.solids import Bodies, polygon_starts, with_blobs
from tflane_jax.world.cameras.surface import Surface
from tflane_jax.world.render.camera import NEAR, PinholeCamera
from tflane_jax.world.render.faces import faces_of
from tflane_jax.world.render.polygons import SHIFT, clipped, fixed_point

# Samples along each side of a cell.
_SAMPLES = 4
# Metres; ground beyond is not seen.
_FAR = 130.0


def render_depth(
    bodies: Bodies, camera: PinholeCamera, cell: int, surface: Surface | None = None
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the depth of the nearest surface in each cell, metres along the optical axis, and where there is one.

    Args:
        bodies: ego frame.
        camera: its image is covered by whole cells from the top-left corner.
        cell: side of a cell, pixels.
        surface: hilly ground; None: the ground is the plane z = 0.
    """
    h, w = -(-camera.height // cell), -(-camera.width // cell)
    scale = _SAMPLES / cell
    coarse = replace(
        camera,
        width=w * _SAMPLES,
        height=h * _SAMPLES,
        intrinsics=np.diag([scale, scale, 1.0]) @ camera.intrinsics,
    )
    columns, rows = np.arange(coarse.width) + 0.5, np.arange(coarse.height) + 0.5
    if surface is None:
        ground = coarse.ground_depth(columns, rows, _FAR)
    else:
        place, seen, _ = surface.hits(coarse)
        ground = np.maximum(surface.depth(coarse, place, seen), NEAR)
    inverse = np.where(ground < _FAR, 1.0 / ground, 0.0)
    _add_bodies(inverse, bodies, coarse)
    # Cells may extend beyond the image.
    inverse[rows > camera.height * scale] = 0.0
    inverse[:, columns > camera.width * scale] = 0.0
    nearest = inverse.reshape(h, _SAMPLES, w, _SAMPLES).max((1, 3))
    valid = nearest > 1.0 / _FAR
    return np.where(valid, 1.0 / np.where(valid, nearest, 1.0), 0.0), valid


def _add_bodies(inverse: Float[np.ndarray, "h w"], bodies: Bodies, camera: PinholeCamera) -> None:
    """Raise the inverse depth of the pixels that bodies cover (in place): no order, the nearest surface stays."""
    import cv2

    if not len(bodies.boxes):
        return
    eye = invert_pose(camera.camera_from_ego)[:3, 3]
    bodies = with_blobs(bodies, eye)
    faces = faces_of(bodies.corners, polygon_starts(bodies), camera, eye)
    for number in faces.shown.tolist():
        part = slice(faces.starts[number], bodies.stops[number])
        corners, distance = bodies.corners[part], faces.depth[part]
        if faces.near[number]:
            corners = clipped(corners, distance)
            distance = camera.image_of(corners)[1]
        ring = camera.image_of(corners)[0]
        (left, top), (right, bottom) = np.floor(ring.min(0)).astype(int), np.ceil(ring.max(0)).astype(int)
        left, top, right, bottom = max(left, 0), max(top, 0), min(right, camera.width), min(bottom, camera.height)
        if left >= right or top >= bottom:
            continue
        covered = np.zeros((bottom - top, right - left), np.uint8)
        cv2.fillPoly(covered, [fixed_point(ring - [left, top])], 1, cv2.LINE_8, SHIFT)
        # On a plane, 1 / depth is linear in the pixel.
        plane = (camera.camera_from_ego[:3, :3] @ faces.normal[number]) @ np.linalg.inv(camera.intrinsics)
        plane = plane / -faces.towards[number]
        u, v = np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5
        near = plane[0] * u + (plane[1] * v)[:, None] + plane[2]
        # cv2 fills the pixels of the border too, whose centers lie outside.
        near = np.clip(near, 1.0 / distance.max(), 1.0 / max(distance.min(), NEAR))
        window = inverse[top:bottom, left:right]
        np.maximum(window, np.where(covered > 0, near, 0.0), out=window)
