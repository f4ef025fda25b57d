"""Masked attention whose empty rows are exactly zero.

Library attention returns the mean of the masked values for a query whose keys are all masked; here such a query gets 0
and contributes no gradient, so that an absent prior equals no prior. Masked keys and values may hold anything.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

Mask = Bool[Array, "#q #k"] | Bool[Array, "#h #q #k"]


def masked_attention(
    query: Float[Array, "h q d"], key: Float[Array, "h k d"], value: Float[Array, "h k e"], mask: Mask | None = None
) -> Float[Array, "h q e"]:
    """Return softmax(query key^T / sqrt(d)) value over the keys that `mask` allows, for one example.

    Args:
        query, key, value: heads first.
        mask: true where a query may attend to a key; None allows all. Rank 2 holds for all heads.
    """
    if key.shape[1] == 0 or query.shape[1] == 0:
        return jnp.zeros((*query.shape[:2], value.shape[-1]), value.dtype)
    if mask is None:
        return _attend(query, key, value, None)
    mask = mask if mask.ndim == 3 else mask[None]
    # A key that no query may see is padding: 0 * NaN would be NaN, in the products here and in their gradients.
    seen = mask.any((0, 1))[None, :, None]
    key, value = jnp.where(seen, key, 0.0), jnp.where(seen, value, 0.0)
    query = jnp.where(mask.any((0, 2))[None, :, None], query, 0.0)
    return _attend(query, key, value, mask)


@jax.custom_vjp
def _attend(query, key, value, mask):
    return _forward(query, key, value, mask)[0]


def attention_probabilities(
    query: Float[Array, "h q d"], key: Float[Array, "h k d"], mask: Mask | None = None
) -> Float[Array, "h q k"]:
    """Return the attention weights in float32; rows sum to 1, or to 0 where every key is masked."""
    scale = 1.0 / math.sqrt(query.shape[-1])
    logits = jnp.einsum("hqd,hkd->hqk", query, key, preferred_element_type=jnp.float32) * scale
    # Without the barriers XLA fuses products and softmax on CPU and recomputes the exponentials.
    logits = lax.optimization_barrier(logits)
    if mask is None:
        weights = jnp.exp(logits - logits.max(-1, keepdims=True))
    else:
        mask = mask if mask.ndim == 3 else mask[None]
        top = jnp.where(mask, logits, -jnp.inf).max(-1, keepdims=True)
        weights = jnp.where(mask, jnp.exp(logits - jnp.where(jnp.isfinite(top), top, 0.0)), 0.0)
    total = weights.sum(-1, keepdims=True)
    return lax.optimization_barrier(weights / jnp.where(total > 0, total, 1.0))


def _forward(query, key, value, mask):
    probabilities = attention_probabilities(query, key, mask).astype(value.dtype)
    out = jnp.einsum("hqk,hke->hqe", probabilities, value)
    return out, (query, key, value, probabilities)


def _backward(residuals, gradient):
    query, key, value, probabilities = residuals
    scale = 1.0 / math.sqrt(query.shape[-1])
    to_value = jnp.einsum("hqk,hqe->hke", probabilities, gradient)
    to_weight = jnp.einsum("hqe,hke->hqk", gradient, value)
    # The gradient of softmax; masked entries have probability 0 and so get none.
    to_logit = probabilities * (to_weight - (probabilities * to_weight).sum(-1, keepdims=True)) * scale
    to_logit = lax.optimization_barrier(to_logit)
    to_query = jnp.einsum("hqk,hkd->hqd", to_logit, key)
    to_key = jnp.einsum("hqk,hqd->hkd", to_logit, query)
    return to_query, to_key, to_value, None


_attend.defvjp(_forward, _backward)


class MultiHeadAttention(nn.Module):
    """Multi-head attention with its projections, for one example.

    Attributes:
        dim: channels out, split over the heads.
        heads: number of heads.
    """

    dim: int
    heads: int

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "q c"],
        key: Float[Array, "k c"],
        value: Float[Array, "k c"],
        mask: Mask | None = None,
    ) -> Float[Array, "q d"]:
        """Return the attended values, without residual; 0 for a query that may see no key."""
        q, k, v = (
            nn.Dense(self.dim, name=name)(x).reshape(x.shape[0], self.heads, self.dim // self.heads).swapaxes(0, 1)
            for name, x in (("query", query), ("key", key), ("value", value))
        )
        attended = masked_attention(q, k, v, mask).swapaxes(0, 1).reshape(query.shape[0], self.dim)
        out = nn.Dense(self.dim, name="output")(attended)
        if key.shape[0] == 0:
            return jnp.zeros_like(out)
        if mask is None:
            return out
        # The output's bias must not stand in for an attention over nothing.
        sees = mask.any((0, 2)) if mask.ndim == 3 else mask.any(1)
        return jnp.where(sees[:, None], out, 0.0)
