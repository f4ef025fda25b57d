"""Bird's-eye-view features of the previous frame seen from the current one (specs/modules.md section 4).

Grids are those of `geometry.BevGrid`: rows along y, columns along x, both from the least coordinate.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry import BevGrid
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.geometry.poses import transform_points
from tflane_jax.layers.sampling import sample_bilinear


def warp(
    features: Float[Array, "h w c"], grid: BevGrid, previous_from_ego: Float[Array, "4 4"]
) -> Float[Array, "h w c"]:
    """Return the previous features at the places of the current cells: bilinear, zero where there were none."""
    h, w, c = features.shape
    cells = jnp.asarray(grid.range.denormalise(cell_points(grid)))
    ground = jnp.concatenate([cells, jnp.zeros_like(cells[:, :1])], -1)
    before = grid.range.normalise(transform_points(previous_from_ego, ground)[:, :2])
    return sample_bilinear(features.reshape(h * w, c), (h, w), before).reshape(h, w, c)


def rotate_nearest(
    features: Float[Array, "h w c"], yaw: Float[Array, ""], center: tuple[float, float]
) -> Float[Array, "h w c"]:
    """Return features turned about a point: each cell takes the nearest one, zero where there is none.

    Args:
        features: of the previous frame.
        yaw: how far the vehicle has turned since, radians.
        center: (column, row) that stays, in cells from the outer corner of the grid (torchvision's `rotate`).
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


def ego_shift(grid: BevGrid, previous_from_ego: Float[Array, "4 4"]) -> Float[Array, "2"]:
    """Return how far the vehicle has moved since the previous frame, along its present axes, as shares of the range.

    A cell of the present grid, moved by this, lies at its own place in the previous features turned to the present
    heading.
    """
    moved = previous_from_ego[:2, :2].T @ previous_from_ego[:2, 3]
    return moved / jnp.array(grid.range.size(2), moved.dtype)
