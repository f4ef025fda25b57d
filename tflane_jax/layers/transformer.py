"""Transformer encoder and decoder layers of DETR (Carion et al. 2020; specs/modules.md sections 2.4 and 12).

Positions are added to queries and keys, never to values. With positions of zero these are PyTorch's layers.
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.linen as nn
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.attention import Mask, MultiHeadAttention


@dataclass(frozen=True)
class TransformerConfig:
    """Sizes of a layer; the defaults are LSTR's.

    Attributes:
        heads: of every attention.
        hidden: channels inside the feed-forward part.
        dropout: of attention weights, hidden channels and everything that is added to a residual.
        norm_first: normalise the input of every part instead of the sum behind it.
    """

    heads: int = 2
    hidden: int = 128
    dropout: float = 0.1
    norm_first: bool = False


class Residual(nn.Module):
    """x plus what a part of the layer makes of it, normalised before or after.

    Attributes:
        config: sizes.
    """

    config: TransformerConfig

    @nn.compact
    def __call__(self, x, part, *, deterministic: bool):
        """Return the sum; `part` is a function of the (perhaps normalised) features."""
        norm = nn.LayerNorm(epsilon=1e-5, name="norm")
        change = part(norm(x) if self.config.norm_first else x)
        change = nn.Dropout(self.config.dropout, name="dropout")(change, deterministic=deterministic)
        return x + change if self.config.norm_first else norm(x + change)


class FeedForward(nn.Module):
    """Linear, ReLU, linear.

    Attributes:
        config: sizes.
    """

    config: TransformerConfig

    @nn.compact
    def __call__(self, x: Float[Array, "n c"], *, deterministic: bool) -> Float[Array, "n c"]:
        """Return what is added to x."""
        hidden = nn.relu(nn.Dense(self.config.hidden, name="expand")(x))
        hidden = nn.Dropout(self.config.dropout, name="dropout")(hidden, deterministic=deterministic)
        return nn.Dense(x.shape[-1], name="contract")(hidden)


class EncoderLayer(nn.Module):
    """Self-attention and a feed-forward part.

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
    """Self-attention among queries, cross-attention to the memory, and a feed-forward part.

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
        memory_mask: Bool[Array, "#q n"] | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "q c"]:
        """Return the queries after the layer.

        Args:
            x, query_position: queries and what is added to them where they attend.
            memory, memory_position: tokens of the encoder, likewise.
            mask: which query may attend to which query.
            memory_mask: which query may attend to which token; one row serves all.
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
