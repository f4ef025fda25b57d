"""The traffic-flow module (TFM) of TF-Lane: fuses traffic flow into lane queries.

Two parts, as in Fig. 2 of the paper. The temporal encoder turns the history of each instance into one token (section
3.3, "Temporal Domain Encoder", Fig. 4). In the spatial encoder, lane queries and tokens attend to each other under the
spatial mask M_s (Fig. 5, Eq. (2) and (3)). Both are independent of the host detector.

The paper leaves much open; docs/tf_lane.md lists what we chose, and the settings that choose otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.masks import SpatialMask
from tflane_jax.layers.positions import sine_encoding
from tflane_jax.layers.precision import Precision, run_layer, run_part
from tflane_jax.limits import DIFFERENT, Count, CountOrZero, Rules, check_settings, splits
from tflane_jax.models.prior import BevCells, HostQueries, HostSpec, Prior
from tflane_jax.models.raster_fusion import RasterFusion, TrafficRasterConfig
from tflane_jax.models.traffic_masks import TrafficMaskConfig, sees_any, spatial_mask, temporal_mask
from tflane_jax.priors.traffic_flow import SelectedTracks, TrafficFlowPriorConfig, select_traffic_flow
from tflane_jax.priors.traffic_raster import rasterise_traffic_flow
from tflane_jax.scene import Example, RoadUser, TrafficFlow

Fusion = Literal["T->T", "T->L", "L->T", "L->L"]
ALL_FUSIONS: tuple[Fusion, ...] = ("T->T", "T->L", "L->T", "L->L")
LANE_FUSIONS: tuple[Fusion, ...] = ("L->T", "L->L")

SINE_METRES = 100.0
"""The sine encoding of coordinates in metres divides them by this; its longest wavelength is twice as long."""


@dataclass(frozen=True)
class TrafficFlowModuleConfig:
    """Shape of the TFM; the defaults are the paper's best (Table 5, Abla5: LT/LL, depth 1, normalised coordinates).

    Attributes:
        fusions: the fusion modules that are used, "Pipe." in Table 5, such as `ALL_FUSIONS`; L->T is always among them.
        depth: temporal self-attention layers, "Dep." in Table 5 as we read it.
        spatial_depth: how often the spatial encoder repeats the fusion modules, each time with separate parameters;
            Eq. (3) follows once. The other reading of "Dep.", because the text names cross-attention layers.
        residual: "fusion" adds to each fusion module its input; "none" leaves the original features to Eq. (3) alone,
            and only a query without a valid key keeps its own.
        token: an instance's token is computed from the mean of its valid frames after self-attention ("mean") and, in
            "mean_and_ends", from position and heading in its first and last valid frame.
        position_encoding: "sine" adds sines and cosines to the coordinates, "linear" nothing. Independent of
            `TrafficFlowPriorConfig.coordinates`, "Norm." in Table 5.
        bands: frequencies per coordinate of the sine encoding.
        width: channels inside the temporal encoder.
        heads: attention heads in both encoders.
        masking: restrictions of the masks.
        precision: dtype of layers behind the embeddings, see `layers.precision`; parameters and results are float32.
        remat: recompute the activations of each temporal layer and of the spatial encoder for the gradient instead of
            keeping them.
    """

    fusions: Annotated[tuple[Fusion, ...], DIFFERENT] = LANE_FUSIONS
    depth: CountOrZero = 1
    spatial_depth: Count = 1
    residual: Literal["fusion", "none"] = "fusion"
    token: Literal["mean_and_ends", "mean"] = "mean_and_ends"
    position_encoding: Literal["sine", "linear"] = "sine"
    bands: Count = 7
    width: Count = 32
    heads: Count = 4
    masking: TrafficMaskConfig = TrafficMaskConfig()
    precision: Precision = "float32"
    remat: bool = False

    def limits(self) -> Rules:
        """Lanes read traffic; channels split over heads; a window for each head; what a joint softmax can take."""
        yield splits("heads", self.heads, "width", self.width)
        yield "fusions", "L->T" in self.fusions, "such that L->T is among them, by which lanes read traffic"
        together = self.masking.softmax != "joint" or set(self.fusions) in (set(LANE_FUSIONS), set(ALL_FUSIONS))
        yield "fusions", together, "L->T and L->L, or all four, where masking.softmax is joint"
        fits = len(self.masking.head_windows) in (0, self.heads)
        yield "masking.head_windows", fits, f"one window for each of the {self.heads} heads, or ()"


@dataclass(frozen=True)
class TrafficFlowConfig:
    """The prior "traffic flow" of a host.

    Attributes:
        prior: selection of instances.
        module: the TFM.
        insert: "before_decoder" enhances the queries once, as in the paper (section 3.3); "every_layer" enhances them
            before each decoder layer, with separate parameters; "nowhere" leaves the TFM out, and `bev` must be set.
        bev: writes the selected tracks into the BEV features as well, which the paper does not; None: queries only.
    """

    prior: TrafficFlowPriorConfig = TrafficFlowPriorConfig()
    module: TrafficFlowModuleConfig = TrafficFlowModuleConfig()
    insert: Literal["before_decoder", "every_layer", "nowhere"] = "before_decoder"
    bev: TrafficRasterConfig | None = None

    def limits(self) -> Rules:
        """Traffic flow enters the model somewhere."""
        somewhere = self.insert != "nowhere" or self.bev is not None
        yield "insert", somewhere, "before_decoder or every_layer where bev is None: else traffic flow enters nowhere"

    def host_limits(self, host: HostSpec) -> Rules:
        """The channels of a query split over the heads of the module."""
        if self.insert != "nowhere":
            yield splits("module.heads", self.module.heads, "the channels of a query", host.dim)

    def build(self, host: HostSpec) -> TrafficFlowPrior:
        """Return the prior for a host; raises UserError for settings that break a limit."""
        check_settings(self)
        return TrafficFlowPrior(self, host)


class EncodedTrafficFlow(NamedTuple):
    """Traffic flow of a frame as the two hooks read it.

    Attributes:
        features: (T, D) TF_Feat, one token per instance; None without the TFM.
        tracks: the selected instances.
    """

    features: Float[Array, "t d"] | None
    tracks: SelectedTracks


class TrafficFlowPrior(Prior):
    """Selects instances, encodes each to a token, and enhances the host's queries; optionally, BEV features too.

    Without traffic flow, the queries get what they get in an empty scene, and BEV features stay exactly as they are.
    """

    reads = ("traffic_flow",)

    def __init__(self, config: TrafficFlowConfig, host: HostSpec):
        self.config, self.host, self.temporal_encoder = config, host, None
        if config.insert != "nowhere":
            # Named as in a host, so that a module of one's own can take the parameters of a trained host.
            box, coordinates = host.bev_range, config.prior.coordinates
            self.temporal_encoder = TemporalEncoder(config.module, host.dim, box, coordinates, name="temporal_encoder")

    def modules(self) -> dict[str, nn.Module]:
        """Return the temporal encoder."""
        return {} if self.temporal_encoder is None else {"temporal_encoder": self.temporal_encoder}

    def observe(self, example: Example, memory: None) -> tuple[SelectedTracks, None]:
        """Return `select` of an example's traffic flow; the prior remembers nothing."""
        return self.select(example.traffic_flow), None

    def select(self, flow: TrafficFlow | None) -> SelectedTracks:
        """Return reTF_i; without traffic flow, all instances are invalid."""
        prior, host = self.config.prior, self.host
        tracks = jax.tree.map(jnp.asarray, TrafficFlow.empty(1, prior.frames)) if flow is None else flow
        return select_traffic_flow(tracks, prior, host.range, host.forward)

    def encode(self, observation: SelectedTracks, *, deterministic: bool) -> EncodedTrafficFlow:
        """Return TF_Feat (T, D) beside the tracks that it encodes."""
        del deterministic
        features = None if self.temporal_encoder is None else self.temporal_encoder(observation)
        return EncodedTrafficFlow(features, observation)

    def fuses_into_bev(self) -> bool:
        """Return whether `TrafficFlowConfig.bev` is set."""
        return self.config.bev is not None

    def into_bev(self, tokens: EncodedTrafficFlow, layer: int, cells: BevCells) -> Float[Array, "q c"]:
        """Return the BEV features with the tracks written into the cells that they pass."""
        config = self.config.bev
        if config is None or not config.enters(layer):
            return cells.features
        raster = rasterise_traffic_flow(jax.tree.map(jnp.asarray, tokens.tracks), cells.grid, config.between)
        fuse = RasterFusion(config.hidden, name=f"traffic_flow_{layer}")
        return fuse(cells.features, raster.features, raster.touched)

    def into_queries(self, tokens: EncodedTrafficFlow, layer: int, queries: HostQueries) -> Float[Array, "q d"]:
        """Return L'_Feat before the layers selected by `insert`; raises ValueError as `HostQueries.check` does."""
        if tokens.features is None or (layer > 0 and self.config.insert == "before_decoder"):
            return queries.features
        config = self.config
        queries.check(self.host)
        mask = spatial_mask(config.module.masking, queries, tokens.tracks, self.host.bev_range)
        features = tokens.features
        if len(queries.groups) > 1 and "T->L" in config.module.fusions:
            # Tokens that read lanes would carry what they read from one group to another: each group has its own.
            mask, features = mask.by_group(queries.groups), jnp.concatenate([features] * len(queries.groups))
        spatial = SpatialEncoder(config.module, self.host.dim, self.host.query_type, name=f"spatial_encoder_{layer}")
        return spatial(queries.features, queries.position, features, mask)


class TemporalEncoder(nn.Module):
    """From N frames of an instance to one token, under the temporal mask.

    Attributes:
        config: shape.
        dim: channels of the token.
        range: the box that normalised coordinates span, that of the host's BEV features.
        coordinates: see `TrafficFlowPriorConfig.coordinates`.
    """

    config: TrafficFlowModuleConfig
    dim: int
    range: PerceptionRange
    coordinates: Literal["normalised", "metres"] = "normalised"

    @nn.compact
    def __call__(self, tracks: SelectedTracks) -> Float[Array, "t d"]:
        """Return TF_Feat; rows of invalid instances are finite but meaningless."""
        if self.coordinates == "normalised":  # still 0 in frames that are not valid
            unit = jnp.where(tracks.frame_valid[..., None], self.range.normalise(tracks.position), 0.0)
            tracks = replace(tracks, position=unit)
        x = self._embed(tracks)
        for i in range(self.config.depth):
            mask = temporal_mask(self.config.masking, tracks.frame_valid)
            layer = partial(TemporalLayer, self.config.width, self.config.heads, name=f"layer_{i}")
            x = run_layer(self, layer, self.config, x, mask)
        x = nn.LayerNorm(name="norm")(x)
        weight = tracks.frame_valid.astype(x.dtype)
        mean = jnp.einsum("tnc,tn->tc", x, weight) / jnp.maximum(weight.sum(-1), 1.0)[:, None]
        if self.config.token == "mean":
            return Mlp((self.dim, self.dim), name="token")(mean)
        # The mean blurs the positions of a moving instance; its first and last valid frames keep them.
        first = tracks.frame_valid.argmax(-1)
        last = weight.shape[1] - 1 - tracks.frame_valid[:, ::-1].argmax(-1)
        ends = jnp.stack([first, last], 1)[..., None]
        # Select frames before encoding them: otherwise XLA would encode all frames a second time.
        located = self._encode_places(*(jnp.take_along_axis(x, ends, 1) for x in (tracks.position, tracks.heading)))
        return Mlp((self.dim, self.dim), name="token")(jnp.concatenate([mean, located.reshape(len(mean), -1)], -1))

    def _encode_places(self, position: Float[Array, "t n 3"], heading: Float[Array, "t n 2"]) -> Float[Array, "t n e"]:
        """Encode position and heading."""
        if self.config.position_encoding == "sine":
            plane = position[..., :2] / SINE_METRES if self.coordinates == "metres" else position[..., :2]
            position = jnp.concatenate([sine_encoding(plane, self.config.bands), position], -1)
        return jnp.concatenate([position, heading], -1)

    def _embed(self, tracks: SelectedTracks) -> Float[Array, "t n c"]:
        """Encode position, heading, size, category and age of every frame."""
        width, (instances, frames) = self.config.width, tracks.frame_valid.shape
        x = nn.Dense(width, name="frame")(self._encode_places(tracks.position, tracks.heading))
        category = nn.Embed(len(RoadUser), width, name="category")(tracks.category)
        size = nn.Dense(width, use_bias=False, name="size")(tracks.size)
        age = self.param("age", nn.initializers.normal(0.02), (frames, width), jnp.float32)
        return x + (category + size)[:, None] + jnp.broadcast_to(age, (instances, frames, width))


class TemporalLayer(nn.Module):
    """Pre-norm transformer layer over the frames of each instance."""

    width: int
    heads: int

    @nn.compact
    def __call__(self, x: Float[Array, "t n c"], mask: Bool[Array, "t #n n"]) -> Float[Array, "t n c"]:
        """Return the frames after self-attention under the temporal mask (Fig. 4) and a feed-forward block."""
        # One instance at a time.
        attend = nn.vmap(
            MultiHeadAttention,
            variable_axes={"params": None, "intermediates": 0},
            split_rngs={"params": False},
        )
        y = nn.LayerNorm(name="attention_norm")(x)
        x = x + attend(self.width, self.heads, name="attention")(y, y, y, mask)
        y = nn.LayerNorm(name="mlp_norm")(x)
        return x + Mlp((2 * self.width, self.width), name="mlp")(y)


class SpatialEncoder(nn.Module):
    """The four fusion modules and the paradigm-aware composition (section 3.3).

    Attributes:
        config: shape.
        dim: channels of lane queries and traffic tokens.
        query_type: see `HostSpec.query_type`; I(Q_type) of Eq. (3) is 1 for points.
    """

    config: TrafficFlowModuleConfig
    dim: int
    query_type: Literal["instance", "point"] = "instance"

    @nn.compact
    def __call__(
        self,
        lanes: Float[Array, "l d"],
        lane_position: Float[Array, "l d"],
        traffic: Float[Array, "t d"],
        mask: SpatialMask,
    ) -> Float[Array, "l d"]:
        """Return L'_Feat.

        Args:
            lanes: L_Feat, the host's lane queries.
            lane_position: the host's query positions, added to queries and keys but not to values.
            traffic: TF_Feat.
            mask: M_s; quadrants of unused fusion modules are never built.
        """
        return run_part(self, SpatialEncoder._encode, self.config, lanes, lane_position, traffic, mask)

    def _encode(self, lanes, lane_position, traffic, mask: SpatialMask) -> Float[Array, "l d"]:
        """Return L'_Feat; called by the compact method."""
        config = self.config

        def fuse(name: Fusion, layer: int, x, x_position, y, y_position, quadrant):
            """Eq. (2): one fusion module, F_fusion(. ; M_s^(i))."""
            if name not in config.fusions:
                return x
            label = name.replace("->", "_to_") + (f"_{layer}" if layer else "")
            found = MultiHeadAttention(self.dim, config.heads, name=label)(x + x_position, y + y_position, y, quadrant)
            norm = nn.LayerNorm(name=f"{label}_norm")
            if config.residual == "fusion":
                return norm(x + found)
            return norm(found) if quadrant is None else jnp.where(sees_any(quadrant), norm(found), x)

        # Padding may hold anything, NaN included.
        traffic = jnp.where(mask.valid[:, None], traffic, 0.0)
        none = jnp.zeros_like(traffic)  # a traffic token carries its own position already
        fused = lanes
        for i in range(config.spatial_depth):
            if config.masking.softmax == "joint":
                fused, traffic = self._joint(i, fused, lane_position, traffic, mask)
                continue
            traffic = fuse("T->T", i, traffic, none, traffic, none, mask.traffic_traffic)
            traffic = fuse("T->L", i, traffic, none, fused, lane_position, mask.traffic_lane)
            fused = fuse("L->T", i, fused, lane_position, traffic, none, mask.lane_traffic)
            fused = fuse("L->L", i, fused, lane_position, fused, lane_position, mask.lane_lane)

        # Eq. (3): L' = T(F^(4)) + I(Q_type) * L.
        transformed = fused + Mlp((2 * self.dim, self.dim), name="transform")(fused)
        transformed = nn.LayerNorm(name="transform_norm")(transformed)
        return transformed + lanes if self.query_type == "point" else transformed

    def _joint(self, layer, lanes, lane_position, traffic, mask: SpatialMask):
        """Return lanes and traffic after one attention over both; traffic is renewed only with the T modules."""
        config, count = self.config, len(lanes)
        tokens, whole = jnp.concatenate([lanes, traffic]), mask.dense()
        placed = tokens + jnp.concatenate([lane_position, jnp.zeros_like(traffic)])
        rows = len(tokens) if "T->L" in config.fusions else count
        label = "joint" + (f"_{layer}" if layer else "")
        attend = MultiHeadAttention(self.dim, config.heads, name=label)
        found, own = attend(placed[:rows], placed, tokens, whole[..., :rows, :]), tokens[:rows]
        fused = nn.LayerNorm(name=f"{label}_norm")(own + found if config.residual == "fusion" else found)
        fused = jnp.where(sees_any(whole[..., :rows, :]), fused, own)
        return fused[:count], traffic if rows == count else fused[count:]
