"""Muon (Jordan et al. 2024): updates of matrices are momentum made orthogonal by Newton-Schulz iterations.

The numbers are those of `optax.contrib.muon`, which iterates over every matrix apart. Here all matrices of one shape,
wide or tall, share one batched iteration: a model has a hundred kernels, but a dozen shapes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # of X, (X X^T) X and (X X^T)^2 X
_ITERATIONS = 5
_MOMENTUM = 0.95
_EPS = 1e-8
_RMS = 0.2  # root mean square of an update, about that of Adam's, so that one learning rate fits both


class MuonState(NamedTuple):
    """State of Muon.

    Attributes:
        count: () updates made.
        mu: average of the gradients, a tree like the parameters.
    """

    count: Int[Array, ""]
    mu: Any


def scale_by_muon() -> optax.GradientTransformation:
    """Return Muon with Nesterov momentum; an update has a root mean square of about 0.2, like Adam's.

    Kernels of more than two axes, such as those of convolutions, are matrices of all inputs (kh kw cin) x outputs.
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
        return orthogonal(ahead), MuonState(count, mu)

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


def orthogonal(updates: Any) -> Any:
    """Return a tree of matrices with all singular values near 1, times 0.2 sqrt(longer side).

    Five iterations leave singular values between about 0.5 and 1.5; those of tiny ones stay below.
    """
    leaves, tree = jax.tree.flatten(updates)
    by_shape: dict[tuple[int, int], list[int]] = {}
    for i, leaf in enumerate(leaves):
        rows, columns = _sides(leaf.shape)
        by_shape.setdefault((min(rows, columns), max(rows, columns)), []).append(i)
    for shape, members in by_shape.items():
        wide = [leaves[i].reshape(_sides(leaves[i].shape)) for i in members]
        wide = jnp.stack([matrix if matrix.shape == shape else matrix.T for matrix in wide])
        for i, matrix in zip(members, _newton_schulz(wide) * (_RMS * np.sqrt(shape[1])), strict=True):
            rows, columns = _sides(leaves[i].shape)
            leaves[i] = (matrix if (rows, columns) == shape else matrix.T).reshape(leaves[i].shape)
    return jax.tree.unflatten(tree, leaves)


def _sides(shape: tuple[int, ...]) -> tuple[int, int]:
    return int(np.prod(shape[:-1])), shape[-1]


def _newton_schulz(x: Float[Array, "matrices rows columns"]) -> Float[Array, "matrices rows columns"]:
    """Return matrices with the same singular vectors and values near 1; rows <= columns."""
    a, b, c = _COEFFICIENTS
    x = x / (jnp.linalg.norm(x, axis=(1, 2), keepdims=True) + _EPS)

    def iteration(_: Any, x: jax.Array) -> jax.Array:
        gram = x @ x.mT
        return a * x + (b * gram + c * gram @ gram) @ x

    return jax.lax.fori_loop(0, _ITERATIONS, iteration, x)
