"""Matching costs of the DETR family, for all pairs of query and target (docs/reference/training.md)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def focal_cost(
    logits: Float[Array, "*b"], alpha: float = 0.25, gamma: float = 2.0, eps: float = 1e-12
) -> Float[Array, "*b"]:
    """Return the focal cost of labelling each logit positive, minus the cost of labelling it negative."""
    p = jax.nn.sigmoid(logits)
    positive = -jnp.log(p + eps) * alpha * (1.0 - p) ** gamma
    negative = -jnp.log(1.0 - p + eps) * (1.0 - alpha) * p**gamma
    return positive - negative


def pairwise_l1(prediction: Float[Array, "*b q d"], target: Float[Array, "*#b n d"]) -> Float[Array, "*b q n"]:
    """Return the L1 distance of every prediction to every target."""
    return jnp.abs(prediction[..., :, None, :] - target[..., None, :, :]).sum(-1)


def mask_cost(logits: Float[Array, "q m"], masks: Float[Array, "n m"]) -> Float[Array, "q n"]:
    """Return the mean cross-entropy of every predicted mask with every true one, over M cells."""
    # softplus(x) - x t is the cross-entropy of logit x and target t.
    return (jax.nn.softplus(logits).sum(-1)[:, None] - logits @ masks.T) / logits.shape[-1]


def dice_cost(values: Float[Array, "q m"], masks: Float[Array, "n m"], eps: float = 1.0) -> Float[Array, "q n"]:
    """Return 1 - (2 sum x t + eps) / (sum x + sum t + eps) of every predicted mask x with every true mask t.

    `values` should be probabilities; LaneSegNet passes logits, with which the cost can take any sign and size.
    """
    overlap = 2.0 * values @ masks.T + eps
    return 1.0 - overlap / (values.sum(-1)[:, None] + masks.sum(-1)[None] + eps)


def generalised_iou(a: Float[Array, "*#b 2 2"], b: Float[Array, "*#b 2 2"], eps: float = 1e-6) -> Float[Array, "*b"]:
    """Return the generalised IoU of boxes, -1 to 1 (Rezatofighi et al. 2019): IoU - (hull - union) / hull.

    Args:
        a, b: boxes as lower and upper corners.
        eps: lower limit of the areas of union and hull.
    """
    area = lambda low, high: (high - low)[..., 0] * (high - low)[..., 1]  # noqa: E731
    low, high = jnp.maximum(a[..., 0, :], b[..., 0, :]), jnp.minimum(a[..., 1, :], b[..., 1, :])
    side = jax.nn.relu(high - low)
    overlap = side[..., 0] * side[..., 1]
    union = area(a[..., 0, :], a[..., 1, :]) + area(b[..., 0, :], b[..., 1, :]) - overlap
    union = jnp.maximum(union, eps)
    low, high = jnp.minimum(a[..., 0, :], b[..., 0, :]), jnp.maximum(a[..., 1, :], b[..., 1, :])
    side = jax.nn.relu(high - low)
    hull = jnp.maximum(side[..., 0] * side[..., 1], eps)
    return overlap / union - (hull - union) / hull
