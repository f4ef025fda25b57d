"""Muon (Jordan et al. 2024): updates of matrices are momentum made orthogonal by Newton-Schulz iterations.

The numbers are those of `optax.contrib.muon`, which iterates over every matrix apart. Here all matrices of one shape,
wide or tall, share one batched iteration: a model has a hundred kernels, but a dozen shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float, Int

from tflane_jax.training.vectors import ROW, Stack, Vectors

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # of X, (X X^T) X and (X X^T)^2 X
_ITERATIONS = 5
_LONG = 2.5  # columns to rows from which the iteration on X X^T is faster
_MOMENTUM = 0.95
_EPS = 1e-8
_RMS = 0.2  # root mean square of an update, about that of Adam's, so that one learning rate fits both


class MuonState(NamedTuple):
    """State of Muon.

    Attributes:
        count: () updates made.
        mu: average of the gradients, like the parameters.
    """

    count: Int[Array, ""]
    mu: Any


def identity(vectors: Vectors) -> Vectors:
    """Return the vectors as they are."""
    return vectors


def scale_by_muon(gather: Callable[[Vectors], Vectors] = identity) -> optax.GradientTransformation:
    """Return Muon with Nesterov momentum for `Vectors`; updates have a root mean square of about 0.2, like Adam's.

    `gather` gathers vectors that several devices share: before matrices are made orthogonal, and after, so that every
    device makes all of them.
    """

    def init(params: Any) -> MuonState:
        return MuonState(jnp.zeros((), jnp.int32), jax.tree.map(jnp.zeros_like, params))

    def update(updates: Any, state: MuonState, params: Any = None) -> tuple[Any, MuonState]:
        count = state.count + 1
        mu = optax.tree.update_moment(updates, state.mu, _MOMENTUM, 1)
        ahead = jax.tree.map(
            lambda average, now: _MOMENTUM * average + (1.0 - _MOMENTUM) * now,
            optax.tree.bias_correction(mu, _MOMENTUM, count + 1),
            optax.tree.bias_correction(updates, _MOMENTUM, count),
        )
        return gather(orthogonal(gather(ahead))), MuonState(count, mu)

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


def orthogonal(updates: Vectors) -> Vectors:
    """Return kernels whose singular values are near 1, times 0.2 sqrt(longer side).

    Five iterations leave singular values between about 0.5 and 1.5; tiny ones stay below.
    """
    by_shape: dict[tuple[int, int], list[tuple[str, Stack]]] = {}
    for group, vector in updates.groups.items():
        if isinstance(vector, optax.MaskedNode):
            continue
        for stack in updates.layout.stacks(group):
            by_shape.setdefault((min(stack.shape), max(stack.shape)), []).append((group, stack))
    parts: dict[str, dict[int, jax.Array]] = {}  # of each group's vector, by their first row
    for shape, stacks in by_shape.items():
        kernels = [_matrices(updates.groups[group], stack) for group, stack in stacks]
        wide = [x if stack.shape == shape else x.mT for x, (_, stack) in zip(kernels, stacks, strict=True)]
        left = _newton_schulz(jnp.concatenate(wide)) * (_RMS * np.sqrt(shape[1]))
        for group, stack in stacks:
            mine, left = left[: stack.count], left[stack.count :]
            rows = (mine if stack.shape == shape else mine.mT).reshape(stack.count, -1)
            rows = jnp.pad(rows, ((0, 0), (0, stack.rows * ROW - rows.shape[1])))
            parts.setdefault(group, {})[stack.row] = rows.reshape(-1)
    for group, by_row in parts.items():
        if tail := updates.layout.tail(group):
            by_row[len(updates.groups[group]) // ROW - tail] = jnp.zeros(tail * ROW)
    return updates.map(
        lambda group, masked: (
            jnp.concatenate([parts[group][row] for row in sorted(parts[group])]) if group in parts else masked
        )
    )


def _matrices(vector: Float[Array, " n"], stack: Stack) -> Float[Array, "matrices inputs outputs"]:
    rows, size = stack.count * stack.rows, stack.shape[0] * stack.shape[1]
    kernels = vector[stack.row * ROW : (stack.row + rows) * ROW].reshape(stack.count, -1)
    return kernels[:, :size].reshape(stack.count, *stack.shape)


def _newton_schulz(x: Float[Array, "matrices rows columns"]) -> Float[Array, "matrices rows columns"]:
    """Return matrices with the same singular vectors and values near 1; rows <= columns.

    An iteration multiplies X by a polynomial P of X X^T. Long matrices (those of convolutions) are multiplied once by
    the product of all P, which needs X X^T alone: P X X^T P is that of the next iteration. It takes half the time, and
    differs by up to 1e-3 of the result for directions whose singular values are below 1e-4 of the largest.

    That holds in float32. In TF32, the default on NVIDIA GPUs, rounding gives X X^T negative eigenvalues, which every
    iteration enlarges: products are those of float32 everywhere.
    """
    with jax.default_matmul_precision("highest"):
        return _iterated(x)


def _iterated(x: Float[Array, "matrices rows columns"]) -> Float[Array, "matrices rows columns"]:
    x = x / (jnp.linalg.norm(x, axis=(1, 2), keepdims=True) + _EPS)
    if x.shape[2] < _LONG * x.shape[1]:
        return lax.fori_loop(0, _ITERATIONS, lambda _, x: _polynomial(x @ x.mT) @ x, x)
    one = jnp.broadcast_to(jnp.eye(x.shape[1]), (len(x), x.shape[1], x.shape[1]))

    def iteration(_: Any, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        gram, product = carry
        p = _polynomial(gram)
        return p @ gram @ p, p @ product

    return lax.fori_loop(0, _ITERATIONS, iteration, (x @ x.mT, one))[1] @ x


def _polynomial(gram: Float[Array, "matrices rows rows"]) -> Float[Array, "matrices rows rows"]:
    a, b, c = _COEFFICIENTS
    return a * jnp.eye(gram.shape[1])[None] + b * gram + c * gram @ gram
