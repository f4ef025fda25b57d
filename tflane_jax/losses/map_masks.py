"""Targets of MapTRv2's auxiliary heads: map lines as masks in BEV and in the images, and depth bins.

MapTRv2 draws its masks with OpenCV: in BEV with OpenCV's thickness 3, which covers five cells, in the images with lines
of one cell of the feature map. Here a cell belongs to a line that passes through it, and BEV masks are dilated by the
disc, five cells across, that OpenCV draws around a point. Lines are taken at their dense points where the labels have
them, 100 on each (the published code draws the original vertices in BEV, 200 points in the images). A line that leaves
the image or passes behind the camera is cut there (the published code joins what remains by a straight line).
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, transform_points
from tflane_jax.geometry.namespace import product
from tflane_jax.scene import CameraViews, MapLines

# Lines are cut at this depth, metres.
_NEAR = 0.1
# Windows (rows, columns) whose union is the disc of radius 2.
_DISC = (3, 3), (5, 1), (1, 5)


def bev_line_mask(lines: MapLines, shape: tuple[int, int], range_: PerceptionRange) -> Bool[Array, "h w"]:
    """Return the BEV cells within two cells of any line, of all classes, of one example.

    Args:
        lines: padding may hold anything.
        shape: (h, w), row 0 at the smallest y, column 0 at the smallest x.
        range_: the box that the grid covers.
    """
    h, w = shape
    size = jnp.asarray((w, h), jnp.float32)[None, None]
    points, pieces = _points(lines)
    points = range_.normalise(points[..., :2]) * size
    drawn = _drawn(points[:, :-1].reshape(-1, 2), points[:, 1:].reshape(-1, 2), pieces, shape)
    windows = (lax.reduce_window(drawn, False, lax.bitwise_or, window, (1, 1), "SAME") for window in _DISC)
    return functools.reduce(jnp.logical_or, windows)


def view_line_masks(lines: MapLines, views: CameraViews, shape: tuple[int, int]) -> Bool[Array, "v h w"]:
    """Return the cells of each camera's feature map through which any line passes, of one example.

    Args:
        lines: ego frame; padding may hold anything.
        views: cameras; those without an image have no lines.
        shape: (h, w) of the feature map, which covers the whole image array.
    """
    (h, w), (height, width) = shape, views.image.shape[1:3]
    points, pieces = _points(lines)
    cells: Any = jnp.diag(jnp.asarray((w / width, h / height, 1.0)))

    def one(intrinsics, camera_from_ego):
        local = product(transform_points(camera_from_ego, points.reshape(-1, 3)), product(cells, intrinsics).T)
        local = local.reshape(points.shape)
        start, end = local[:, :-1].reshape(-1, 3), local[:, 1:].reshape(-1, 3)
        ahead = pieces & (jnp.maximum(start[:, 2], end[:, 2]) > _NEAR)
        start, end = _from_near(start, end), _from_near(end, start)
        start, end = (side[:, :2] / side[:, 2:] for side in (start, end))
        return _drawn(start, end, ahead, shape)

    return jax.vmap(one)(views.intrinsics, views.camera_from_ego) & views.valid[:, None, None]


def depth_targets(
    views: CameraViews, shape: tuple[int, int], *, low: float = 1.0, high: float = 35.0, step: float = 0.5
) -> tuple[Int[Array, "v h w"], Bool[Array, "v h w"]]:
    """Return the depth bin of each cell of the feature maps, and which cells have one, of one example.

    Bins as in MapTRv2: number floor((d - low) / step), from the nearest surface in the cell at depth d. Its code shifts
    the numbers by one and leaves out 0, so that the first bin begins at `low`.

    Args:
        views: cameras with depth.
        shape: (h, w) of the feature map, which covers the whole image array.
        low, high: depths below and from which there is no bin, metres.
        step: size of a bin, metres.

    Raises:
        UserError: the cameras have no depth, or its cells do not fit those of the feature map.
    """
    if views.depth is None or views.depth_valid is None:
        raise UserError("these cameras have no depth: set data.example.cameras.depth_cell (nuScenes: data.depth_cell)")
    (h, w), (rows, columns) = shape, views.depth.shape[1:]
    if rows % h or columns % w or rows // h != columns // w:
        raise UserError(
            f"depth in {rows} x {columns} cells does not fit features of {h} x {w}: set "
            "data.example.cameras.depth_cell (nuScenes: data.depth_cell) to the stride of the features in pixels, or "
            "to a fraction of it"
        )
    factor = rows // h
    depth = jnp.where(views.depth_valid & (views.depth >= low), views.depth, jnp.inf)
    nearest = depth.reshape(-1, h, factor, w, factor).min((2, 4))
    valid = (nearest < high) & views.valid[:, None, None]
    last = round((high - low) / step) - 1  # a depth just below `high` may be rounded up to the bin after it
    number = jnp.minimum(jnp.floor((nearest - low) / step), last)
    return jnp.where(valid, number, 0.0).astype(jnp.int32), valid


def _points(lines: MapLines) -> tuple[Float[Array, "l s 3"], Bool[Array, " k"]]:
    """Return the points to draw, zeros in padding, and which straight pieces of all lines are valid."""
    points = lines.points if lines.dense is None else lines.dense
    valid = jnp.asarray(lines.valid)
    return jnp.where(valid[:, None, None], points, 0.0), jnp.repeat(valid, points.shape[1] - 1)


def _from_near(start: Float[Array, "k 3"], end: Float[Array, "k 3"]) -> Float[Array, "k 3"]:
    """Return the start of each piece, or the point at depth `_NEAR` where the start lies before it."""
    depth, other = start[:, 2], end[:, 2]
    behind = depth < _NEAR
    fraction = jnp.where(behind, (_NEAR - depth) / jnp.where(behind & (other != depth), other - depth, 1.0), 0.0)
    moved = start + jnp.clip(fraction, 0.0, 1.0)[:, None] * (end - start)
    return moved.at[:, 2].max(_NEAR)


def _drawn(
    start: Float[Array, "k 2"], end: Float[Array, "k 2"], valid: Bool[Array, " k"], shape: tuple[int, int]
) -> Bool[Array, "h w"]:
    """Return the cells on straight pieces, in continuous cells from the top-left corner: one at least in each column
    of a flat piece, and in each row of a steep one."""
    h, w = shape
    step = end - start
    # Liang-Barsky: the part of each piece inside the grid.
    enter, leave = jnp.zeros(len(start)), jnp.ones(len(start))
    for axis, size in ((0, float(w)), (1, float(h))):
        low, high = -start[:, axis], size - start[:, axis]
        parallel = step[:, axis] == 0.0
        valid = valid & (~parallel | ((low <= 0.0) & (high >= 0.0)))
        safe = jnp.where(parallel, 1.0, step[:, axis])
        at_low, at_high = low / safe, high / safe
        enter = jnp.maximum(enter, jnp.where(parallel, 0.0, jnp.minimum(at_low, at_high)))
        leave = jnp.minimum(leave, jnp.where(parallel, 1.0, jnp.maximum(at_low, at_high)))
    valid = valid & (enter <= leave)
    first = start + enter[:, None] * step
    inside = (leave - enter)[:, None] * step
    # Steps of whole cells could pass over one by rounding: these are shorter.
    count = jnp.ceil(jnp.abs(inside).max(1)) + 1.0
    number = jnp.arange(max(h, w) + 2, dtype=jnp.float32)[None]
    along = number / count[:, None]
    cells = jnp.floor(first[:, None] + along[..., None] * inside[:, None]).astype(jnp.int32)
    kept = valid[:, None] & (number <= count[:, None])
    # The border itself belongs to the last cell.
    column, row = jnp.clip(cells[..., 0], 0, w - 1), jnp.clip(cells[..., 1], 0, h - 1)
    place = jnp.where(kept, row * w + column, h * w)
    return jnp.zeros(h * w, bool).at[place.ravel()].set(True, mode="drop").reshape(h, w)
