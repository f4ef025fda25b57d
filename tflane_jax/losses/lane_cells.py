"""An auxiliary loss on BEV features: does a lane run through this cell, and which way?

Not part of any of the papers. A decoder's first thousands of steps teach the features in front of it little, because
its queries do not know yet where to look; this loss asks every cell, so that small models learn to see first.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.scene import LaneGraph

CHANNELS = 3
"""What a cell says: the logit that a lane is in it, and the x and y of the lane's direction."""

# Samples on each piece of a centerline; eleven points on 100 m are then a metre apart.
_SAMPLES = 10


def lane_cells(
    lanes: LaneGraph, shape: tuple[int, int], range_: PerceptionRange
) -> tuple[Bool[Array, "h w"], Float[Array, "h w 2"]]:
    """Return the cells that valid lanes run through, and the mean unit direction of the lanes there (0 elsewhere).

    Args:
        lanes: truth of one example; what stands in padding changes nothing.
        shape: rows (along y) and columns (along x) of the grid that spans `range_`.
    """
    h, w = shape
    points = jnp.where(lanes.valid[:, None, None], lanes.points, 0.0)[..., :2]
    step = points[:, 1:] - points[:, :-1]  # (N, P - 1, 2)
    share = ((jnp.arange(_SAMPLES) + 0.5) / _SAMPLES).reshape(1, 1, _SAMPLES, 1)
    unit = range_.normalise(points[:, :-1, None] + share * step[:, :, None])
    column, row = jnp.floor(unit[..., 0] * w).astype(int), jnp.floor(unit[..., 1] * h).astype(int)
    inside = (column >= 0) & (column < w) & (row >= 0) & (row < h) & lanes.valid[:, None, None]
    cell = jnp.where(inside, row * w + column, h * w).reshape(-1)  # h w lies outside: nothing is written
    direction = step / jnp.sqrt((step**2).sum(-1, keepdims=True) + 1e-6)
    direction = jnp.broadcast_to(direction[:, :, None], (*inside.shape, 2)).reshape(-1, 2)
    written = jnp.concatenate([jnp.ones((len(cell), 1)), direction], -1)
    total = jnp.zeros((h * w, 3)).at[cell].add(written, mode="drop").reshape(h, w, 3)
    count = total[..., :1]
    return count[..., 0] > 0, total[..., 1:] / jnp.maximum(count, 1.0)


def lane_cell_loss(said: Float[Array, "h w 3"], lanes: LaneGraph, range_: PerceptionRange) -> Float[Array, ""]:
    """Return the loss of one example: cross entropy, cells with and without a lane weighing alike, and the error of
    the directions.
    """
    h, w, _ = said.shape
    there, direction = lane_cells(lanes, (h, w), range_)
    entropy = optax.sigmoid_binary_cross_entropy(said[..., 0], there.astype(said.dtype))
    error = jnp.abs(said[..., 1:] - direction).sum(-1)
    return 0.5 * (_mean(entropy, there) + _mean(entropy, ~there)) + _mean(error, there)


def _mean(values: jax.Array, where: jax.Array) -> jax.Array:
    return jnp.where(where, values, 0.0).sum() / jnp.maximum(where.sum(), 1)
