"""Weighted sums of bilinear samples of feature maps: the core of deformable attention (specs/modules.md section 3).

The formulation is the fastest found for XLA on CPUs, forward and backward (docs/benchmarks.md); what it must avoid is
writing all samples to memory, loops over small inner axes, and computing one thing anew for every channel.
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
        location: (x, y) in [0, 1] across the grid's outer borders; cell centres lie at (i + 0.5) / size.
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
    start = jnp.repeat(jnp.arange(count, dtype=jnp.int32) * value.shape[-3], queries)
    locations, weights = (x.reshape(count * queries, *x.shape[len(views) + 1 :]) for x in (locations, weights))
    total = _attend(tuple(shapes), value.reshape(-1, heads, channels), start, locations, weights)
    return total.reshape(*views, queries, heads * channels)


class _Taps(NamedTuple):
    """The cells around the locations of N = queries * heads rows of J = levels * points.

    The four of a location come first: upper left, upper right, lower left, lower right.

    Attributes:
        row: of the table (cells * heads, d) of a value (cells, heads, d).
        factor: bilinear weight times the attention's, zero outside.
        weight: bilinear weight.
        dx, dy: its derivatives by the location.
    """

    row: Int[Array, "*rounds 4 n j"]
    factor: Float[Array, "*rounds 4 n j"]
    weight: Float[Array, "*rounds 4 n j"]
    dx: Float[Array, "*rounds 4 n j"]
    dy: Float[Array, "*rounds 4 n j"]


def _taps(shapes, start, location, weight) -> _Taps:
    """Return the taps of some queries; see `_sum_of_samples` for the arguments."""
    queries, heads, levels, points = weight.shape
    location = location.reshape(1, queries * heads, levels * points, 2)

    def by_level(values):
        return jnp.array(np.repeat(values, points), jnp.int32)[None, None]

    h, w = (by_level([shape[i] for shape in shapes]) for i in (0, 1))
    begin = by_level(np.cumsum([0] + [h * w for h, w in shapes])[:-1])
    width, height = w.astype(location.dtype), h.astype(location.dtype)
    right, lower = (jnp.array(bit, bool)[:, None, None] for bit in ((0, 1, 0, 1), (0, 0, 1, 1)))
    px, py = location[..., 0] * width - 0.5, location[..., 1] * height - 0.5
    # False for NaN too. What lies further out touches no cell.
    near = (px > -1.0) & (px < width) & (py > -1.0) & (py < height)
    px, py = jnp.where(near, px, 0.0), jnp.where(near, py, 0.0)
    left, upper = jnp.floor(px), jnp.floor(py)
    x, y = left.astype(jnp.int32) + right, upper.astype(jnp.int32) + lower
    wx = jnp.where(right, px - left, 1.0 - (px - left))
    wy = jnp.where(lower, py - upper, 1.0 - (py - upper))
    inside = near & (x >= 0) & (x < w) & (y >= 0) & (y < h)
    head = start[:, None] * heads + jnp.arange(heads, dtype=jnp.int32)[None]
    row = jnp.where(inside, begin + y * w + x, 0) * heads + head.reshape(1, -1, 1)
    bilinear = jnp.where(inside, wx * wy, 0.0)
    dx = jnp.where(inside, jnp.where(right, wy, -wy), 0.0) * width
    dy = jnp.where(inside, jnp.where(lower, wx, -wx), 0.0) * height
    arrays = row, bilinear * weight.reshape(1, *location.shape[1:3]), bilinear, dx, dy
    return _Taps(*(jnp.broadcast_to(x, (4, *location.shape[1:3])) for x in arrays))


# XLA computes taps anew for every channel that is gathered. What a loop makes is computed once and written down; two
# rounds are the fewest that it does not unroll.
_ROUNDS = 2
# Samples of one step on a CPU. Backward, the samples are written down, and 512 KiB of float32 stay in the cache of a
# core; forward, only the taps are, and a step should still be worth the work of several cores.
_FORWARD_STEP, _BACKWARD_STEP = 2**22, 2**17


def _in_steps(arrays: Sequence[Array], samples: int, size: int) -> tuple[Array, ...]:
    """Return arrays (Q, ...) as (steps, rounds, Q / steps / rounds, ...), padded with zeros."""
    queries = arrays[0].shape[0]
    steps = max(1, min(queries, samples // size)) if jax.default_backend() == "cpu" else 1
    padded = (jnp.pad(x, [(0, -queries % (steps * _ROUNDS))] + [(0, 0)] * (x.ndim - 1)) for x in arrays)
    return tuple(x.reshape(steps, _ROUNDS, -1, *x.shape[1:]) for x in padded)


def _written_taps(shapes, *part) -> _Taps:
    """Return the taps of a step, whose arrays have an axis of rounds first."""
    return _Taps(*lax.map(lambda one: tuple(_taps(shapes, *one)), part))


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
        total = _sum_of_taps(table, _taps(shapes, *(x.reshape(-1, *x.shape[3:]) for x in parts)))
    else:
        total = lax.map(lambda part: _sum_of_taps(table, _written_taps(shapes, *part)), parts)
    return total.reshape(-1, *value.shape[1:])[: len(start)].astype(value.dtype)


def _sum_of_taps(table: Float[Array, "t d"], taps: _Taps) -> Float[Array, "n d"]:
    """Return the sum with a term per tap: samples as an array of their own would take most of the time to write."""
    total: Any = jnp.zeros((1, 1), taps.factor.dtype)
    for tap, j in np.ndindex(4, taps.row.shape[-1]):
        rows, factors = (x[..., tap, :, j].reshape(-1) for x in (taps.row, taps.factor))
        total = total + table.at[rows].get(mode="promise_in_bounds") * factors[:, None]
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
    total, parts = lax.scan(
        lambda total, part: _step_backward(shapes, table, total, *part), jnp.zeros(table.shape, cotangent.dtype), parts
    )
    by_x, by_y, by_weight = (x.reshape(-1, *weight.shape[1:])[: len(start)] for x in parts)
    return total.reshape(value.shape).astype(value.dtype), None, jnp.stack([by_x, by_y], -1), by_weight


def _step_backward(shapes, table, total, start, location, weight, cotangent):
    """Add the gradient by the value to `total`; return it and the gradients by x, y and weight."""
    taps = _written_taps(shapes, start, location, weight)
    taps = _Taps(*(x.swapaxes(1, 2).reshape(-1, 4 * x.shape[-1]) for x in taps))
    rows, cotangent = len(taps.row), cotangent.reshape(-1, table.shape[1])
    total = total.at[taps.row].add(cotangent[:, None] * taps.factor[..., None], mode="promise_in_bounds")
    sampled = table.at[taps.row].get(mode="promise_in_bounds")
    products = jnp.einsum("nkd,nd->nk", sampled, cotangent)

    def summed(factor):
        # Over the four. Written out: as the reduction of an array it would take half of the time of a step.
        first, second, third, fourth = jnp.split(products * factor, 4, -1)
        return first + second + third + fourth

    weight = weight.reshape(rows, -1)
    return total, (summed(taps.dx) * weight, summed(taps.dy) * weight, summed(taps.weight))


_attend.defvjp(_attend_forward, _attend_backward)
