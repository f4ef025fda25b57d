"""Fusion of a prior's tokens into BEV features by one residual cross-attention: markers and SD map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.precision import Precision
from tflane_jax.limits import Count, Positive, Rules, splits
from tflane_jax.models.prior import HostSpec


@dataclass(frozen=True)
class TokenFusionConfig:
    """Settings of the fusion, and of the computation of a prior that is fused in this way.

    Attributes:
        heads: of the attention to the tokens.
        width: channels of that attention; None: those of the BEV features.
        norm: position of the LayerNorm. "sum": around the sum, F' = LayerNorm(F + Attn(F, M, M)). "query": on the
            attention's queries, F' = F + Attn(LayerNorm(F), M, M), with a zero-initialised output, so that training can
            continue from a host without the prior. "written": see `MarkerFusionConfig`.
        radius: a BEV cell attends only to lines that pass within this many metres; None: to all lines. The cell must
            then learn from the tokens which lines are near, which takes small models too long.
        precision: dtype of linear layers, see `layers.precision`; parameters, tokens and results are float32.
        remat: recompute the activations of each layer and of each fusion for the gradient instead of keeping them.
    """

    heads: Count = 4
    width: Count | None = None
    norm: Literal["written", "sum", "query"] = "sum"
    radius: Positive | None = None
    precision: Precision = "float32"
    remat: bool = False

    def limits(self) -> Rules:
        """Channels of the attention split over heads."""
        if self.width is not None:
            yield splits("heads", self.heads, "width", self.width)

    def host_limits(self, host: HostSpec) -> Rules:
        """Without a width, the channels of the BEV features split over heads."""
        if self.width is None and host.bev_dim is not None:
            yield splits("heads", self.heads, "the channels of BEV features", host.bev_dim)


def attend_to_tokens(
    config: TokenFusionConfig,
    bev: Float[Array, "q c"],
    position: Float[Array, "q c"] | None,
    tokens: Float[Array, "n d"],
    mask: Bool[Array, "#q n"],
    change: Callable[[Float[Array, "q c"]], Float[Array, "q c"]] = lambda found: found,
) -> Float[Array, "q c"]:
    """Return the BEV features with the tokens fused in; part of a compact module, adds `norm` and `attention`.

    Args:
        config: settings; norm "written" is "sum" here.
        bev, position: features of the cells and their position encoding, which is added to queries; None: not added.
        tokens: of the prior.
        mask: which cell may attend to which token.
        change: applied to what the attention found, before it is added.
    """
    channels, before = bev.shape[-1], config.norm == "query"
    norm = nn.LayerNorm(epsilon=1e-5, name="norm")
    attention = MultiHeadAttention(
        config.width or channels, config.heads, out=channels, zero_init=before, name="attention"
    )
    query = norm(bev) if before else bev
    fused = bev + change(attention(query if position is None else query + position, tokens, tokens, mask))
    return fused if before else norm(fused)
