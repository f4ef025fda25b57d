"""Masked attention whose empty rows are exactly zero, and multi-head attention on top of it.

Library attention returns the mean of the masked values for a query whose keys are all masked. Here such a query gets 0
and contributes no gradient, so that an absent prior equals no prior. Masked slots may hold anything, NaN included.
Softmax and its gradient are written out, which decides the speed on CPU (`benchmarks/attention_masks.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

Mask = Bool[Array, "#q #k"] | Bool[Array, "#h #q #k"]
Drop = Callable[[Array], Array] | None
"""Dropout of attention weights, such as `WeightDropout`; None for none."""

# Logits per head that are held at once. Larger problems go through blocks of queries, whose logits are computed again
# for the gradient: at 4,000 x 4,000 on two cores 2.5 times as fast as the libraries, and without their half gigabyte.
BLOCK = 2**19


def masked_attention(
    query: Float[Array, "h q d"],
    key: Float[Array, "h k d"],
    value: Float[Array, "h k e"],
    mask: Mask | None = None,
    drop: Drop = None,
) -> Float[Array, "h q e"]:
    """Return softmax(query key^T / sqrt(d)) value over the keys that `mask` allows, for one example.

    Softmax runs in float32 also for bfloat16 inputs. A key that no query may see, and a query that may see no key, have
    no influence and zero gradients even if they hold NaN; the query's result is 0.

    The gradient is written out (`jax.custom_vjp`), so it exists in reverse mode only: `jax.grad` and `jax.vjp`, not
    `jax.jvp` and `jax.jacfwd`.

    Args:
        query, key, value: heads first.
        mask: true where a query may attend to a key; None allows all. Rank 2 holds for all heads.
        drop: dropout of the weights. All of them (h, q, k) are held then, and masked slots must be finite, unless it is
            a `WeightDropout` and the problem so large that it goes through blocks.

    Raises:
        TypeError: the mask is not bool.
    """
    heads, queries, keys = *query.shape[:2], key.shape[1]
    if queries == 0 or keys == 0:
        return jnp.zeros((heads, queries, value.shape[-1]), value.dtype)
    mask = _per_head(mask)
    whole = queries * keys <= BLOCK
    if drop is not None and (whole or not isinstance(drop, WeightDropout)):
        return jnp.einsum("hqk,hke->hqe", drop(attention_probabilities(query, key, mask).astype(value.dtype)), value)
    if whole:
        return _attend(query, key, value, mask)
    # The last block is filled up with zero queries, whose results are cut off and whose gradients are zero.
    rows = math.ceil(queries / math.ceil(queries * keys / BLOCK))
    filled = jnp.pad(query, ((0, 0), (0, -queries % rows), (0, 0)))
    if mask is not None and mask.shape[1] > 1:
        mask = jnp.pad(mask, ((0, 0), (0, -queries % rows), (0, 0)))
    rate, stream = (0.0, None) if drop is None else (drop.rate, drop.stream())
    out: Array = _attend_in_blocks(rows, rate, filled, key, value, mask, stream)
    return out[:, :queries]


class WeightDropout(nn.Dropout):
    """Dropout of attention weights; each block of queries draws its own, and draws them again for the gradient."""

    def stream(self) -> Array:
        """Return the key of all random numbers of a call."""
        return self.make_rng(self.rng_collection)


def attention_probabilities(
    query: Float[Array, "h q d"], key: Float[Array, "h k d"], mask: Mask | None = None
) -> Float[Array, "h q k"]:
    """Return the attention weights; rows sum to 1, or to 0 where every key is masked.

    In float32 also for bfloat16 inputs. For looking at; not to be differentiated where masked slots hold NaN.
    """
    if key.shape[1] == 0:
        return jnp.zeros((*query.shape[:2], 0), _softmax_dtype(query))
    logits = _logits(query, key, _per_head(mask))
    return jnp.exp(logits - _log_total(logits))


def _per_head(mask: Mask | None) -> Bool[Array, "#h #q #k"] | None:
    _check_dtype(mask)
    return mask[None] if mask is not None and mask.ndim == 2 else mask


def _check_dtype(mask: Mask | None) -> None:
    # An additive mask (0 and -inf), read as true and false, would allow what it forbids.
    if mask is not None and mask.dtype != bool:
        raise TypeError(f"mask is {mask.dtype}: it must be bool, true where a query may attend")


def _softmax_dtype(x):
    return x.dtype if x.dtype.itemsize > 2 else jnp.dtype(jnp.float32)


def _logits(query, key, mask):
    """Return query key^T / sqrt(d) in float32 or finer, -inf where masked."""
    products = jnp.einsum("hqd,hkd->hqk", query, key, preferred_element_type=_softmax_dtype(query))
    # Without the barrier XLA fuses product and softmax on CPU into loops that are several times slower.
    logits = lax.optimization_barrier(products) / math.sqrt(query.shape[-1])
    return logits if mask is None else jnp.where(mask, logits, -jnp.inf)


def _finite_max(logits):
    """Return the row maximum, finite also for a row without keys so that -inf minus it is -inf."""
    return jnp.maximum(logits.max(-1, keepdims=True), jnp.finfo(logits.dtype).min)


def _log_total(logits):
    """Return log sum exp of each row; 0 for a row without keys, so that exp(logits - it) is 0 there."""
    top = lax.stop_gradient(_finite_max(logits))
    total = jnp.exp(logits - top).sum(-1, keepdims=True)
    return jnp.where(total > 0, top + jnp.log(jnp.where(total > 0, total, 1.0)), 0.0)


def _clear_keys(x, mask):
    """Return x with 0 in the slots that no query sees: 0 * NaN would be NaN in the products."""
    return x if mask is None else jnp.where(mask.any(-2)[..., None], x, 0)


def _clear_queries(x, mask):
    """Return x with 0 for the queries that see no key."""
    return x if mask is None else jnp.where(mask.any(-1)[..., None], x, 0)


@jax.custom_vjp
def _attend(query, key, value, mask):
    """Attend with all logits at once, keeping the weights for the gradient."""
    return _attend_forward(query, key, value, mask)[0]


def _attend_forward(query, key, value, mask):
    # Masked keys need no clearing: their logits are replaced.
    value = _clear_keys(value, mask)
    logits = _logits(query, key, mask)
    weights = jnp.exp(logits - _finite_max(logits))
    total = weights.sum(-1, keepdims=True)
    # Dividing the result, not the weights, saves a pass over them.
    inverse = 1.0 / jnp.where(total > 0, total, 1.0)
    weights = weights.astype(value.dtype)
    # The gradient takes a difference with the result: that is kept as float32, also for bfloat16.
    out = jnp.einsum("hqk,hke->hqe", weights, value, preferred_element_type=inverse.dtype) * inverse
    return out.astype(value.dtype), (query, key, value, mask, weights, inverse, out)


def _attend_backward(residuals, gradient):
    query, key, value, mask, weights, inverse, out = residuals
    query, key = _clear_queries(query, mask), _clear_keys(key, mask)
    gradient = (gradient.astype(inverse.dtype) * inverse).astype(value.dtype)
    return *_gradients(query, key, value, weights, out, gradient), None


_attend.defvjp(_attend_forward, _attend_backward)


def _gradients(query, key, value, weights, out, gradient, kept=None):
    """Return the gradients of query, key and value.

    Args:
        query, key, value: 0 for queries that see no key, and in slots that no query sees.
        weights: exp(logits) up to a factor per row.
        out: the result of attention, float32 or finer.
        gradient: of the result, divided by the sum of the row's weights.
        kept: factors of dropout, which `weights` are without; None for 1.
    """
    to_value = jnp.einsum("hqk,hqe->hke", weights if kept is None else weights * kept, gradient)
    dtype = _softmax_dtype(value)
    to_weight = jnp.einsum("hqe,hke->hqk", gradient, value, preferred_element_type=dtype)
    # Softmax: dz = p (dp - sum_k p dp), and sum_k p dp = out . d out.
    along = (gradient.astype(dtype) * out).sum(-1, keepdims=True)
    to_weight = lax.optimization_barrier(to_weight)
    to_weight = to_weight if kept is None else to_weight * kept.astype(dtype)
    to_logit = weights.astype(dtype) * (to_weight - along) / math.sqrt(query.shape[-1])
    to_logit = lax.optimization_barrier(to_logit.astype(query.dtype))
    to_query = jnp.einsum("hqk,hkd->hqd", to_logit, key)
    to_key = jnp.einsum("hqk,hqd->hkd", to_logit, query)
    return to_query.astype(query.dtype), to_key.astype(key.dtype), to_value.astype(value.dtype)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _attend_in_blocks(rows: int, rate: float, query, key, value, mask, stream) -> Array:
    """Attend `rows` queries at a time, a divisor of their number, keeping one number per query for the gradient.

    Weights are dropped with probability `rate`, by random numbers of `stream`; None for no dropout.
    """
    return _in_blocks_forward(rows, rate, query, key, value, mask, stream)[0]


def _in_blocks_forward(rows, rate, query, key, value, mask, stream):
    value = _clear_keys(value, mask)

    def block(inputs):
        query, mask, stream = inputs
        logits = _logits(query, key, mask)
        log_total = _log_total(logits)
        weights = jnp.exp(logits - log_total).astype(value.dtype)
        weights = weights if stream is None else weights * _kept(weights, rate, stream)
        return jnp.einsum("hqk,hke->hqe", weights, value, preferred_element_type=log_total.dtype), log_total

    masks, streams = _split_mask(mask, query.shape[1], rows), _split_stream(stream, query.shape[1] // rows)
    out, log_total = lax.map(block, (_split(query, rows), masks, streams))
    return _join(out).astype(value.dtype), (query, key, value, mask, stream, out, log_total)


def _in_blocks_backward(rows, rate, residuals, gradient):
    query, key, value, mask, stream, out, log_total = residuals
    query, key = _clear_queries(query, mask), _clear_keys(key, mask)

    def block(sums, inputs):
        query, mask, stream, out, log_total, gradient = inputs
        weights = jnp.exp(_logits(query, key, mask) - log_total)
        weights = lax.optimization_barrier(weights.astype(value.dtype))
        kept = None if stream is None else _kept(weights, rate, stream)
        to_query, *to_others = _gradients(query, key, value, weights, out, gradient, kept)
        return [total + part.astype(total.dtype) for total, part in zip(sums, to_others, strict=True)], to_query

    masks, streams = _split_mask(mask, query.shape[1], rows), _split_stream(stream, query.shape[1] // rows)
    inputs = (_split(query, rows), masks, streams, out, log_total, _split(gradient, rows))
    # Many blocks add up: their sums are float32 also for bfloat16.
    start = [jnp.zeros(each.shape, _softmax_dtype(each)) for each in (key, value)]
    (to_key, to_value), to_query = lax.scan(block, start, inputs)
    return _join(to_query), to_key.astype(key.dtype), to_value.astype(value.dtype), None, None


_attend_in_blocks.defvjp(_in_blocks_forward, _in_blocks_backward)


def _split(x: Float[Array, "h q d"], rows: int) -> Float[Array, "n h rows d"]:
    return x.reshape(x.shape[0], -1, rows, x.shape[-1]).swapaxes(0, 1)


def _join(x: Float[Array, "n h rows d"]) -> Float[Array, "h q d"]:
    return x.swapaxes(0, 1).reshape(x.shape[1], -1, x.shape[-1])


def _split_mask(mask, queries, rows):
    """Split a mask along its queries; one that all queries share is repeated."""
    if mask is None or mask.shape[1] == queries:
        return None if mask is None else _split(mask, rows)
    return jnp.broadcast_to(mask, (queries // rows, *mask.shape))


def _split_stream(stream, blocks):
    return None if stream is None else jax.random.split(stream, blocks)


def _kept(weights, rate, stream):
    """Return the factors of dropout: 0, or what keeps the expectation."""
    return jax.random.bernoulli(stream, 1.0 - rate, weights.shape).astype(weights.dtype) / (1.0 - rate)


class MultiHeadAttention(nn.Module):
    """Multi-head attention with its projections, for one example.

    Attributes:
        dim: channels that are split over the heads.
        heads: number of heads.
        dropout: probability with which training drops an attention weight.
        out: channels out, None for `dim`.
        zero_init: initialise the output projection with 0, to add the attention to a model trained without it.
    """

    dim: int
    heads: int
    dropout: float = 0.0
    out: int | None = None
    zero_init: bool = False

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "q cq"],
        key: Float[Array, "k ck"],
        value: Float[Array, "k cv"],
        mask: Mask | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "q d"]:
        """Return the attended values, without residual; 0 for a query that may see no key.

        Stores the attention weights as the intermediate `probabilities` (heads, q, k) where a caller asks for it:
        `module.apply(variables, ..., mutable="intermediates")`. Raises TypeError for a mask that is not bool.
        """
        if self.dim % self.heads:
            raise ValueError(f"dim {self.dim} does not split over {self.heads} heads")
        _check_dtype(mask)
        if mask is not None:
            pairs = mask.any(0) if mask.ndim == 3 else mask
            seen, sees = pairs.any(0)[:, None], pairs.any(1)[:, None]
            # Cleared here too, not only in `masked_attention`: the gradients of the projections would be 0 * NaN.
            query, key, value = jnp.where(sees, query, 0), jnp.where(seen, key, 0), jnp.where(seen, value, 0)
        q, k, v = (
            nn.Dense(self.dim, name=name)(x).reshape(x.shape[0], self.heads, self.dim // self.heads).swapaxes(0, 1)
            for name, x in (("query", query), ("key", key), ("value", value))
        )
        if self.is_mutable_collection("intermediates"):
            self.sow("intermediates", "probabilities", attention_probabilities(q, k, mask))
        drops = self.dropout > 0 and not deterministic
        drop = WeightDropout(self.dropout, deterministic=False, name="dropout") if drops else None
        heads = masked_attention(q, k, v, mask, drop)
        attended = heads.swapaxes(0, 1).reshape(query.shape[0], self.dim)
        init = nn.initializers.zeros if self.zero_init else nn.linear.default_kernel_init
        out = nn.Dense(self.out or self.dim, kernel_init=init, name="output")(attended)
        # The output's bias must not stand in for an attention over nothing.
        if key.shape[0] == 0:
            return jnp.zeros_like(out)
        return out if mask is None else jnp.where(sees, out, 0)
