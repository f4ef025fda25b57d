"""Confidence-gated marker fusion (Wu and Hu): lanes stored for the detected markers are fused into BEV features.

Lanes of a frame's markers -> memory (`priors.marker_memory`) -> one token per lane (III-A) -> in every layer of the BEV
encoder, after spatial attention, BEV features attend to the tokens, gated by the confidence (III-B).

Without marker lanes, BEV features stay exactly as they are, so that the model equals the one without markers. Eq. (3)
as written applies its LayerNorm in every frame: `as_written`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.masks import key_mask, radius_mask
from tflane_jax.layers.polyline_encoder import MARKER_POLYLINES, PolylineEncoder, PolylineEncoderConfig
from tflane_jax.layers.precision import computing, full, run_part
from tflane_jax.limits import Fraction
from tflane_jax.models.prior import BevCells, HostSpec, Prior
from tflane_jax.models.raster_fusion import MarkerRasterConfig, RasterFusion
from tflane_jax.models.token_fusion import TokenFusionConfig, attend_to_tokens
from tflane_jax.priors.marker_memory import (
    MarkerGuidance,
    MarkerMemory,
    MarkerMemoryConfig,
    guidance,
    remember,
)
from tflane_jax.priors.marker_raster import rasterise_markers
from tflane_jax.priors.markers import MarkerPriorConfig, select_marker_lanes
from tflane_jax.scene import Example, MarkerObservations


@dataclass(frozen=True)
class MarkerFusionConfig(TokenFusionConfig):
    """The module. The defaults have the paper's sizes, and Eq. (3) for hosts that also run without markers.

    `as_written` is Eq. (3) to the letter; `SMALL_MARKER_FUSION` trains on two CPU cores.

    Attributes:
        prior: confidence of the markers, and polylines of their lanes.
        memory: temporal memory; None for the ablation without (Table III).
        encoding: of a polyline (Table IV): "sine" is the transformer on Eq. (1), "transformer" the same on raw
            coordinates, "mlp" a perceptron on each point's raw coordinates, whose outputs are joined as those of the
            transformer are: "point-wise encoding", as the paper calls it, without interactions between points.
        lines: sizes of the transformer; `dim` is that of a token.
        fusion: "gated" is Eq. (3); "uniform" sets c = 1; "hard" sets c = 1 and ignores markers, seen or remembered,
            whose own confidence is below `hard_threshold` (Table II). c is only the factor in Eq. (3): confidence also
            scales tokens (Eq. 4) and decides when memory is read. `uniform_fusion` removes it from there too.
        hard_threshold: lowest confidence at which "hard" uses markers; the paper gives none.
        heads: see `TokenFusionConfig`; the paper gives those of the line encoder alone.
        norm: position of the LayerNorm in Eq. (3). "written": around the sum, in every frame, so that a host without
            markers in sight differs from one without this module. "sum": the same in frames with lanes of markers;
            others stay as they are. "query": on the attention's queries, F + c Attn(LayerNorm(F), ..), with a
            zero-initialised output, so that training can continue from a host without markers. BEVFormer normalises its
            features before the fusion; the evidence encoder does not, and for a host trained without markers, Eq. (3)
            as written changes all features at once.
        width, radius: see `TokenFusionConfig`; without a radius, cells attend to all lanes, as in Eq. (3).
        query_position: add position encodings to the attention's queries. Eq. (3) has none, SMERF has; without, BEV
            features from convolutions carry no positions.
        bev: also write the lanes into the BEV cells that they pass, before Eq. (3), which is ours; None: Eq. (3) alone.
        connectivity: lanes exchange messages with their successors and predecessors (the paper's future work).
        precision, remat: see `TokenFusionConfig`.
    """

    prior: MarkerPriorConfig = MarkerPriorConfig()
    memory: MarkerMemoryConfig | None = MarkerMemoryConfig()
    encoding: Literal["sine", "transformer", "mlp"] = "sine"
    lines: PolylineEncoderConfig = MARKER_POLYLINES
    fusion: Literal["gated", "uniform", "hard"] = "gated"
    hard_threshold: Fraction = 0.5
    query_position: bool = True
    bev: MarkerRasterConfig | None = None
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


def uniform_fusion(config: MarkerFusionConfig) -> MarkerFusionConfig:
    """Return the ablation in which every marker, seen or remembered, counts fully (Table II, "uniform fusion").

    c = 1 in Eq. (3), all weights of Eq. (4) are 1, and memory is read only when nothing is detected.
    """
    memory = None if config.memory is None else replace(config.memory, decay=1.0)
    return replace(config, fusion="uniform", prior=replace(config.prior, trust="all"), memory=memory)


def as_written(config: MarkerFusionConfig) -> MarkerFusionConfig:
    """Return Eq. (3) exactly as the paper writes it, with the same encoder, fusion and memory.

    LayerNorm(F + c Attn(F, M, M)) in every frame, from every cell to every lane, as wide as the BEV features, without
    positions in the queries.
    """
    return replace(config, norm="written", width=None, radius=None, query_position=False)


class EncodedMarkers(NamedTuple):
    """Prior tokens of a frame's markers, as every BEV layer reads them.

    Attributes:
        tokens: (N, D) one token per lane.
        lanes: the lanes themselves; `gate` and `valid` are those of the variant, see `as_fused`.
    """

    tokens: Float[Array, "n d"]
    lanes: MarkerGuidance


class MarkerPrior(Prior):
    """Marker lanes with a decaying memory, fused into every layer of the BEV encoder."""

    reads = ("markers", "previous_from_ego", "has_previous")

    def __init__(self, config: MarkerFusionConfig, host: HostSpec):
        self.config = config
        self.marker_tokens = MarkerEncoder(config, host.bev_range)

    def modules(self) -> dict[str, nn.Module]:
        """Return the lane encoder."""
        return {"marker_tokens": self.marker_tokens}

    def start(self) -> MarkerMemory | None:
        """Return an empty memory; None for a model without memory (Table III)."""
        config = self.config
        if config.memory is None:
            return None
        return MarkerMemory.empty(config.memory.frames, config.prior.lanes, config.prior.points)

    def observe(self, example: Example, memory: MarkerMemory | None) -> tuple[MarkerGuidance, MarkerMemory | None]:
        """Return the lanes of this frame's markers, or those in memory, and the memory for the next frame."""
        config, markers = self.config, example.markers
        if markers is None:  # as in a frame without a visible marker
            markers = MarkerObservations.empty(1, 1, config.prior.points)
        observed = jax.tree.map(jnp.asarray, select_marker_lanes(markers, config.prior))
        if memory is None or config.memory is None:
            exponent = 1.0 if config.memory is None else config.memory.exponent
            return guidance(observed, exponent), memory
        bank, lanes = remember(
            memory, observed, jnp.asarray(example.previous_from_ego), jnp.asarray(example.has_previous), config.memory
        )
        return lanes, bank

    def encode(self, observation: MarkerGuidance, *, deterministic: bool) -> EncodedMarkers:
        """Return the lanes that the variant attends to (Table II), and their tokens."""
        lanes = as_fused(observation, self.config)
        return EncodedMarkers(self.marker_tokens(lanes, deterministic=deterministic), lanes)

    def into_bev(self, tokens: EncodedMarkers, layer: int, cells: BevCells) -> Float[Array, "q c"]:
        """Return Eq. (3), after the lanes were written into their cells if `MarkerFusionConfig.bev` is set."""
        features, lanes, raster_config = cells.features, tokens.lanes, self.config.bev
        if raster_config is not None and raster_config.enters(layer):
            raster = rasterise_markers(lanes, cells.grid, raster_config.between)
            fuse = RasterFusion(raster_config.hidden, name=f"marker_cells_{layer}")
            features = fuse(features, raster.features, raster.factor > 0.0, raster.factor)
        fusion = MarkerFusion(self.config, name=f"markers_{layer}")
        mask = fusion_mask(lanes, cells.centers, self.config)
        return fusion(features, cells.position, tokens.tokens, mask, lanes.gate)


class MarkerEncoder(nn.Module):
    """Encodes polylines to one token each (III-A), with messages between neighbours if `connectivity` is set.

    Attributes:
        config: settings of the fusion.
        range: the box that normalised coordinates span, that of the host's BEV features.
    """

    config: MarkerFusionConfig
    range: PerceptionRange

    @nn.compact
    def __call__(self, lanes: MarkerGuidance, *, deterministic: bool = True) -> Float[Array, "n c"]:
        """Return the tokens (N, D), scaled by the lanes' weights (Eq. 4); 0 for invalid lanes."""
        config, valid = self.config, lanes.valid
        points = jnp.where(valid[:, None, None], self.range.normalise(lanes.points), 0.0)
        count = points.shape[1]
        if config.encoding == "mlp":
            with computing(config.precision):
                each = Mlp((config.lines.hidden, config.lines.dim), name="points")(points)
                x = full(nn.Dense(config.lines.dim, name="lines")(each.reshape(-1, count * config.lines.dim)))
        else:
            sizes = config.lines if config.encoding == "sine" else replace(config.lines, bands=0)
            nothing = jnp.zeros((len(points), 0))
            x = PolylineEncoder(sizes, config, name="lines")(points, nothing, valid, deterministic=deterministic)
        x = jnp.where(valid[:, None], x, 0.0)
        if config.connectivity:
            with computing(config.precision):
                messages = LaneNeighbours(config.lines.dim, name="neighbours")
                x = jnp.where(valid[:, None], messages(x, lanes.successor), 0.0)
        return x * lanes.weight[:, None]  # Eq. (4)


class LaneNeighbours(nn.Module):
    """One round of messages along the directed topology of a marker's lanes."""

    dim: int

    @nn.compact
    def __call__(self, tokens: Float[Array, "n c"], successor: Bool[Array, "n n"]) -> Float[Array, "n c"]:
        """Return tokens plus linear maps of the means over successors and over predecessors."""
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
        """Return the BEV features after the fusion.

        They stay exactly as they are if the mask admits no token, but for the LayerNorm of `norm` "written".

        Args:
            bev, position: features of the cells and their position encoding.
            tokens: of the marker lanes.
            mask: which cell may attend to which token.
            gate: c of Eq. (3), see `as_fused`.
        """
        return run_part(self, MarkerFusion._fuse, self.config, bev, position, tokens, mask, gate)

    def _fuse(self, bev, position, tokens, mask, gate) -> Float[Array, "q c"]:
        """Return Eq. (3); called by the compact method."""
        config, place = self.config, position if self.config.query_position else None
        # Eq. (3): F' = LayerNorm(F + c Attn(F, M, M)), with c = `gate`.
        fused = attend_to_tokens(config, bev, place, tokens, mask, change=lambda found: gate * found)
        return fused if config.norm == "written" else jnp.where(mask.any(), fused, bev)


def as_fused(lanes: MarkerGuidance, config: MarkerFusionConfig) -> MarkerGuidance:
    """Return the lanes that a variant of Table II attends to, with its c of Eq. (3): 0 without any."""
    gate, valid = lanes.gate, lanes.valid
    if config.fusion == "hard":
        # Each marker by its own confidence: the gate is that of the most trusted one.
        valid = valid & (lanes.confidence >= config.hard_threshold)
    if config.fusion != "gated":
        gate = jnp.ones_like(gate)
    return replace(lanes, gate=jnp.where(valid.any(), gate, 0.0), valid=valid)


def fusion_mask(
    lanes: MarkerGuidance, cells: Float[ArrayLike, "q 2"], config: MarkerFusionConfig
) -> Bool[Array, "#q n"]:
    """Return which BEV cell, centered at (x, y) in metres, may attend to which of the lanes of `as_fused`."""
    if config.radius is None:
        return key_mask(lanes.valid)
    return radius_mask(jnp.asarray(cells), lanes.points, lanes.valid, config.radius)
