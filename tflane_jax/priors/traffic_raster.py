"""Traffic flow as a BEV raster: what road users did in each cell. Ours, not in the TF-Lane paper; no parameters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import BevGrid
from tflane_jax.priors.bev_cells import cells_of
from tflane_jax.priors.traffic_flow import SelectedTracks
from tflane_jax.scene import RoadUser

FAR = 10.0
"""A road user that moved this far, metres, or farther counts as moving with weight 1."""

CHANNELS = 7 + len(RoadUser)
"""Per cell: log(1 + frames), recency; means of cos, sin, offset (2), moved, one-hot category."""


@struct.dataclass
class TrafficRaster:
    """Traffic flow by BEV cell, row by row; row 0 and column 0 at the low ends.

    Attributes:
        features: (Q, `CHANNELS`), 0 in cells without traffic: log(1 + frames of all road users in the cell), see
            `between`; recency of the latest of them in (0, 1], 1 for the last frame; means over them of cos and sin of
            the heading, offset (x, y) from the cell center in cells, moved = min(1, distance from first to last valid
            frame / 10 m), one-hot `RoadUser`.
        touched: (Q,) cells with traffic.
    """

    features: Float[Array, "q f"]
    touched: Bool[Array, " q"]


def rasterise_traffic_flow(tracks: SelectedTracks, grid: BevGrid, between: int = 0) -> TrafficRaster:
    """Return the raster of the selected tracks' valid frames; a position outside the grid is left out.

    Args:
        tracks: as selected by the traffic-flow prior.
        grid: the cells.
        between: points interpolated between successive frames that are both valid, so that the path of a fast road
            user has no gaps. A point counts as 1 / (between + 1) frames; so does a frame that no valid one follows,
            because it has no points but its own.
    """
    position, valid = tracks.position[..., :2], tracks.frame_valid
    unit = jnp.where(valid[..., None], grid.range.normalise(position), 0.0)
    heading = jnp.where(valid[..., None], tracks.heading, 0.0)
    moved = jnp.minimum(_distance(unit, valid, grid) / FAR, 1.0)
    category = jax.nn.one_hot(tracks.category, len(RoadUser))

    instances, frames = valid.shape
    step = jnp.arange(between + 1) / (between + 1)
    fraction = step[None, None, :, None]

    def interpolate(x: Float[Array, "t n d"]) -> Float[Array, "t n s d"]:
        following = jnp.concatenate([x[:, 1:], x[:, -1:]], 1)
        return x[:, :, None] * (1.0 - fraction) + following[:, :, None] * fraction

    unit, heading = interpolate(unit), interpolate(heading)
    heading = heading / jnp.maximum(jnp.sqrt((heading**2).sum(-1, keepdims=True)), 1e-6)
    followed = jnp.concatenate([valid[:, 1:], jnp.zeros((instances, 1), bool)], 1)
    present = valid[:, :, None] & (followed[:, :, None] | (step == 0.0)[None, None])
    recency = (jnp.arange(frames, dtype=jnp.float32)[:, None] + step[None] + 1.0) / frames

    cells = grid.rows * grid.columns
    cell, offset = cells_of(unit, present, grid)
    cell = cell.reshape(-1)

    shape = present.shape
    track = jnp.concatenate([moved[:, None], category], -1)
    track = jnp.broadcast_to(track[:, None, None], (*shape, track.shape[-1]))
    values = jnp.concatenate([jnp.ones((*shape, 1)), heading, offset, track], -1)
    total = jnp.zeros((cells, values.shape[-1])).at[cell].add(values.reshape(len(cell), -1), mode="drop")
    latest = jnp.zeros(cells).at[cell].max(jnp.broadcast_to(recency[None], shape).reshape(-1), mode="drop")
    count = total[:, :1]
    means = total[:, 1:] / jnp.maximum(count, 1.0)
    amount = jnp.log1p(count / (between + 1))
    return TrafficRaster(jnp.concatenate([amount, latest[:, None], means], -1), count[:, 0] > 0.0)


def _distance(unit: Float[Array, "t n 2"], valid: Bool[Array, "t n"], grid: BevGrid) -> Float[Array, " t"]:
    """Return how far each instance is in its last valid frame from its first one, metres."""
    first, last = valid.argmax(1), valid.shape[1] - 1 - valid[:, ::-1].argmax(1)
    start, end = (jnp.take_along_axis(unit, index[:, None, None], 1)[:, 0] for index in (first, last))
    return jnp.sqrt((((end - start) * jnp.asarray(grid.range.size(2))[None]) ** 2).sum(-1))
