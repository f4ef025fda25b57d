"""BEVFormer-DETR, OpenLane-V2's large baseline (docs/reference/toponet.md).

Unlike TopoNet, the decoder has plain feed-forward blocks instead of a scene graph, and only the last layer has
relationship heads. A lane is 11 points or a Bezier curve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import jax.numpy as jnp

from tflane_jax.geometry.bezier import bezier_basis, bezier_fit
from tflane_jax.layers.precision import run_layer
from tflane_jax.limits import Rules, check_settings, counted
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.camera_encoder import PAPER_CAMERA_ENCODER, CameraEncoderConfig
from tflane_jax.models.element_decoder import PAPER_ELEMENT_DECODER, ElementDecoderConfig
from tflane_jax.models.encoders import EncoderConfig
from tflane_jax.models.lane_decoder import LaneDecoderLayer, LaneHeads, attention_reference, make_prediction
from tflane_jax.models.lane_host import LaneHost, LaneHostConfig
from tflane_jax.models.lane_queries import PAPER_LANE_DECODER, LaneDecoderConfig
from tflane_jax.models.prior import HostQueries
from tflane_jax.models.priors import fuse_into_queries
from tflane_jax.scene import Example, LaneGraph, Prediction


@dataclass(frozen=True, kw_only=True)
class BevFormerDetrConfig(LaneHostConfig):
    """Configuration of BEVFormer-DETR.

    Attributes:
        control_points: number of control points of a predicted Bezier curve, which is sampled at `decoder.points`
            points; None: the points are predicted. The loss compares control points or points accordingly.
        decoder: lane decoder; its reference points must be fixed (`refine="fixed"`).
        encoder, range, priors, elements, denoising: see `LaneHostConfig`.
    """

    encoder: EncoderConfig = CameraEncoderConfig()
    decoder: LaneDecoderConfig = LaneDecoderConfig(refine="fixed")
    elements: ElementDecoderConfig | None = ElementDecoderConfig()
    control_points: Annotated[int, counted(2)] | None = None

    @property
    def lines(self) -> LaneDecoderConfig:
        """The decoder's sizes, with `points` the number of predicted (control) points."""
        return self.decoder if self.control_points is None else replace(self.decoder, points=self.control_points)

    def build(self) -> BevFormerDetr:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        check_settings(self)
        return BevFormerDetr(self)

    def limits(self) -> Rules:
        """Those of a host of lanes, references that stay, and control points that points determine."""
        yield from super().limits()
        yield "decoder.refine", self.decoder.refine == "fixed", "fixed: the references of BEVFormer-DETR never move"
        if self.control_points is not None:
            points = self.decoder.points
            yield "control_points", self.control_points <= points, f"at most decoder.points ({points}), or None"
            alone = self.decoder.proposals is None
            yield "decoder.proposals", alone, "None with control_points: proposals are points of a lane"


def paper_config(control_points: int | None = 5) -> BevFormerDetrConfig:
    """Return the published sizes of OpenLane-V2's large baseline; SMERF's copy has `control_points=None`."""
    decoder = replace(PAPER_LANE_DECODER, queries=100)
    return BevFormerDetrConfig(
        encoder=PAPER_CAMERA_ENCODER,
        decoder=decoder,
        elements=PAPER_ELEMENT_DECODER,
        initial="xavier",
        control_points=control_points,
    )


class BevFormerDetr(LaneHost):
    """From one example to the predictions of every decoder layer."""

    config: BevFormerDetrConfig

    def true_lanes(self, example: Example) -> LaneGraph | None:
        """Return the true lanes, as control points where these are predicted."""
        controls, lanes = self.config.control_points, example.lanes
        if controls is None or lanes is None or not self.is_mutable_collection(AUXILIARY):
            return lanes
        points = jnp.asarray(lanes.points)
        fit = jnp.asarray(bezier_fit(points.shape[-2], controls), points.dtype)
        return replace(lanes, points=jnp.einsum("kp,npc->nkc", fit, points, precision="highest"))

    def decode_queries(self, start, bev, elements, tokens, deterministic) -> Prediction:
        controls, config, spec = self.config.control_points, self.config.lines, self.config.spec
        queries, position, reference = start
        outputs = []
        for i in range(config.layers):
            last = i == config.layers - 1
            queries = fuse_into_queries(self.priors.by_name, tokens, i, HostQueries(queries, position, reference))
            layer = partial(LaneDecoderLayer, config, name=f"layer_{i}")
            inputs = queries, position, attention_reference(reference, config), bev, None
            queries = run_layer(self, layer, config, *inputs, deterministic=deterministic)
            self.sow("intermediates", "layer_queries", queries)
            element_queries = None if elements is None else elements.queries[i]
            heads = LaneHeads(config, spec.bev_range, last, spec.range, name=f"heads_{i}")
            output = heads(queries, reference, bev, element_queries)
            if controls is not None:
                basis = jnp.asarray(bezier_basis(self.config.decoder.points, controls), output.points.dtype)
                points = jnp.einsum("pk,qkc->qpc", basis, output.points, precision="highest")
                output = output._replace(points=points)
            outputs.append(output)
        return make_prediction(outputs, elements)
