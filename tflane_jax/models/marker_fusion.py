"""Confidence-gated marker fusion (Wu and Hu): from the lanes that markers name to guided BEV features.

Lanes of a frame's markers -> memory (`priors.marker_memory`) -> one token for each lane (III-A) -> in every layer of
the BEV encoder, behind the cameras, attention of the BEV features to the tokens, gated by the confidence (III-B).

A frame without guidance leaves the BEV features exactly as they are, so that a model that never sees a marker is the
model without markers; Eq. (3) alone would normalise them once more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.masks import key_mask, radius_mask
from tflane_jax.layers.polyline_encoder import MARKER_POLYLINES, PolylineEncoder, PolylineEncoderConfig
from tflane_jax.models.prior import BevCells, HostSpec, Prior
from tflane_jax.priors.marker_memory import (
    MarkerGuidance,
    MarkerMemory,
    MarkerMemoryConfig,
    guidance,
    remember,
)
from tflane_jax.priors.markers import MarkerPriorConfig, select_marker_lanes
from tflane_jax.scene import Example, MarkerObservations


@dataclass(frozen=True)
class MarkerFusionConfig:
    """The module; the defaults are the paper's, `SMALL_MARKER_FUSION` trains on two CPU cores.

    Attributes:
        prior: confidence and polylines.
        memory: temporal memory, None for the ablation without (Table III).
        encoding: of a polyline (Table IV): "sine" is the transformer on Eq. (1), "transformer" the same on raw
            coordinates, "mlp" a perceptron on all raw coordinates of a line.
        lines: sizes of the transformer; `dim` is that of a token.
        fusion: "gated" is Eq. (3); "uniform" sets its c to one, "hard" to one from `hard_threshold` on and to nothing
            below (Table II).
        hard_threshold: confidence from which on "hard" trusts a marker.
        heads: of the attention to the tokens.
        width: channels of that attention; None: those of the BEV features.
        norm: where the LayerNorm of Eq. (3) stands. "sum": around the sum, as written. "query": on the BEV features as
            they ask, F + c Attn(LayerNorm(F), ..), silent at first, so that a host can go on from where it is.
            BEVFormer's features are normalised already where a prior comes in; those of BEV evidence are not, and
            Eq. (3) as written is a shock to a host trained without it.
        radius: a BEV cell attends only to lanes that pass within this many metres. None: to all, as Eq. (3) is
            written, and has to learn from their tokens which are near; that takes longer than a small model trains.
        query_position: add their positions to the BEV features where they look at the tokens. Eq. (3) writes none;
            SMERF does, and BEV features of a convolution do not know where they are.
        connectivity: let lanes know their successors and predecessors (the paper's future work).
    """

    prior: MarkerPriorConfig = MarkerPriorConfig()
    memory: MarkerMemoryConfig | None = MarkerMemoryConfig()
    encoding: Literal["sine", "transformer", "mlp"] = "sine"
    lines: PolylineEncoderConfig = MARKER_POLYLINES
    fusion: Literal["gated", "uniform", "hard"] = "gated"
    hard_threshold: float = 0.5
    heads: int = 4
    width: int | None = None
    norm: Literal["sum", "query"] = "sum"
    radius: float | None = None
    query_position: bool = True
    connectivity: bool = False

    def build(self, host: HostSpec) -> MarkerPrior:
        """Return the prior for a host."""
        return MarkerPrior(self, host)


SMALL_MARKER_FUSION = MarkerFusionConfig(
    memory=MarkerMemoryConfig(lanes=32),
    width=64,
    norm="query",
    radius=4.0,
    lines=PolylineEncoderConfig(
        dim=64, layers=2, hidden=128, dropout=0.0, bands=32, layout="interleaved", attend="points"
    ),
)


class FusedMarkers(NamedTuple):
    """What every BEV layer needs of a frame's markers.

    Attributes:
        tokens: (N, D) of the lanes.
        lanes: the lanes themselves.
        gate: () c of Eq. (3).
        valid: (N,) lanes that are attended to.
    """

    tokens: Float[Array, "n d"]
    lanes: MarkerGuidance
    gate: Float[Array, ""]
    valid: Bool[Array, " n"]


class MarkerPrior(Prior):
    """Marker lanes with a decaying memory, fused into every layer of the BEV encoder."""

    reads = ("markers", "previous_from_ego", "has_previous")

    def __init__(self, config: MarkerFusionConfig, host: HostSpec):
        self.config = config
        self.marker_tokens = MarkerTokens(config, host.bev_range)

    def modules(self) -> dict[str, nn.Module]:
        """Return the encoder of lanes."""
        return {"marker_tokens": self.marker_tokens}

    def start(self) -> MarkerMemory | None:
        """Return an empty memory; None for a model without memory (Table III)."""
        config = self.config
        if config.memory is None:
            return None
        return MarkerMemory.empty(config.memory.frames, config.prior.lanes, config.prior.points)

    def observe(self, example: Example, memory: MarkerMemory | None) -> tuple[MarkerGuidance, MarkerMemory | None]:
        """Return the lanes of this frame's markers, or remembered ones, and the memory for the next frame."""
        config, markers = self.config, example.markers
        if markers is None:  # data without markers are data in which no marker is in sight
            markers = MarkerObservations.empty(1, 1, config.prior.points)
        observed = jax.tree.map(jnp.asarray, select_marker_lanes(markers, config.prior))
        if memory is None or config.memory is None:
            exponent = 1.0 if config.memory is None else config.memory.exponent
            return guidance(observed, exponent), memory
        bank, lanes = remember(
            memory, observed, jnp.asarray(example.previous_from_ego), jnp.asarray(example.has_previous), config.memory
        )
        return lanes, bank

    def encode(self, observation: MarkerGuidance, *, deterministic: bool) -> FusedMarkers:
        """Return the lanes' tokens with the gate and mask of the variant (Table II)."""
        tokens = self.marker_tokens(observation, deterministic=deterministic)
        return FusedMarkers(tokens, observation, *fusion_gate(observation, self.config))

    def into_bev(self, tokens: FusedMarkers, layer: int, cells: BevCells) -> Float[Array, "q c"]:
        """Return Eq. (3)."""
        fusion = MarkerFusion(self.config, name=f"markers_{layer}")
        mask = fusion_mask(tokens.lanes, tokens.valid, cells.centers, self.config)
        return fusion(cells.features, cells.position, tokens.tokens, mask, tokens.gate)


class MarkerTokens(nn.Module):
    """Polylines to one token each (III-A), and on request what they know of their neighbours.

    Attributes:
        config: see there.
        range: the host's, by which coordinates are normalised.
    """

    config: MarkerFusionConfig
    range: PerceptionRange

    @nn.compact
    def __call__(self, guide: MarkerGuidance, *, deterministic: bool = True) -> Float[Array, "n c"]:
        """Return the tokens, scaled by their weights (Eq. 4); 0 where not valid."""
        config, valid = self.config, guide.valid
        points = jnp.where(valid[:, None, None], self.range.normalise(guide.points), 0.0)
        count = points.shape[1]
        if config.encoding == "mlp":
            x = Mlp((config.lines.hidden, config.lines.dim), name="lines")(points.reshape(-1, count * 2))
        else:
            sizes = config.lines if config.encoding == "sine" else replace(config.lines, bands=0)
            nothing = jnp.zeros((len(points), 0))
            x = PolylineEncoder(sizes, name="lines")(points, nothing, valid, deterministic=deterministic)
        x = jnp.where(valid[:, None], x, 0.0)
        if config.connectivity:
            x = jnp.where(valid[:, None], LaneNeighbours(config.lines.dim, name="neighbours")(x, guide.successor), 0.0)
        return x * guide.weight[:, None]  # Eq. (4)


class LaneNeighbours(nn.Module):
    """One round of messages along the directed connectivity of a marker's lanes."""

    dim: int

    @nn.compact
    def __call__(self, tokens: Float[Array, "n c"], successor: Bool[Array, "n n"]) -> Float[Array, "n c"]:
        """Return tokens that know the mean of their successors and of their predecessors."""
        out = tokens
        for name, edges in (("successors", successor), ("predecessors", successor.T)):
            weight = edges.astype(tokens.dtype)
            mean = weight @ tokens / jnp.maximum(weight.sum(-1, keepdims=True), 1.0)
            out = out + nn.Dense(self.dim, use_bias=False, name=name)(mean)
        return out


class MarkerFusion(nn.Module):
    """Eq. (3) in one layer of the BEV encoder."""

    config: MarkerFusionConfig

    @nn.compact
    def __call__(
        self,
        bev: Float[Array, "q c"],
        position: Float[Array, "q c"],
        tokens: Float[Array, "n d"],
        mask: Bool[Array, "#q n"],
        gate: Float[Array, ""],
    ) -> Float[Array, "q c"]:
        """Return the BEV features after the fusion; exactly those that came in where there is no token to look at.

        Args:
            bev, position: features of the cells, and of where they are.
            tokens: of all lanes that guide.
            mask: which cell may look at which token.
            gate: c of Eq. (3), as `fusion_gate` gives it.
        """
        config, channels = self.config, bev.shape[-1]
        norm, added = nn.LayerNorm(epsilon=1e-5, name="norm"), config.norm == "query"
        query = norm(bev) if added else bev
        attention = MultiHeadAttention(
            config.width or channels, config.heads, out=channels, zero_init=added, name="attention"
        )
        found = attention(query + position if config.query_position else query, tokens, tokens, mask)
        fused = bev + gate * found
        return jnp.where(mask.any(), fused if added else norm(fused), bev)  # Eq. (3)


def fusion_gate(guide: MarkerGuidance, config: MarkerFusionConfig) -> tuple[Float[Array, ""], Bool[Array, " n"]]:
    """Return c of Eq. (3) and the tokens that are looked at, for the variant of Table II."""
    if config.fusion == "gated":
        return guide.gate, guide.valid
    one = jnp.ones_like(guide.gate)
    if config.fusion == "uniform":
        return one, guide.valid
    return one, guide.valid & (guide.gate >= config.hard_threshold)


def fusion_mask(
    guide: MarkerGuidance, valid: Bool[Array, " n"], cells: Float[ArrayLike, "q 2"], config: MarkerFusionConfig
) -> Bool[Array, "#q n"]:
    """Return which BEV cell, centred at (x, y) in metres, may look at which token."""
    if config.radius is None:
        return key_mask(valid)
    return radius_mask(jnp.asarray(cells), guide.points, valid, config.radius)
