"""Position encodings."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float


def sine_encoding(coordinates: Float[Array, "*b d"], bands: int, lowest: float = 0.5) -> Float[Array, "*b f"]:
    """Return sines and cosines of normalised coordinates, f = 2 d bands.

    Args:
        coordinates: in [0, 1] across the perception range.
        bands: frequencies per coordinate, each twice the one before.
        lowest: periods of the lowest band across the range.
    """
    frequency = 2.0 * math.pi * lowest * 2.0 ** jnp.arange(bands, dtype=coordinates.dtype)
    angle = coordinates[..., None] * jnp.expand_dims(frequency, tuple(range(coordinates.ndim)))
    angle = angle.reshape(*coordinates.shape[:-1], -1)
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


def inverse_sigmoid(x: Float[Array, "*b"], eps: float = 1e-5) -> Float[Array, "*b"]:
    """Return the logit of x clamped to [0, 1], finite at both ends as in Deformable DETR."""
    x = jnp.clip(x, 0.0, 1.0)
    return jnp.log(jnp.maximum(x, eps) / jnp.maximum(1.0 - x, eps))
