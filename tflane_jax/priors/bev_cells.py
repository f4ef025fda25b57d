"""Which cell of a BEV grid a point is in: the first step of every raster of a prior."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.geometry import BevGrid


def cells_of(
    unit: Float[Array, "*p 2"], present: Bool[Array, "*p"], grid: BevGrid
) -> tuple[Int[Array, "*p"], Float[Array, "*p 2"]]:
    """Return the cell of each point, and its offset (x, y) from the center of that cell, in cells.

    Absent points, and those outside the grid, get an index beyond the last cell, which a scatter with `mode="drop"`
    leaves out.

    Args:
        unit: normalised coordinates, which span the grid's range from 0 to 1; finite also where absent.
        present: which points exist.
        grid: the cells, row by row; row 0 and column 0 at the low ends.
    """
    size = jnp.asarray([grid.columns, grid.rows], unit.dtype).reshape(*[1] * (unit.ndim - 1), 2)
    inside = ((unit >= 0.0) & (unit <= 1.0)).all(-1)
    place = jnp.minimum(jnp.floor(unit * size), size - 1.0)  # the upper border belongs to the last cell
    column, row = place[..., 0].astype(int), place[..., 1].astype(int)
    cell = jnp.where(present & inside, row * grid.columns + column, grid.rows * grid.columns)
    return cell, unit * size - place - 0.5
