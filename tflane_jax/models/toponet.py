"""TopoNet (Li et al. 2023), with or without the traffic-flow module; specs/modules.md section 5.

Images -> BEV features -> lane queries -> (TFM) -> decoder layers -> centerlines, scores, lane-lane topology;
front view -> traffic elements, which join the decoder's scene graph -> lane-element topology.
The small version reads BEV evidence instead of images and knows no traffic elements; decoder, graph, heads and losses
are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.layers.graph import ElementNodes, Mlp, edge_probabilities
from tflane_jax.layers.masks import SpatialMask
from tflane_jax.layers.positions import sine_encoding
from tflane_jax.models.camera_encoder import (
    PAPER_CAMERA_ENCODER,
    CameraEncoderConfig,
    check_elements,
)
from tflane_jax.models.element_decoder import (
    PAPER_ELEMENT_DECODER,
    ElementDecoderConfig,
    ElementOutput,
)
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.host import Host, decode_lanes
from tflane_jax.models.lane_decoder import (
    ElementEmbedding,
    LaneDecoderLayer,
    LaneHeads,
    make_prediction,
    next_reference,
)
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lane_queries import PAPER_LANE_DECODER, LaneDecoderConfig
from tflane_jax.models.marker_fusion import MarkerFusionConfig
from tflane_jax.models.sd_map_encoder import SdMapModuleConfig
from tflane_jax.models.traffic_flow_module import (
    SpatialEncoder,
    TemporalEncoder,
    TrafficFlowModuleConfig,
)
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig, TrafficFlowTokens, select_traffic_flow
from tflane_jax.scene import Example, LaneGraph, Prediction, TrafficFlow


@dataclass(frozen=True)
class TrafficFlowConfig:
    """How the host uses traffic flow.

    Attributes:
        prior: selection and coordinates.
        module: the TFM.
        insert: "before_decoder" enhances the queries once, as the paper says (section 3.3); "every_layer" enhances
            them before each decoder layer, with parameters of its own.
    """

    prior: TrafficFlowPriorConfig = TrafficFlowPriorConfig()
    module: TrafficFlowModuleConfig = TrafficFlowModuleConfig()
    insert: Literal["before_decoder", "every_layer"] = "before_decoder"


@dataclass(frozen=True)
class TopoNetConfig:
    """The model; `traffic_flow=None` is the vision-only baseline.

    Attributes:
        encoder: BEV features from BEV evidence or from cameras.
        decoder: lane decoder.
        traffic_flow: the TFM and its prior, or None.
        elements: traffic elements in the front view and in the scene graph, or None. They need cameras, and as many
            layers as the decoder.
        markers: fiducial markers in the BEV encoder, or None.
        sd_map: an SD map in the BEV encoder (SMERF), or None.
        denoising: noised lanes to train the decoder with, or None as in the paper.
    """

    encoder: EvidenceEncoderConfig | CameraEncoderConfig = EvidenceEncoderConfig()
    decoder: LaneDecoderConfig = LaneDecoderConfig()
    traffic_flow: TrafficFlowConfig | None = None
    elements: ElementDecoderConfig | None = None
    markers: MarkerFusionConfig | None = None
    sd_map: SdMapModuleConfig | None = None
    denoising: DenoisingConfig | None = None

    def build(self) -> TopoNet:
        """Return the Linen module; raises UserError where encoder, decoder and elements do not fit each other."""
        check_elements(self.encoder, self.decoder.layers, self.elements)
        return TopoNet(self)


def paper_config() -> TopoNetConfig:
    """Return the paper's sizes: ResNet-50, 7 cameras, 200 x 100 cells, 200 lane and 100 element queries."""
    return TopoNetConfig(PAPER_CAMERA_ENCODER, PAPER_LANE_DECODER, elements=PAPER_ELEMENT_DECODER)


class TopoNet(Host):
    """One example in, the predictions of every decoder layer out."""

    config: TopoNetConfig

    def decode_example(self, example, bev, elements, *, deterministic):
        traffic = self.config.traffic_flow
        tokens = None if traffic is None else traffic_flow_tokens(example, traffic.prior)
        return self.decode(bev, elements, tokens, example.lanes, deterministic=deterministic)

    @nn.compact
    def decode(
        self,
        bev: Float[Array, "h w e"],
        elements: ElementOutput | None = None,
        tokens: TrafficFlowTokens | None = None,
        lanes: LaneGraph | None = None,
        *,
        deterministic: bool = True,
    ) -> Prediction:
        """Return lanes and topology of every decoder layer, from BEV features, traffic elements and traffic flow.

        Stores the queries of every layer as the intermediate `layer_queries` where a caller asks for it.
        """
        return decode_lanes(self, self.config.decoder, bev, elements, tokens, lanes, deterministic)

    def decode_queries(self, start, bev, elements, tokens, deterministic) -> Prediction:
        """Return what a set of queries says."""
        config, (queries, position, reference) = self.config.decoder, start
        enhance = self._traffic_flow(tokens)
        # The first layer knows of no edges.
        adjacency = jnp.zeros((config.queries, config.queries))
        governs = None if elements is None else jnp.zeros((config.queries, elements.logits.shape[1]))
        outputs = []
        for i in range(config.layers):
            where = position
            if config.refine == "iterative":
                # A query that moves says where it is.
                along = jnp.concatenate([sine_encoding(reference[..., :2], config.bands), reference], -1)
                along = along.reshape(config.queries, -1)
                where = position + Mlp((config.dim, config.dim), name=f"lane_position_{i}")(along)
            queries = enhance(i, queries, where)
            seen = nodes = None
            if elements is not None and governs is not None:
                embed = ElementEmbedding(config, name=f"element_embedding_{i}")
                seen = embed(elements.queries[i], deterministic=deterministic)
                nodes = ElementNodes(seen, elements.logits[i], governs)
            layer = LaneDecoderLayer(config, name=f"layer_{i}")
            queries = layer(queries, where, reference, bev, adjacency, nodes, deterministic=deterministic)
            self.sow("intermediates", "layer_queries", queries)
            output = LaneHeads(config, name=f"heads_{i}")(queries, reference, bev, seen)
            outputs.append(output)
            reference = next_reference(reference, output.unit, config)
            if output.successor is not None:
                adjacency = edge_probabilities(output.successor)
            if output.element_lane is not None:
                governs = edge_probabilities(output.element_lane)
        return make_prediction(outputs, elements)

    def _traffic_flow(self, tokens: TrafficFlowTokens | None):
        """Return the function (layer, queries, positions) -> queries that applies the TFM where it belongs."""
        traffic, dim = self.config.traffic_flow, self.config.decoder.dim
        if traffic is None or tokens is None:
            return lambda layer, queries, position: queries
        features = TemporalEncoder(traffic.module, dim, name="temporal_encoder")(tokens)
        mask = SpatialMask.from_validity(self.config.decoder.queries, tokens.valid)

        def enhance(layer: int, queries: Float[Array, "q c"], position: Float[Array, "q c"]) -> Float[Array, "q c"]:
            if layer > 0 and traffic.insert == "before_decoder":
                return queries
            spatial = SpatialEncoder(traffic.module, dim, name=f"spatial_encoder_{layer}")
            return spatial(queries, position, features, mask)

        return enhance


def traffic_flow_tokens(example: Example, prior: TrafficFlowPriorConfig) -> TrafficFlowTokens:
    """Return the example's traffic-flow tokens; a dataset without traffic flow is one where nobody drives."""
    flow = example.traffic_flow
    if flow is None:
        flow = jax.tree.map(jnp.asarray, TrafficFlow.empty(1, prior.frames))
    return select_traffic_flow(flow, prior)
