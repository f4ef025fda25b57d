"""TopoNet's lane branch on BEV evidence, with or without the traffic-flow module.

BEV evidence -> BEV features -> lane queries -> (TFM) -> decoder layers -> centerlines, scores, lane-lane topology.
The camera version exchanges the encoder and adds the traffic-element half of the scene graph; decoder, graph, heads and
losses stay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.layers.graph import Mlp, edge_probabilities
from tflane_jax.layers.masks import SpatialMask
from tflane_jax.layers.positions import sine_encoding
from tflane_jax.models.evidence_encoder import EvidenceEncoder, EvidenceEncoderConfig
from tflane_jax.models.lane_decoder import (
    LaneDecoderConfig,
    LaneDecoderLayer,
    LaneHeads,
    LaneQueries,
    next_reference,
)
from tflane_jax.models.traffic_flow_module import (
    SpatialEncoder,
    TemporalEncoder,
    TrafficFlowModuleConfig,
)
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig, TrafficFlowTokens, select_traffic_flow
from tflane_jax.scene import Example, LanePrediction, TrafficFlow


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
        encoder: BEV features.
        decoder: lane decoder.
        traffic_flow: the TFM and its prior, or None.
    """

    encoder: EvidenceEncoderConfig = EvidenceEncoderConfig()
    decoder: LaneDecoderConfig = LaneDecoderConfig()
    traffic_flow: TrafficFlowConfig | None = None

    def build(self) -> TopoNet:
        """Return the Linen module."""
        return TopoNet(self)


class TopoNet(nn.Module):
    """One example in, the predictions of every decoder layer out."""

    config: TopoNetConfig

    @nn.compact
    def __call__(self, example: Example) -> LanePrediction:
        """Return predictions with a leading axis over decoder layers; the last one is the answer."""
        config = self.config.decoder
        if example.bev is None:
            raise ValueError("this model reads BEV evidence, and the example has none (bev is None)")
        bev = EvidenceEncoder(self.config.encoder, name="encoder")(example.bev)
        queries, position, reference = LaneQueries(config, name="queries")()
        enhance = self._traffic_flow(example)
        adjacency = jnp.zeros((config.queries, config.queries))
        outputs = []
        for i in range(config.layers):
            where = position
            if config.refine == "iterative":
                # A query that moves says where it is.
                along = jnp.concatenate([sine_encoding(reference[..., :2], config.bands), reference], -1)
                along = along.reshape(config.queries, -1)
                where = position + Mlp((config.dim, config.dim), name=f"lane_position_{i}")(along)
            queries = enhance(i, queries, where)
            queries = LaneDecoderLayer(config, name=f"layer_{i}")(queries, where, reference, bev, adjacency)
            prediction, unit = LaneHeads(config, name=f"heads_{i}")(queries, reference, bev)
            reference = next_reference(reference, unit, config)
            adjacency = edge_probabilities(prediction.successor_logits)
            outputs.append(prediction)
        return jax.tree.map(lambda *layers: jnp.stack(layers), *outputs)

    def _traffic_flow(self, example: Example):
        """Return the function (layer, queries, positions) -> queries that applies the TFM where it belongs."""
        traffic, dim = self.config.traffic_flow, self.config.decoder.dim
        if traffic is None:
            return lambda layer, queries, position: queries
        tokens = traffic_flow_tokens(example, traffic.prior)
        features = TemporalEncoder(traffic.module, dim, name="temporal_encoder")(tokens)
        mask = SpatialMask.from_validity(self.config.decoder.queries, tokens.valid)

        def enhance(
            layer: int, queries: Float[Array, "q c"], position: Float[Array, "q c"]
        ) -> Float[Array, "q c"]:
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
