"""Alignment of the previous frame's bird's-eye-view features with the current frame (BEVFormer, Li et al. 2022).

Grids are those of `geometry.BevGrid`: rows along y, columns along x, both from the least coordinate.
"""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry import BevGrid
from tflane_jax.geometry.namespace import product
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.geometry.poses import transform_points
from tflane_jax.layers.sampling import sample_bilinear


def warp(
    features: Float[Array, "h w c"], grid: BevGrid, previous_from_ego: Float[Array, "4 4"]
) -> Float[Array, "h w c"]:
    """Return the previous features sampled at the current cells: bilinear, zero outside the previous grid."""
    h, w, c = features.shape
    cells = jnp.asarray(grid.range.denormalise(cell_points(grid)))
    ground = jnp.concatenate([cells, jnp.zeros_like(cells[:, :1])], -1)
    before = grid.range.normalise(transform_points(previous_from_ego, ground)[:, :2])
    return sample_bilinear(features.reshape(h * w, c), (h, w), before).reshape(h, w, c)


def rotate_nearest(
    features: Float[Array, "h w c"], yaw: Float[Array, ""], center: tuple[float, float]
) -> Float[Array, "h w c"]:
    """Return features rotated about a point, nearest sampling, zero outside (torchvision's `rotate`).

    Args:
        features: of the previous frame.
        yaw: change of the vehicle's heading since then, radians.
        center: (column, row) of the fixed point, in cells from the outer corner of the grid.
    """
    h, w, c = features.shape
    size, middle = jnp.array([w, h], jnp.float32), jnp.array(center, jnp.float32)
    columns, rows = jnp.meshgrid(jnp.arange(w, dtype=jnp.float32), jnp.arange(h, dtype=jnp.float32))
    offset = jnp.stack([columns, rows], -1) + 0.5 - middle[None, None]
    cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
    x = cosine * offset[..., 0] - sine * offset[..., 1]
    y = sine * offset[..., 0] + cosine * offset[..., 1]
    # In this order: relative to the middle of the image first, as torchvision rounds.
    around = (middle - size / 2.0)[None, None]
    source = jnp.rint(jnp.stack([x, y], -1) + around + (size / 2.0)[None, None] - 0.5).astype(jnp.int32)
    inside = ((source >= 0) & (source < jnp.array([w, h])[None, None])).all(-1)
    index = jnp.where(inside, source[..., 1] * w + source[..., 0], 0)
    taken = features.reshape(h * w, c).at[index].get(mode="promise_in_bounds")
    return jnp.where(inside[..., None], taken, 0.0)


def vehicle_center(grid: BevGrid) -> tuple[float, float]:
    """Return the vehicle's (column, row) in cells from the outer corner of the grid."""
    (x, y), (width, height) = grid.range.low(2), grid.range.size(2)
    return -x / width * grid.columns, -y / height * grid.rows


def ego_shift(
    grid: BevGrid, previous_from_ego: Float[Array, "4 4"], axes: Literal["ego", "lidar"] = "ego"
) -> Float[Array, "2"]:
    """Return the vehicle's motion since the previous frame, along its present axes, as fractions of the range.

    A cell of the present grid, moved by this, lies at its own place in the previous features after those have been
    rotated to the present heading.

    Args:
        grid: cells and range.
        previous_from_ego: pose of the present ego frame in the previous one.
        axes: of the grid. "ego": x forward, y left, as everywhere in this library and in TopoNet. "lidar": x right, y
            forward, the axes of nuScenes' lidar, for which BEVFormer derived its shift.
    """
    moved = product(previous_from_ego[:2, :2].T, previous_from_ego[:2, 3])
    if axes == "lidar":
        moved = jnp.stack([-moved[1], moved[0]])
    return moved / jnp.array(grid.range.size(2), moved.dtype)
