"""Lanes of markers as a BEV raster: which lanes pass each cell, how, and the factor with which they enter Eq. (3).

Ours, not in the marker paper; no parameters. A token of Eq. (3) is a whole lane, and every cell that attends to it gets
the same value, so that a cell has to learn from the token where the lane passes. The raster gives
each cell the lane's place and direction.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from tflane_jax.geometry import BevGrid
from tflane_jax.priors.bev_cells import cells_of
from tflane_jax.priors.marker_memory import MarkerGuidance

CHANNELS = 8
"""Per cell: log(1 + points), factor; means of cos, sin, offset (2), start, end, weighted by the factor."""

# Weight of a lane of factor 0 in the means of a cell, so that they are those of its direction and not 0 / 0.
_LEAST = 1e-6


@struct.dataclass
class MarkerRaster:
    """Lanes of markers by BEV cell, row by row; row 0 and column 0 at the low ends.

    Attributes:
        features: (Q, `CHANNELS`), 0 in cells without lanes: log(1 + number of points / (`between` + 1)); the largest
            factor of these points' lanes; means over the points, weighted by the factor, of cos and sin of the
            direction, offset (x, y) from the cell center in cells, first point of its lane (0 or 1), last point (0 or
            1).
        factor: (Q,) in [0, 1], the largest of the lanes in the cell: c of Eq. (3) times the weight of Eq. (4); 0
            without lanes.
    """

    features: Float[Array, "q f"]
    factor: Float[Array, " q"]


def rasterise_markers(lanes: MarkerGuidance, grid: BevGrid, between: int) -> MarkerRaster:
    """Return the raster of the lanes that enter Eq. (3); points outside the grid are left out.

    Args:
        lanes: after memory, `gate` and `valid` those of the variant (Table II).
        grid: the cells.
        between: points interpolated between successive points of a lane, so that a lane leaves no gap.
    """
    valid = lanes.valid
    points = jnp.where(valid[:, None, None], lanes.points, 0.0)
    line, direction = _with_points_between(points, between)  # metres
    count = line.shape[1]
    present = jnp.broadcast_to(valid[:, None], line.shape[:2])
    cell, offset = cells_of(grid.range.normalise(line), present, grid)
    ends = jnp.stack([jnp.arange(count) == 0, jnp.arange(count) == count - 1], -1)
    ends = jnp.broadcast_to(ends.astype(line.dtype), (*cell.shape, 2))
    factor = jnp.broadcast_to(jnp.where(valid, lanes.weight * lanes.gate, 0.0)[:, None], cell.shape)
    weight = jnp.maximum(factor, _LEAST)[..., None]
    weighted = weight * jnp.concatenate([direction, offset, ends], -1)
    summed = jnp.concatenate([jnp.ones_like(weight), weight, weighted], -1)

    cells, flat = grid.rows * grid.columns, cell.reshape(-1)
    total = jnp.zeros((cells, summed.shape[-1])).at[flat].add(summed.reshape(len(flat), summed.shape[-1]), mode="drop")
    number, weights, values = total[:, :1], total[:, 1:2], total[:, 2:]
    strongest = jnp.zeros(cells).at[flat].max(factor.reshape(-1), mode="drop")
    means = values / jnp.where(number > 0.0, weights, 1.0)
    amount = jnp.log1p(number / (between + 1))
    return MarkerRaster(jnp.concatenate([amount, strongest[:, None], means], -1), strongest)


def _with_points_between(
    points: Float[Array, "n k 2"], between: int
) -> tuple[Float[Array, "n m 2"], Float[Array, "n m 2"]]:
    """Return lines with interpolated points, M = (K - 1) (between + 1) + 1, and the unit direction at each point.

    The last point has the direction of the piece before it; a piece between equal points has none, (0, 0).
    """
    lines, pieces = len(points), points.shape[1] - 1
    ahead = points[:, 1:] - points[:, :-1]
    fraction = (jnp.arange(between + 1) / (between + 1))[None, None, :, None]
    inner = (points[:, :-1, None] + fraction * ahead[:, :, None]).reshape(lines, pieces * (between + 1), 2)
    length = jnp.sqrt((ahead**2).sum(-1, keepdims=True))
    direction = jnp.repeat(ahead / jnp.where(length > 0.0, length, 1.0), between + 1, axis=1)
    return jnp.concatenate([inner, points[:, -1:]], 1), jnp.concatenate([direction, direction[:, -1:]], 1)
