"""Matching costs of the DETR family: what giving a target to a query would cost (specs/modules.md section 12)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def focal_cost(
    logits: Float[Array, "*b"], alpha: float = 0.25, gamma: float = 2.0, eps: float = 1e-12
) -> Float[Array, "*b"]:
    """Return the focal classification cost of calling each logit a positive, less that of a negative."""
    p = jax.nn.sigmoid(logits)
    positive = -jnp.log(p + eps) * alpha * (1.0 - p) ** gamma
    negative = -jnp.log(1.0 - p + eps) * (1.0 - alpha) * p**gamma
    return positive - negative


def pairwise_l1(prediction: Float[Array, "*b q d"], target: Float[Array, "*#b n d"]) -> Float[Array, "*b q n"]:
    """Return the sum of absolute differences of every prediction to every target."""
    return jnp.abs(prediction[..., :, None, :] - target[..., None, :, :]).sum(-1)
