"""Pillars of points over the cells of a BEV grid and their projection into cameras.

Reference: Li et al. 2022 (BEVFormer), section 3.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry.cameras import MIN_DEPTH
from tflane_jax.geometry.namespace import AnyArray, namespace, product
from tflane_jax.geometry.poses import transform_points
from tflane_jax.geometry.ranges import BevGrid


def cell_points(grid: BevGrid) -> Float[np.ndarray, "q 2"]:
    """Return the centers (x, y) of the cells, row by row, in [0, 1] across the grid's range."""
    x = (np.arange(grid.columns) + 0.5) / grid.columns
    y = (np.arange(grid.rows) + 0.5) / grid.rows
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(np.float32)


def pillar_points(grid: BevGrid, anchors: int) -> Float[np.ndarray, "q d 3"]:
    """Return the points of the pillars in [0, 1]: D heights, the first and last 0.5 m inside the z range."""
    height = grid.range.size()[2]
    z = np.linspace(0.5, height - 0.5, anchors) / height
    cells = cell_points(grid)
    plane = np.broadcast_to(cells[:, None], (len(cells), anchors, 2))
    return np.concatenate([plane, np.broadcast_to(z[None, :, None], (len(cells), anchors, 1))], -1).astype(np.float32)


def project_pillars(
    points: Float[AnyArray, "q d 3"],
    intrinsics: Float[AnyArray, "v 3 3"],
    camera_from_ego: Float[AnyArray, "v 4 4"],
    size: Int[AnyArray, "v 2"],
) -> tuple[Float[Any, "v q d 2"], Bool[Any, "v q d"]]:
    """Return where pillar points (metres, ego frame) lie in each image, as fractions of its size, and whether inside.

    Args:
        points: pillars.
        intrinsics, camera_from_ego: of the cameras.
        size: width and height of each camera's own image, pixels.

    A point behind a camera is projected with the least depth, as by BEVFormer, which puts it far outside the image.
    """
    xp = namespace(points, intrinsics, camera_from_ego)
    q, d = points.shape[:2]
    local = transform_points(camera_from_ego, xp.broadcast_to(points.reshape(1, q * d, 3), (len(size), q * d, 3)))
    depth = local[..., 2:]
    image = product(local, xp.swapaxes(intrinsics, -1, -2))[..., :2]
    fraction = image / xp.maximum(depth, MIN_DEPTH) / size[:, None].astype(image.dtype)
    inside = (depth > MIN_DEPTH) & (fraction > 0.0) & (fraction < 1.0)
    return fraction.reshape(-1, q, d, 2), inside.all(-1).reshape(-1, q, d)
