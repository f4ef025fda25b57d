"""Areas of lane segments as masks on the BEV grid, the targets of LaneSegNet's mask head."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import PerceptionRange

# The box that the published raster takes the BEV grid for, metres; the grid covers 102.4 x 51.2.
_PUBLISHED_BOX = (100.0, 50.0)

Raster = Literal["cells", "published"]
"""Which cells belong to a polygon. "cells": those whose center lies inside. "published": those that OpenCV's fillPoly
fills, border included, with vertices truncated to whole cells of a box of 100 m x 50 m in place of the grid's own."""


def segment_masks(
    left: Float[Array, "n p 3"],
    right: Float[Array, "n p 3"],
    shape: tuple[int, int],
    range_: PerceptionRange,
    raster: Raster = "cells",
) -> Bool[Array, "n h w"]:
    """Return which BEV cells lie between two boundaries: in the polygon of the left and the reversed right one.

    Args:
        left, right: boundaries, metres, ego frame.
        shape: (h, w), row 0 at the smallest y, column 0 at the smallest x.
        range_: the box that the grid covers.
        raster: see `Raster`.
    """
    h, w = shape
    ring = jnp.concatenate([left, right[:, ::-1]], 1)[..., :2]
    size = jnp.asarray((w, h), ring.dtype)[None, None]
    if raster == "cells":
        # Cell centers at integers.
        ring = range_.normalise(ring) * size - 0.5
    else:
        ring = jnp.trunc(ring * (size / jnp.asarray(_PUBLISHED_BOX)[None, None]) + size / 2.0)
    start, end = ring, jnp.roll(ring, -1, 1)
    rows, columns = jnp.arange(h, dtype=ring.dtype), jnp.arange(w, dtype=ring.dtype)
    inside = _even_odd(start, end, rows, columns)
    if raster == "cells":
        return inside
    drawn = _drawn(start, end, rows, columns)
    return inside | drawn


def _even_odd(start, end, rows, columns) -> Bool[Array, "n h w"]:
    """Return the cells from which a ray to the left crosses the polygon's edges an odd number of times."""
    (ax, ay), (bx, by) = (jnp.moveaxis(ends, -1, 0)[..., None] for ends in (start, end))  # (n, v, 1)
    y = rows[None, None]
    crosses = (ay > y) != (by > y)  # (n, v, h)
    slope = (bx - ax) / jnp.where(by == ay, 1.0, by - ay)
    x = ax + (y - ay) * slope
    beyond = crosses[..., None] & (x[..., None] < columns[None, None, None])
    return beyond.sum(1) % 2 == 1


def _drawn(start, end, rows, columns) -> Bool[Array, "n h w"]:
    """Return the cells nearest to the edges along their steeper axis, as a line of one cell's width."""
    low, high = jnp.minimum(start, end)[..., None], jnp.maximum(start, end)[..., None]  # (n, v, 2, 1)
    step = (end - start)[..., None]

    def along(axis, across, places, others):
        """Cells at each of `places` along the axis, (n, v, places, others)."""
        place = places[None, None]
        between = (place >= low[:, :, axis]) & (place <= high[:, :, axis])
        slope = step[:, :, across] / jnp.where(step[:, :, axis] == 0.0, 1.0, step[:, :, axis])
        other = start[:, :, across, None] + (place - start[:, :, axis, None]) * slope
        flat = jnp.abs(step[:, :, axis]) >= jnp.abs(step[:, :, across])
        near = jnp.abs(others[None, None, None] - other[..., None]) <= 0.5
        return (between & flat)[..., None] & near

    by_column = along(0, 1, columns, rows).any(1)  # (n, w, h)
    return by_column.swapaxes(1, 2) | along(1, 0, rows, columns).any(1)
