"""TopoNet (Li et al. 2023), with or without priors.

Images -> BEV encoder (SD map, markers, optional traffic raster) -> lane queries -> decoder layers (traffic flow before
each) -> centerlines, scores, lane-lane topology.
Front view -> traffic elements -> the decoder's scene graph -> lane-element topology.
The small version reads BEV evidence instead of images and has no traffic elements; decoder, graph, heads and losses
are the same. Source: docs/reference/toponet.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp

from tflane_jax.layers.graph import ElementNodes, edge_probabilities
from tflane_jax.layers.precision import run_layer
from tflane_jax.limits import PositiveOrZero, check_settings
from tflane_jax.models.camera_encoder import PAPER_CAMERA_ENCODER
from tflane_jax.models.element_decoder import PAPER_ELEMENT_DECODER
from tflane_jax.models.lane_decoder import (
    ElementEmbedding,
    LaneDecoderLayer,
    LaneHeads,
    attention_reference,
    lane_position,
    make_prediction,
    next_reference,
)
from tflane_jax.models.lane_host import LaneHost, LaneHostConfig
from tflane_jax.models.lane_queries import PAPER_LANE_DECODER
from tflane_jax.models.prior import HostQueries
from tflane_jax.models.priors import fuse_into_queries
from tflane_jax.scene import Prediction


@dataclass(frozen=True, kw_only=True)
class TopoNetConfig(LaneHostConfig):
    """Configuration of TopoNet; without priors, the vision-only baseline.

    Attributes:
        edge_weight: weight of neighbours in the scene graph.
        encoder, range, priors, elements, decoder, denoising: see `LaneHostConfig`.
    """

    edge_weight: PositiveOrZero = 0.6

    def build(self) -> TopoNet:
        """Return the Linen module; raises UserError where encoder, decoder and elements do not fit together."""
        check_settings(self)
        return TopoNet(self)


def paper_config() -> TopoNetConfig:
    """Return the published sizes: ResNet-50, 7 cameras, 200 x 100 cells, 200 lane and 100 element queries."""
    return TopoNetConfig(
        encoder=PAPER_CAMERA_ENCODER, decoder=PAPER_LANE_DECODER, elements=PAPER_ELEMENT_DECODER, initial="xavier"
    )


class TopoNet(LaneHost):
    """From one example to the predictions of every decoder layer."""

    config: TopoNetConfig

    def decode_queries(self, start, bev, elements, tokens, deterministic) -> Prediction:
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
