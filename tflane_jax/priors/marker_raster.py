"""Lanes of markers as a BEV raster: which lanes pass each cell, how, and how far they are trusted.

Ours, not in the marker paper; no parameters. A token of Eq. (3) is a whole lane, and every cell that attends to it gets
the same value, so that a cell has to learn from the token where the lane passes. The raster says it.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import BevGrid
from tflane_jax.priors.bev_cells import cells_of
from tflane_jax.priors.marker_memory import MarkerGuidance

CHANNELS = 8
"""Per cell: log(1 + lanes), trust; trust-weighted means of cos, sin, offset (2), start, end."""


@struct.dataclass
class MarkerRaster:
    """Lanes of markers by BEV cell, row by row; row 0 and column 0 at the low ends.

    Attributes:
        features: (Q, `CHANNELS`), 0 in cells without lanes: log(1 + points of lanes in the cell / points of a lane
            within one of its K - 1 pieces); the largest trust of them; means over them, weighted by trust, of cos and
            sin of the direction, offset (x, y) from the cell centre in cells, whether the lane starts here, and whether
            it ends here.
        trust: (Q,) in [0, 1], c of Eq. (3) times the weight of Eq. (4) of the most trusted lane; 0 without lanes.
    """

    features: Float[Array, "q f"]
    trust: Float[Array, " q"]


def rasterise_markers(lanes: MarkerGuidance, valid: Bool[Array, " n"], grid: BevGrid, between: int) -> MarkerRaster:
    """Return the raster of the lanes that enter Eq. (3); points outside the grid are left out.

    Args:
        lanes: after memory, `gate` that of the variant (Table II).
        valid: (N,) lanes that may be attended to.
        grid: the cells.
        between: points interpolated between successive points of a lane, so that a lane leaves no gap.
    """
    points = grid.range.normalise(jnp.where(valid[:, None, None], lanes.points, 0.0))
    step = (jnp.arange(between + 1) / (between + 1))[None, None, :, None]
    ahead = points[:, 1:] - points[:, :-1]
    inner = points[:, :-1, None] + step * ahead[:, :, None]
    inner = inner.reshape(len(points), (points.shape[1] - 1) * (between + 1), 2)
    line = jnp.concatenate([inner, points[:, -1:]], 1)
    metres = ahead * jnp.asarray(grid.range.size(2), ahead.dtype)[None, None]
    length = jnp.sqrt((metres**2).sum(-1, keepdims=True))
    # Of a doubled point, the direction is 0.
    heading = metres / jnp.where(length > 0.0, length, 1.0)
    heading = jnp.concatenate([jnp.repeat(heading, between + 1, axis=1), heading[:, -1:]], 1)

    count = line.shape[1]
    present = jnp.broadcast_to(valid[:, None], line.shape[:2])
    cell, offset = cells_of(line, present, grid)
    ends = jnp.broadcast_to(jnp.stack([jnp.arange(count) == 0, jnp.arange(count) == count - 1], -1), (*cell.shape, 2))
    trust = jnp.broadcast_to(jnp.where(valid, lanes.weight * lanes.gate, 0.0)[:, None], cell.shape)
    values = jnp.concatenate([jnp.ones((*cell.shape, 1)), heading, offset, ends.astype(line.dtype)], -1)
    # Lanes without any trust still have a direction: means need a weight above 0, and trust scales what is added.
    weighted = values[..., 1:] * jnp.maximum(trust, 1e-6)[..., None]
    cells, flat = grid.rows * grid.columns, cell.reshape(-1)

    def total(each: Float[Array, "n m v"]) -> Float[Array, "q v"]:
        return jnp.zeros((cells, each.shape[-1])).at[flat].add(each.reshape(len(flat), each.shape[-1]), mode="drop")

    number, weight = total(values[..., :1]), total(jnp.maximum(trust, 1e-6)[..., None])
    means = total(weighted) / jnp.where(number > 0.0, weight, 1.0)
    strongest = jnp.zeros(cells).at[flat].max(trust.reshape(-1), mode="drop")
    amount = jnp.log1p(number / (between + 1))
    return MarkerRaster(jnp.concatenate([amount, strongest[:, None], means], -1), strongest)
