"""Transformer encoder and decoder layers of DETR (Carion et al. 2020).

Positions are added to queries and keys, never to values. With positions of zero these are PyTorch's
`TransformerEncoderLayer` and `TransformerDecoderLayer`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import flax.linen as nn
from jaxtyping import Array, Float

from tflane_jax.layers.attention import Mask, MultiHeadAttention
from tflane_jax.limits import Count, FractionBelowOne


@dataclass(frozen=True)
class TransformerConfig:
    """Sizes of a layer; the defaults are LSTR's.

    Attributes:
        heads: heads of every attention.
        hidden: hidden channels of the feed-forward network.
        dropout: probability for attention weights, hidden channels and each residual branch.
        norm_first: pre-norm (normalise the input of each residual branch) instead of post-norm (normalise the sum).
        activation: of the hidden channels; "gelu" is the exact one, with the error function, as in PyTorch.

    Both are options of PyTorch's layers and of DETR's and LSTR's code, for weights trained with them; the defaults are
    those of every published system here.
    """

    heads: Count = 2
    hidden: Count = 128
    dropout: FractionBelowOne = 0.1
    norm_first: bool = False
    activation: Literal["relu", "gelu"] = "relu"


_ACTIVATIONS = {"relu": nn.relu, "gelu": partial(nn.gelu, approximate=False)}


class Residual(nn.Module):
    """Residual connection, pre- or post-norm.

    Attributes:
        config: sizes.
    """

    config: TransformerConfig

    @nn.compact
    def __call__(self, x, part, *, deterministic: bool):
        """Return x + part(x); `part` maps the features, normalised first where the layer is pre-norm, to a change."""
        norm = nn.LayerNorm(epsilon=1e-5, name="norm")
        change = part(norm(x) if self.config.norm_first else x)
        change = nn.Dropout(self.config.dropout, name="dropout")(change, deterministic=deterministic)
        return x + change if self.config.norm_first else norm(x + change)


def add_and_norm(
    name: str, x: Float[Array, "*b c"], change: Float[Array, "*b c"], *, dropout: float, deterministic: bool
) -> Float[Array, "*b c"]:
    """Return the norm of a residual sum, from within a compact method of the layer that owns its parameters.

    The dropout is called `<name>_dropout` and the norm `<name>_norm`, as published detectors have them: side by side
    with their attentions, where `Residual` has a module around each. A change in bfloat16 is added to a float32 x.
    """
    change = nn.Dropout(dropout, name=f"{name}_dropout")(change, deterministic=deterministic)
    return nn.LayerNorm(epsilon=1e-5, name=f"{name}_norm")(x + change)


class FeedForward(nn.Module):
    """Linear layer, activation, linear layer.

    Attributes:
        config: sizes.
    """

    config: TransformerConfig

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"], *, deterministic: bool) -> Float[Array, "*b c"]:
        """Return the change of x, without the residual."""
        hidden = _ACTIVATIONS[self.config.activation](nn.Dense(self.config.hidden, name="expand")(x))
        hidden = nn.Dropout(self.config.dropout, name="dropout")(hidden, deterministic=deterministic)
        return nn.Dense(x.shape[-1], name="contract")(hidden)


class EncoderLayer(nn.Module):
    """Self-attention, then a feed-forward network.

    Attributes:
        config: sizes.
    """

    config: TransformerConfig

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "n c"],
        position: Float[Array, "n c"],
        mask: Mask | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "n c"]:
        """Return the features after the layer; `mask` says which token may attend to which."""
        config = self.config
        attention = MultiHeadAttention(x.shape[-1], config.heads, config.dropout, name="self_attention")
        feed_forward = FeedForward(config, name="feed_forward")

        def attend(x):
            return attention(x + position, x + position, x, mask, deterministic=deterministic)

        x = Residual(config, name="attended")(x, attend, deterministic=deterministic)
        return Residual(config, name="fed")(
            x, lambda x: feed_forward(x, deterministic=deterministic), deterministic=deterministic
        )


class DecoderLayer(nn.Module):
    """Self-attention among queries, cross-attention to the memory, then a feed-forward network.

    Attributes:
        config: sizes.
    """

    config: TransformerConfig

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "q c"],
        memory: Float[Array, "n c"],
        query_position: Float[Array, "q c"],
        memory_position: Float[Array, "n c"],
        mask: Mask | None = None,
        memory_mask: Mask | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "q c"]:
        """Return the queries after the layer.

        Args:
            x, query_position: queries, and position encodings added to them in both attentions.
            memory, memory_position: output of the encoder, and position encodings added to its keys.
            mask: which query may attend to which query.
            memory_mask: which query may attend to which token; a single row holds for all queries.
            deterministic: no dropout.
        """
        config = self.config
        self_attention, cross_attention = (
            MultiHeadAttention(x.shape[-1], config.heads, config.dropout, name=name)
            for name in ("self_attention", "cross_attention")
        )
        feed_forward = FeedForward(config, name="feed_forward")

        def among_queries(x):
            return self_attention(x + query_position, x + query_position, x, mask, deterministic=deterministic)

        def to_memory(x):
            keys = memory + memory_position
            return cross_attention(x + query_position, keys, memory, memory_mask, deterministic=deterministic)

        x = Residual(config, name="attended")(x, among_queries, deterministic=deterministic)
        x = Residual(config, name="crossed")(x, to_memory, deterministic=deterministic)
        return Residual(config, name="fed")(
            x, lambda x: feed_forward(x, deterministic=deterministic), deterministic=deterministic
        )
