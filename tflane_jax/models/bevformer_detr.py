"""BEVFormer-DETR, OpenLane-V2's large baseline: lanes and traffic elements found alone, related afterwards.

Reference: specs/modules.md section 9. Next to TopoNet there is no graph in the decoder: plain feed-forward parts, and
relationship heads on the queries of the last layers only. A lane is 11 points or a Bezier curve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry.bezier import bezier_basis
from tflane_jax.models.element_decoder import ElementDecoderConfig, ElementOutput
from tflane_jax.models.lane_decoder import (
    LaneDecoderConfig,
    LaneDecoderLayer,
    LaneHeads,
    LaneQueries,
    make_prediction,
)
from tflane_jax.scene import Prediction


@dataclass(frozen=True)
class BevFormerDetrConfig:
    """The model.

    Attributes:
        decoder: lane decoder; references never move (`refine="fixed"`).
        elements: traffic elements in the front view, or None.
        control_points: a lane is a Bezier curve of so many control points, read at `decoder.points` points; None: a
            lane is its points. Goes with the loss's setting of the same name.
    """

    decoder: LaneDecoderConfig = LaneDecoderConfig(refine="fixed")
    elements: ElementDecoderConfig | None = ElementDecoderConfig()
    control_points: int | None = None

    def build(self) -> BevFormerDetr:
        """Return the Linen module."""
        return BevFormerDetr(self)


class BevFormerDetr(nn.Module):
    """One example in, the predictions of every decoder layer out."""

    config: BevFormerDetrConfig

    @nn.compact
    def decode(
        self, bev: Float[Array, "h w e"], elements: ElementOutput | None = None, *, deterministic: bool = True
    ) -> Prediction:
        """Return lanes of every decoder layer and the topology of the last, from BEV features and traffic elements.

        Stores the queries of every layer as the intermediate `layer_queries` where a caller asks for it.
        """
        controls, config = self.config.control_points, self.config.decoder
        if controls is not None:
            config = replace(config, points=controls)
        queries, position, reference = LaneQueries(config, name="queries")()
        outputs = []
        for i in range(config.layers):
            last = i == config.layers - 1
            layer = LaneDecoderLayer(config, name=f"layer_{i}")
            queries = layer(queries, position, reference, bev, None, deterministic=deterministic)
            self.sow("intermediates", "layer_queries", queries)
            seen = None if elements is None else elements.queries[i]
            output = LaneHeads(config, relations=last, name=f"heads_{i}")(queries, reference, bev, seen)
            if controls is not None:
                basis = jnp.asarray(bezier_basis(self.config.decoder.points, controls), output.points.dtype)
                output = output._replace(points=jnp.einsum("pk,qkc->qpc", basis, output.points))
            outputs.append(output)
        return make_prediction(outputs, elements)
