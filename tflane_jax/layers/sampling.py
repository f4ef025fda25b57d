"""Weighted sums of bilinear samples of feature maps: the core of deformable attention (Zhu et al. 2021).

The formulation is the fastest found for XLA on CPUs, forward and backward (docs/benchmarks.md). It avoids writing all
samples to memory, loops over small inner axes, and repeating the same computation for every channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int


def sample_bilinear(
    value: Float[Array, "hw d"], shape: tuple[int, int], location: Float[Array, "*s 2"]
) -> Float[Array, "*s d"]:
    """Return features at continuous locations, zero outside (each of the four taps by itself).

    Args:
        value: features of an (h, w) grid, row-major.
        shape: (h, w).
        location: (x, y) in [0, 1] across the grid's outer borders; cell centers lie at (i + 0.5) / size.
    """
    flat = location.reshape(-1, 1, 1, 1, 2)
    start = jnp.zeros(flat.shape[0], jnp.int32)
    sampled = _attend((shape,), value[:, None], start, flat, jnp.ones(flat.shape[:4], value.dtype))
    return sampled.reshape(*location.shape[:-1], value.shape[-1])


def deformable_attention(
    value: Float[Array, "*v hw heads d"],
    shapes: Sequence[tuple[int, int]],
    locations: Float[Array, "*v q heads levels p 2"],
    weights: Float[Array, "*v q heads levels p"],
) -> Float[Array, "*v q heads*d"]:
    """Return the weighted sum of bilinear samples over levels and points, heads concatenated.

    A location outside the level, or NaN, contributes 0 and gets no gradient.

    Args:
        value: levels concatenated along the axis HW; with a leading axis V (cameras), each has its own queries. On a
            CPU that is faster than `vmap`.
        shapes: (h, w) of each level.
        locations: (x, y) in [0, 1].
        weights: they need not sum to one.
    """
    *views, queries, heads = weights.shape[:-2]
    channels, count = value.shape[-1], math.prod(views)
    start = jnp.repeat(jnp.arange(count, dtype=jnp.int32) * value.shape[-3], queries)
    locations, weights = (x.reshape(count * queries, *x.shape[len(views) + 1 :]) for x in (locations, weights))
    total = _attend(tuple(shapes), value.reshape(-1, heads, channels), start, locations, weights)
    return total.reshape(*views, queries, heads * channels)


class _Corners(NamedTuple):
    """The two by two cells that a bilinear sample reads, of N = queries * heads rows of J = levels * points.

    All four lie in the map: where a location has some of its cells outside, the four next to them stand in, and
    weights that fall off to zero within one cell (`_hat`) leave out what the sample does not touch.

    Attributes:
        row: of the upper left one, in the table (cells * heads, d) of a value (cells, heads, d).
        x, y: from its center to the location, in cells, in [-1, 2).
    """

    row: Int[Array, "*rounds n j"]
    x: Float[Array, "*rounds n j"]
    y: Float[Array, "*rounds n j"]


def _corners(shapes, start, location, weight) -> _Corners:
    """Return the cells of some queries; see `_sum_of_samples` for the arguments."""
    queries, heads, levels, points = weight.shape
    location = location.reshape(queries * heads, levels * points, 2)
    height, width = (_by_sample([shape[i] for shape in shapes], points) for i in (0, 1))
    begin = _by_sample(np.cumsum([0] + [h * w for h, w in shapes])[:-1], points)

    def along(axis, size):
        real = size.astype(location.dtype)
        position = location[..., axis] * real - 0.5
        # False for NaN too. At -1 a location touches nothing.
        position = jnp.where((position > -1.0) & (position < real), position, -1.0)
        first = jnp.clip(jnp.floor(position), 0.0, jnp.maximum(real - 2.0, 0.0))
        return first.astype(jnp.int32), position - first

    (column, x), (line, y) = along(0, width), along(1, height)
    head = start[:, None] * heads + jnp.arange(heads, dtype=jnp.int32)[None]
    return _Corners((begin + line * width + column) * heads + head.reshape(-1, 1), x, y)


def _by_sample(values, points) -> Int[Array, "1 j"]:
    """Return a number of each level for each of its points."""
    return jnp.array(np.repeat(values, points), jnp.int32)[None]


def _hat(offset, several):
    """Return the weights of the first and the second cell; `several`: false where an axis has but one cell."""
    first, second = (jnp.maximum(1.0 - jnp.abs(offset - place), 0.0) for place in (0.0, 1.0))
    return first, jnp.where(several, second, 0.0)


def _slope(offset, several):
    """Return the derivatives of `_hat`; at a kink, that to the right, but 0 at -1, which marks a location outside.

    Many first samples lie at a kink: locations at cell centers, with offsets of whole cells.
    """
    first = jnp.where(jnp.abs(offset) < 1.0, jnp.where(offset < 0.0, 1.0, -1.0), 0.0)
    second = jnp.where((offset >= 0.0) & (offset < 2.0), jnp.where(offset < 1.0, 1.0, -1.0), 0.0)
    return first, jnp.where(several, second, 0.0)


def _neighbours(shapes, heads, points) -> tuple[np.ndarray, np.ndarray]:
    """Return for each sample (J,) the offsets, in rows of the table, to the cell on its right and to that below."""
    right, lower = ([heads * (w > 1) for _, w in shapes], [heads * w * (h > 1) for h, w in shapes])
    return np.repeat(right, points), np.repeat(lower, points)


# XLA computes weights anew for every channel that they multiply. What a loop makes is computed once and written down;
# two rounds are the fewest that it does not unroll.
_ROUNDS = 2
# Samples of one step on a CPU. Backward, the samples are written down, and should stay in a cache; forward, only the
# weights are, and a step should still be worth the work of several cores.
_FORWARD_STEP, _BACKWARD_STEP = 2**20, 2**18


def _in_steps(arrays: Sequence[Array], samples: int, size: int) -> tuple[Array, ...]:
    """Return arrays (Q, ...) as (steps, rounds, Q / steps / rounds, ...), padded with zeros."""
    queries = arrays[0].shape[0]
    steps = max(1, min(queries, samples // size)) if jax.default_backend() == "cpu" else 1
    padded = (jnp.pad(x, [(0, -queries % (steps * _ROUNDS))] + [(0, 0)] * (x.ndim - 1)) for x in arrays)
    return tuple(x.reshape(steps, _ROUNDS, -1, *x.shape[1:]) for x in padded)


def _sum_of_samples(
    shapes: tuple[tuple[int, int], ...],
    value: Float[Array, "cells heads d"],
    start: Int[Array, " q"],
    location: Float[Array, "q heads levels p 2"],
    weight: Float[Array, "q heads levels p"],
) -> Float[Array, "q heads d"]:
    """Return the weighted sum of samples, each query on the levels that begin at cell `start`."""
    if not weight.size:
        return jnp.zeros((*weight.shape[:2], value.shape[-1]), value.dtype)
    table = value.reshape(-1, value.shape[-1])
    parts = _in_steps((start, location, weight), weight.size * 4 * table.shape[1], _FORWARD_STEP)
    if len(parts[0]) == 1:  # too little to be worth a loop
        total = _sum_of_step(shapes, table, *(x.reshape(1, -1, *x.shape[3:]) for x in parts))
    else:
        total = lax.map(lambda part: _sum_of_step(shapes, table, *part), parts)
    return total.reshape(-1, *value.shape[1:])[: len(start)].astype(value.dtype)


def _sum_of_step(shapes, table, start, location, weight) -> Float[Array, "n d"]:
    """Return the sums of a step, whose arrays have an axis of rounds first, with a term for each cell of each sample.

    Samples as an array of their own would take most of the time to write.
    """
    heads, points = weight.shape[2], weight.shape[4]
    right, lower = _neighbours(shapes, heads, points)

    def written(part):
        corners, weight = _corners(shapes, *part), part[2].reshape(-1, len(right))
        down = (y * weight for y in _hat(corners.y, lower[None] > 0))
        return corners.row, *_hat(corners.x, right[None] > 0), *down

    parts = start, location, weight
    arrays = lax.map(written, parts) if len(start) > 1 else [x[None] for x in written([x[0] for x in parts])]
    total: Any = jnp.zeros((1, 1), weight.dtype)
    for j in range(len(right)):
        row, left_x, right_x, upper_y, lower_y = (x[..., j].reshape(-1) for x in arrays)
        for along, x in ((0, left_x), (right[j], right_x)):
            for down, y in ((0, upper_y), (lower[j], lower_y)):
                cells = table.at[row + (along + down)].get(mode="promise_in_bounds")
                total = total + cells * (x * y)[:, None]
    return total


_attend: Any = jax.custom_vjp(_sum_of_samples, nondiff_argnums=(0,))


def _attend_forward(shapes, value, start, location, weight):
    return _sum_of_samples(shapes, value, start, location, weight), (value, start, location, weight)


def _attend_backward(shapes, residuals, cotangent):
    value, start, location, weight = residuals
    if not weight.size:
        return jnp.zeros_like(value), None, location, weight
    table = value.reshape(-1, value.shape[-1])
    parts = _in_steps((start, location, weight, cotangent), weight.size * 4 * table.shape[1], _BACKWARD_STEP)
    # Many samples add to one cell: their sum is float32 also for bfloat16.
    start_of_sum = jnp.zeros(table.shape, jnp.promote_types(cotangent.dtype, jnp.float32))
    total, parts = lax.scan(lambda total, part: _step_backward(shapes, table, total, *part), start_of_sum, parts)
    by_x, by_y, by_weight = (x.reshape(-1, *weight.shape[1:])[: len(start)] for x in parts)
    by_location = jnp.stack([by_x, by_y], -1).astype(location.dtype)
    return total.reshape(value.shape).astype(value.dtype), None, by_location, by_weight.astype(weight.dtype)


def _step_backward(shapes, table, total, start, location, weight, cotangent):
    """Add the gradient by the value to `total`; return it and the gradients by x, y and weight."""
    heads, points = weight.shape[2], weight.shape[4]
    right, lower = (x[None] for x in _neighbours(shapes, heads, points))
    parts = start, location, weight
    corners = _Corners(*lax.map(lambda part: tuple(_corners(shapes, *part)), parts))
    row, x, y = (array.reshape(-1, right.size) for array in corners)
    weight, cotangent = weight.reshape(row.shape), cotangent.reshape(len(row), table.shape[1])
    across, down = _hat(x, right > 0), _hat(y, lower > 0)
    # Upper left, upper right, lower left, lower right.
    rows = jnp.stack([row + below + beside for below in (0, lower) for beside in (0, right)], 1).reshape(len(row), -1)
    factors = jnp.stack([b * a * weight for b in down for a in across], 1).reshape(rows.shape)
    total = total.at[rows].add(cotangent[:, None] * factors[..., None], mode="promise_in_bounds")
    sampled = table.at[rows].get(mode="promise_in_bounds")
    # Slopes are differences of these between neighbouring cells.
    products = jnp.einsum("nkd,nd->nk", sampled, cotangent, preferred_element_type=total.dtype).reshape(len(row), 4, -1)

    def summed(across, down):
        # Over the four. Written out: as the reduction of an array it would take half of the time of a step.
        upper, lower = (across[0] * products[:, 2 * i] + across[1] * products[:, 2 * i + 1] for i in (0, 1))
        return down[0] * upper + down[1] * lower

    height, width = (_by_sample([shape[i] for shape in shapes], points).astype(weight.dtype) for i in (0, 1))
    by_x = summed(_slope(x, right > 0), down) * width * weight
    by_y = summed(across, _slope(y, lower > 0)) * height * weight
    return total, (by_x, by_y, summed(across, down))


_attend.defvjp(_attend_forward, _attend_backward)
# Layers of the same shapes share one trace of these long sums, which is a third of tracing a model of the paper's size.
_attend = jax.jit(_attend, static_argnums=0)
