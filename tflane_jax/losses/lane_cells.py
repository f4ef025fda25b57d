"""Auxiliary loss on BEV features: per cell, lane occupancy, offset to the nearest lane and its direction.

Not part of the lane papers. In the first thousands of steps, the decoder's gradient hardly trains the BEV features,
because its queries do not attend to lanes yet. This loss supervises every cell directly, which small models need.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.geometry import PerceptionRange
from tflane_jax.scene import LaneGraph

# Cells up to this distance from a lane, in cells, learn offset and direction: bilinear sampling near a lane reads them.
_RADIUS = 1.5
# Squared length of a piece, in cells, below which its ends count as one point.
_NO_LENGTH = 1e-9


class LaneCells(NamedTuple):
    """Targets of the cells.

    Attributes:
        inside: a lane passes through the cell. Tested by the point of each of its straight pieces that is nearest to
            the cell's center, so that a lane which only cuts a corner may not count.
        near: a lane passes within 1.5 cells of the cell's center.
        offset: from the center to the nearest point of a lane, in cells along x and y; 0 unless `near`.
        direction: unit direction of that lane; 0 unless `near`.
    """

    inside: Bool[Array, "h w"]
    near: Bool[Array, "h w"]
    offset: Float[Array, "h w 2"]
    direction: Float[Array, "h w 2"]


def lane_cells(
    lanes: LaneGraph, shape: tuple[int, int], range_: PerceptionRange, used: int | Int[Array, ""] | None = None
) -> LaneCells:
    """Return the targets of all cells from the valid lanes of one example.

    Args:
        lanes: ground truth; padding may hold anything. A lane may repeat points; one of a single place counts as none.
        shape: rows (along y) and columns (along x) of the grid.
        range_: the box that the grid covers, metres.
        used: all lanes from this one on are padding, see `used_lanes`; None looks at every lane.
    """
    h, w = shape
    count = jnp.array([w, h], jnp.float32)
    points = jnp.where(lanes.valid[:, None, None], lanes.points, 0.0)
    unit = range_.normalise(points)[..., :2] * count[None, None]  # in cells
    begin, step = unit[:, :-1].reshape(-1, 2), (unit[:, 1:] - unit[:, :-1]).reshape(-1, 2)  # (S, 2)
    squares = (step**2).sum(-1)
    # A piece between equal points has no direction; its neighbours cover its place.
    valid = jnp.repeat(lanes.valid, points.shape[1] - 1) & (squares > _NO_LENGTH)
    squares = jnp.maximum(squares, _NO_LENGTH)
    if not len(begin):
        nothing = jnp.zeros((h, w), bool)
        return LaneCells(nothing, nothing, jnp.zeros((h, w, 2)), jnp.zeros((h, w, 2)))
    column, row = jnp.meshgrid(*(jnp.arange(size, dtype=jnp.float32) + 0.5 for size in (w, h)))

    # Over the pieces so far: squared distance of the nearest, least max(|x|, |y|), step (x, y) to and index of the
    # nearest.
    def compare(i: Int[Array, ""], best: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        squared, chebyshev, x, y, nearest = best
        along = ((column - begin[i, 0]) * step[i, 0] + (row - begin[i, 1]) * step[i, 1]) / squares[i]
        along = jnp.clip(along, 0.0, 1.0)
        here_x, here_y = begin[i, 0] + along * step[i, 0] - column, begin[i, 1] + along * step[i, 1] - row
        here = jnp.where(valid[i], here_x**2 + here_y**2, jnp.inf)
        closer = here < squared
        return (
            jnp.where(closer, here, squared),
            jnp.minimum(chebyshev, jnp.where(valid[i], jnp.maximum(jnp.abs(here_x), jnp.abs(here_y)), jnp.inf)),
            jnp.where(closer, here_x, x),
            jnp.where(closer, here_y, y),
            jnp.where(closer, i, nearest),
        )

    # One segment after the other: on CPU, minima over a table of cells x segments take 24 times as long.
    far, zero = jnp.full((h, w), jnp.inf), jnp.zeros((h, w))
    start = (far, far, zero, zero, jnp.zeros((h, w), jnp.int32))
    pieces = len(begin) if used is None else used * (points.shape[1] - 1)
    squared, chebyshev, x, y, nearest = lax.fori_loop(0, pieces, compare, start)
    near = squared <= _RADIUS**2
    metres = step * jnp.asarray(range_.size(2), jnp.float32)[None] / count[None]
    direction = (metres / jnp.sqrt((metres**2).sum(-1, keepdims=True) + 1e-6))[nearest]
    offset, direction = (jnp.where(near[..., None], value, 0.0) for value in (jnp.stack([x, y], -1), direction))
    return LaneCells(chebyshev < 0.5, near, offset, direction)


def used_lanes(valid: Bool[Array, "b l"]) -> Int[Array, ""]:
    """Return the number of lanes after which all examples of a batch have padding alone.

    One number for all: under `vmap`, a loop with a length for each example selects between whole grids in every round.
    """
    return jnp.where(valid.any(0), jnp.arange(1, valid.shape[1] + 1), 0).max(initial=0)


def lane_cell_loss(
    cells: Float[Array, "h w 5"], lanes: LaneGraph, range_: PerceptionRange, used: int | Int[Array, ""] | None = None
) -> Float[Array, ""]:
    """Return the loss of one example.

    Cross entropy of the occupancy, with equal total weight for cells with and without a lane, plus the mean L1 error of
    offset and direction over cells near a lane. `used` as of `lane_cells`.
    """
    h, w, _ = cells.shape
    true = lane_cells(lanes, (h, w), range_, used)
    entropy = optax.sigmoid_binary_cross_entropy(cells[..., 0], true.inside.astype(cells.dtype))
    error = jnp.abs(cells[..., 1:] - jnp.concatenate([true.offset, true.direction], -1)).sum(-1)
    return 0.5 * (_mean(entropy, true.inside) + _mean(entropy, ~true.inside)) + _mean(error, true.near)


def _mean(values: jax.Array, where: jax.Array) -> jax.Array:
    return jnp.where(where, values, 0.0).sum() / jnp.maximum(where.sum(dtype=values.dtype), 1)
