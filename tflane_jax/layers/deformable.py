"""Multi-scale deformable attention (Deformable DETR), as BEVFormer and TopoNet use it (specs/modules.md section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int


def sample_bilinear(
    value: Float[Array, "hw d"], shape: tuple[int, int], location: Float[Array, "*s 2"]
) -> Float[Array, "*s d"]:
    """Return features at continuous locations, zero outside (each of the four taps by itself).

    Args:
        value: features of an (h, w) grid, row-major.
        shape: (h, w).
        location: (x, y) in [0, 1] across the grid's outer borders; cell centres lie at (i + 0.5) / size.
    """
    flat = location.reshape(-1, 1, 1, 2)
    start = jnp.zeros(flat.shape[0], jnp.int32)
    sampled = _attend(shape, value[:, None], start, flat, jnp.ones(flat.shape[:3], value.dtype))
    return sampled.reshape(*location.shape[:-1], value.shape[-1])


def deformable_attention(
    value: Float[Array, "*v hw heads d"],
    shapes: Sequence[tuple[int, int]],
    locations: Float[Array, "*v q heads levels p 2"],
    weights: Float[Array, "*v q heads levels p"],
) -> Float[Array, "*v q heads*d"]:
    """Return the weighted sum of bilinear samples over levels and points, heads concatenated.

    A location outside the level or NaN gives nothing, and gets no gradient.

    Args:
        value: levels one after the other along the axis HW; with an axis V before it (cameras), the queries of each
            look at their own. On a CPU that is faster than `vmap`.
        shapes: (h, w) of each level.
        locations: (x, y) in [0, 1].
        weights: they need not sum to one.
    """
    *views, queries, heads = weights.shape[:-2]
    channels, count = value.shape[-1], math.prod(views)
    value = value.reshape(count, -1, heads, channels)
    locations, weights = (x.reshape(count * queries, *x.shape[len(views) + 1 :]) for x in (locations, weights))
    total = jnp.zeros((count * queries, heads, channels), value.dtype)
    begin = 0
    for level, (h, w) in enumerate(shapes):
        grid = value[:, begin : begin + h * w].reshape(-1, heads, channels)
        begin += h * w
        start = jnp.repeat(jnp.arange(count, dtype=jnp.int32) * (h * w), queries)
        total = total + _attend((h, w), grid, start, locations[:, :, level], weights[:, :, level])
    return total.reshape(*views, queries, heads * channels)


class _Taps(NamedTuple):
    """The four cells around each location: (q, heads, p, 4), the last axis (left, right) x (upper, lower).

    Attributes:
        row: of the table (cells * heads, d) of a value (cells, heads, d).
        weight: bilinear, zero outside.
        dx, dy: its derivatives by the location.
    """

    row: Int[Array, "q heads p 4"]
    weight: Float[Array, "q heads p 4"]
    dx: Float[Array, "q heads p 4"]
    dy: Float[Array, "q heads p 4"]


def _taps(shape: tuple[int, int], start: Int[Array, " q"], location: Float[Array, "q heads p 2"]) -> _Taps:
    h, w = shape
    heads = location.shape[1]
    size = jnp.array([w, h], location.dtype)[None, None, None]
    pixel = location * size - 0.5
    # False for NaN too. What lies further out touches no cell.
    near = ((pixel > -1.0) & (pixel < size)).all(-1, keepdims=True)
    pixel = jnp.where(near, pixel, 0.0)
    corner = jnp.floor(pixel)
    right, lower = (jnp.array(bit, bool)[None, None, None] for bit in ((0, 1, 0, 1), (0, 0, 1, 1)))
    fraction = pixel - corner
    corner = corner.astype(jnp.int32)
    x, y = corner[..., :1] + right, corner[..., 1:] + lower
    wx = jnp.where(right, fraction[..., :1], 1.0 - fraction[..., :1])
    wy = jnp.where(lower, fraction[..., 1:], 1.0 - fraction[..., 1:])
    inside = near & (x >= 0) & (x < w) & (y >= 0) & (y < h)
    cell = jnp.where(inside, y * w + x, 0) + start[:, None, None, None]
    head = jnp.arange(heads, dtype=jnp.int32)[None, :, None, None]
    return _Taps(
        cell * heads + head,
        jnp.where(inside, wx * wy, 0.0),
        jnp.where(inside, jnp.where(right, wy, -wy), 0.0) * w,
        jnp.where(inside, jnp.where(lower, wx, -wx), 0.0) * h,
    )


def _sum_of_samples(
    shape: tuple[int, int],
    value: Float[Array, "cells heads d"],
    start: Int[Array, " q"],
    location: Float[Array, "q heads p 2"],
    weight: Float[Array, "q heads p"],
) -> Float[Array, "q heads d"]:
    """Return the weighted sum of samples of one level, each query on the (h, w) cells that begin at its `start`.

    One sum with a term per tap, which XLA runs as one loop: samples as an array of their own would take most of the
    time for writing them to memory.
    """
    queries, heads, points = weight.shape
    taps = _taps(shape, start, location)
    rows, factors = lax.optimization_barrier(
        (taps.row.reshape(-1, 4 * points), (taps.weight * weight[..., None]).reshape(-1, 4 * points))
    )
    table = value.reshape(-1, value.shape[-1])
    total = jnp.zeros((queries * heads, value.shape[-1]), factors.dtype)
    for i in range(4 * points):
        total = total + table.at[rows[:, i]].get(mode="promise_in_bounds") * factors[:, i, None]
    return total.astype(value.dtype).reshape(queries, heads, value.shape[-1])


_attend: Any = jax.custom_vjp(_sum_of_samples, nondiff_argnums=(0,))


def _attend_forward(shape, value, start, location, weight):
    return _sum_of_samples(shape, value, start, location, weight), (value, start, location, weight)


# Samples of one step of the backward pass on a CPU: 2 MiB of float32 stay in the cache of a core.
_STEP = 2**19


def _attend_backward(shape, residuals, cotangent):
    """Return the gradients; on a CPU in steps over the queries, each of which fits into the cache."""
    value, start, location, weight = residuals
    queries, heads, points = weight.shape
    samples = queries * heads * 4 * points * value.shape[-1]
    steps = max(1, min(queries, samples // _STEP)) if jax.default_backend() == "cpu" else 1
    missing = -queries % steps

    def split(x):
        x = jnp.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1))  # a weight of zero
        return x.reshape(steps, -1, *x.shape[1:])

    def step(total, part):
        total, by_location, by_weight = _step_backward(shape, value, total, *part)
        return total, (by_location, by_weight)

    total = jnp.zeros((value.shape[0] * heads, value.shape[-1]), cotangent.dtype)
    total, parts = lax.scan(step, total, tuple(map(split, (start, location, weight, cotangent))))
    by_location, by_weight = (x.reshape(-1, *x.shape[2:])[:queries] for x in parts)
    return total.reshape(value.shape).astype(value.dtype), None, by_location, by_weight


def _step_backward(shape, value, total, start, location, weight, cotangent):
    """Add the gradient by the value to `total`; return it and the gradients by location and weight."""
    queries, heads, points = weight.shape
    taps = _taps(shape, start, location)
    rows = taps.row.reshape(-1, 4 * points)
    factors = (taps.weight * weight[..., None]).reshape(-1, 4 * points)
    cotangent = cotangent.reshape(queries * heads, -1)
    table = value.reshape(-1, value.shape[-1])
    # The barrier keeps the product a product of matrices; fused with the gathering it would be a slow loop.
    sampled = lax.optimization_barrier(table.at[rows].get(mode="promise_in_bounds"))
    products = jnp.einsum("nkd,nd->nk", sampled, cotangent).reshape(queries, heads, points, 4)
    total = total.at[rows].add(cotangent[:, None] * factors[..., None], mode="promise_in_bounds")
    by_location = jnp.stack([(products * taps.dx).sum(-1), (products * taps.dy).sum(-1)], -1) * weight[..., None]
    return total, by_location, (products * taps.weight).sum(-1)


_attend.defvjp(_attend_forward, _attend_backward)


def compass_offsets(heads: int, levels: int, points: int) -> np.ndarray:
    """Return Deformable DETR's initial offsets (heads, levels, points, 2): a direction per head, a radius per point."""
    angle = np.arange(heads) * (2.0 * math.pi / heads)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    direction = direction / np.abs(direction).max(-1, keepdims=True)
    radius = np.arange(1, points + 1)
    grid = direction[:, None, None, :] * radius[None, None, :, None]
    return np.broadcast_to(grid, (heads, levels, points, 2)).astype(np.float32)


class DeformableAttention(nn.Module):
    """Deformable attention with its projections.

    Attributes:
        dim: channels in and out.
        heads, points: sampling points per head and level.
        levels: number of value levels.
    """

    dim: int
    heads: int = 8
    points: int = 4
    levels: int = 1

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "q c"],
        value: Float[Array, "hw c"],
        shapes: Sequence[tuple[int, int]],
        reference: Float[Array, "q r *levels d"],
        valid: Bool[Array, " hw"] | None = None,
    ) -> Float[Array, "q c"]:
        """Return the attended features, without residual.

        Args:
            query: content plus position; it decides where to look and how much to take.
            value: features to look at, levels concatenated.
            shapes: (h, w) of each level.
            reference: where to look, in [0, 1]: (Q, R, D) for all levels together, or (Q, R, levels, D). R = 1 for all
                heads together, or R = heads, one point for each (LaneSegNet's heads-to-regions). D = 2 is a point
                (x, y), offsets then count in cells; D = 4 a box (cx, cy, w, h), offsets then count in halves of the
                box, divided by the number of points (Deformable DETR's refined boxes).
            valid: cells that hold something; the others give nothing, whatever stands in them.

        Raises:
            ValueError: a reference of another shape.
        """
        offsets, logits = offsets_and_logits(query, self.heads, self.levels, self.points)
        weights = jax.nn.softmax(logits, (-2, -1))
        # Before the projection too: what stands in padding must not reach the projection's gradient.
        value = nn.Dense(self.dim, name="value_proj")(_masked(value, valid))
        value = _masked(value, valid).reshape(-1, self.heads, self.dim // self.heads)
        locations = sampling_locations(reference, offsets, shapes)
        attended = deformable_attention(value, shapes, locations, weights)
        return nn.Dense(self.dim, name="output_proj")(attended)


def offsets_and_logits(
    query: Float[Array, "q c"], heads: int, levels: int, points: int, dtype: Any = None
) -> tuple[Float[Array, "q heads levels p 2"], Float[Array, "q heads levels p"]]:
    """Return where to look and how much to take, in float32, as layers of the module whose method calls this."""
    bias = compass_offsets(heads, levels, points).reshape(-1)
    offsets = nn.Dense(
        heads * levels * points * 2, kernel_init=nn.initializers.zeros,
        bias_init=lambda *_: jnp.asarray(bias), dtype=dtype, name="sampling_offsets",
    )(query)  # fmt: skip
    logits = nn.Dense(
        heads * levels * points, kernel_init=nn.initializers.zeros, dtype=dtype, name="attention_weights"
    )(query)
    shape = (query.shape[0], heads, levels, points)
    return offsets.reshape(*shape, 2).astype(jnp.float32), logits.reshape(shape).astype(jnp.float32)


def cell_units(shapes: Sequence[tuple[int, int]]) -> Float[Array, "levels 2"]:
    """Return the size of a cell of each level, (x, y), where the level is 1."""
    return jnp.array([(1.0 / w, 1.0 / h) for h, w in shapes], jnp.float32)


def sampling_locations(
    reference: Float[Array, "q r *levels d"],
    offsets: Float[Array, "q heads levels p 2"],
    shapes: Sequence[tuple[int, int]],
) -> Float[Array, "q heads levels p 2"]:
    """Return the locations in [0, 1] that offsets from the references stand for (see `DeformableAttention`).

    Raises:
        ValueError: a reference of another shape.
    """
    heads, levels, points = offsets.shape[1:4]
    if reference.shape[1] not in (1, heads):
        raise ValueError(f"reference needs 1 or {heads} points per query, got {reference.shape[1]}")
    if len(shapes) != levels:
        raise ValueError(f"the attention has {levels} levels, the value {len(shapes)}")
    if reference.ndim == 3:
        reference = reference[:, :, None]
    if reference.ndim != 4 or reference.shape[2] not in (1, levels) or reference.shape[3] not in (2, 4):
        raise ValueError(f"reference must be (q, r, 2 or 4) or (q, r, {levels}, 2 or 4), got {reference.shape}")
    if reference.shape[-1] == 2:
        unit = cell_units(shapes)[None, None, :, None]
    else:
        unit = reference[:, :, :, None, 2:] * (0.5 / points)
    return reference[:, :, :, None, :2] + offsets * unit


def _masked(value: Float[Array, "hw c"], valid: Bool[Array, " hw"] | None) -> Float[Array, "hw c"]:
    return value if valid is None else jnp.where(valid[:, None], value, 0.0)
