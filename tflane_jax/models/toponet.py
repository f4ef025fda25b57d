"""TopoNet (Li et al. 2023), with or without priors.

Images -> BEV features -> lane queries -> (priors) -> decoder layers -> centerlines, scores, lane-lane topology.
Front view -> traffic elements -> the decoder's scene graph -> lane-element topology.
The small version reads BEV evidence instead of images and has no traffic elements; decoder, graph, heads and losses
are the same. Source: docs/reference/toponet.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.layers.graph import ElementNodes, edge_probabilities
from tflane_jax.layers.precision import run_layer
from tflane_jax.limits import PositiveOrZero, Rules, check_settings
from tflane_jax.models.auxiliary import AuxiliaryName
from tflane_jax.models.camera_encoder import PAPER_CAMERA_ENCODER
from tflane_jax.models.element_decoder import PAPER_ELEMENT_DECODER, ElementOutput
from tflane_jax.models.encoders import element_limits
from tflane_jax.models.host import Host, HostConfig
from tflane_jax.models.lane_decoder import (
    ElementEmbedding,
    LaneDecoderLayer,
    LaneHeads,
    attention_reference,
    lane_position,
    make_prediction,
    next_reference,
)
from tflane_jax.models.lane_denoising import DenoisingConfig, decode_lanes, lane_auxiliary
from tflane_jax.models.lane_queries import PAPER_LANE_DECODER, LaneDecoderConfig
from tflane_jax.models.prior import HostQueries
from tflane_jax.models.priors import ByPrior, fuse_into_queries
from tflane_jax.scene import LaneGraph, Prediction


@dataclass(frozen=True, kw_only=True)
class TopoNetConfig(HostConfig):
    """Configuration of TopoNet; without priors, the vision-only baseline.

    Attributes:
        decoder: lane decoder.
        edge_weight: weight of neighbours in the scene graph.
        denoising: noised lanes in training (`models.lane_denoising`); None as in the paper.
        encoder, range, priors, elements: see `HostConfig`; elements need as many layers as the decoder.
    """

    decoder: LaneDecoderConfig = LaneDecoderConfig()
    edge_weight: PositiveOrZero = 0.6
    denoising: DenoisingConfig | None = None

    @property
    def query_dim(self) -> int:
        """Channels of a query."""
        return self.decoder.dim

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """Those of the lane decoder, and those of every host."""
        return (*lane_auxiliary(self.decoder, self.denoising), *super().auxiliary)

    @property
    def example_points(self) -> dict[str, tuple[int, str]]:
        """Lanes are compared point by point."""
        return {"lane_points": (self.decoder.points, "as many as it predicts for a lane (task.model.decoder.points)")}

    def build(self) -> TopoNet:
        """Return the Linen module; raises UserError where encoder, decoder and elements do not fit together."""
        check_settings(self)
        return TopoNet(self)

    def limits(self) -> Rules:
        """Those of a host with traffic elements."""
        yield from super().limits()
        yield from element_limits(self.elements, self.encoder, self.decoder.layers)


def paper_config() -> TopoNetConfig:
    """Return the published sizes: ResNet-50, 7 cameras, 200 x 100 cells, 200 lane and 100 element queries."""
    return TopoNetConfig(
        encoder=PAPER_CAMERA_ENCODER, decoder=PAPER_LANE_DECODER, elements=PAPER_ELEMENT_DECODER, initial="xavier"
    )


class TopoNet(Host):
    """From one example to the predictions of every decoder layer."""

    config: TopoNetConfig

    def decode_example(self, example, bev, elements, tokens, *, deterministic):
        return self.decode(bev, elements, tokens, example.lanes, deterministic=deterministic)

    @nn.compact
    def decode(
        self,
        bev: Float[Array, "h w e"],
        elements: ElementOutput | None = None,
        tokens: ByPrior | None = None,
        lanes: LaneGraph | None = None,
        *,
        deterministic: bool = True,
    ) -> Prediction:
        """Return lanes and topology of every decoder layer, from BEV features, traffic elements and prior tokens.

        Sows the queries of every layer as `layer_queries` if the collection `intermediates` is mutable.
        """
        return decode_lanes(self, self.config.decoder, bev, elements, tokens or {}, lanes, deterministic)

    def decode_queries(self, start, bev, elements, tokens, deterministic) -> Prediction:
        """Return the predictions of one set of queries; `start` as from `LaneQueries`."""
        config, spec, (queries, position, reference) = self.config.decoder, self.config.spec, start
        # No edges in the first layer.
        adjacency = jnp.zeros((config.queries, config.queries))
        element_edges = None if elements is None else jnp.zeros((config.queries, elements.logits.shape[1]))
        outputs = []
        for i in range(config.layers):
            placed = lane_position(config, i, position, reference)
            queries = fuse_into_queries(self.priors.by_name, tokens, i, HostQueries(queries, placed, reference))
            embedded = nodes = None
            if elements is not None and element_edges is not None:
                embed = ElementEmbedding(config, name=f"element_embedding_{i}")
                embedded = embed(elements.queries[i], deterministic=deterministic)
                nodes = ElementNodes(embedded, elements.logits[i], element_edges)
            layer = partial(LaneDecoderLayer, config, edge_weight=self.config.edge_weight, name=f"layer_{i}")
            inputs = queries, placed, attention_reference(reference, config), bev, adjacency, nodes
            queries = run_layer(self, layer, config, *inputs, deterministic=deterministic)
            self.sow("intermediates", "layer_queries", queries)
            heads = LaneHeads(config, spec.bev_range, limits=spec.range, name=f"heads_{i}")
            output = heads(queries, reference, bev, embedded)
            outputs.append(output)
            reference = next_reference(reference, output.unit, config)
            if output.successor is not None:
                adjacency = edge_probabilities(output.successor)
            if output.element_lane is not None:
                element_edges = edge_probabilities(output.element_lane)
        return make_prediction(outputs, elements)
