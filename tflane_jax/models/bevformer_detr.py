"""BEVFormer-DETR, OpenLane-V2's large baseline (docs/reference/toponet.md).

Unlike TopoNet, the decoder has plain feed-forward blocks instead of a scene graph, and only the last layer has
relationship heads. A lane is 11 points or a Bezier curve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry.bezier import bezier_basis, bezier_fit
from tflane_jax.layers.precision import run_layer
from tflane_jax.limits import Rules, check_settings, counted
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName
from tflane_jax.models.camera_encoder import PAPER_CAMERA_ENCODER, CameraEncoderConfig
from tflane_jax.models.element_decoder import PAPER_ELEMENT_DECODER, ElementDecoderConfig, ElementOutput
from tflane_jax.models.encoders import EncoderConfig, element_limits
from tflane_jax.models.host import Host, HostConfig
from tflane_jax.models.lane_decoder import LaneDecoderLayer, LaneHeads, attention_reference, make_prediction
from tflane_jax.models.lane_denoising import DenoisingConfig, decode_lanes, lane_auxiliary
from tflane_jax.models.lane_queries import PAPER_LANE_DECODER, LaneDecoderConfig
from tflane_jax.models.prior import HostQueries
from tflane_jax.models.priors import ByPrior, fuse_into_queries
from tflane_jax.scene import LaneGraph, Prediction


@dataclass(frozen=True, kw_only=True)
class BevFormerDetrConfig(HostConfig):
    """Configuration of BEVFormer-DETR.

    Attributes:
        decoder: lane decoder; its reference points must be fixed (`refine="fixed"`).
        control_points: number of control points of a predicted Bezier curve, which is sampled at `decoder.points`
            points; None: the points are predicted. The loss compares control points or points accordingly.
        denoising: noised lanes in training (`models.lane_denoising`); None as in the baseline.
        encoder, range, priors, elements: see `HostConfig`; elements need as many layers as the decoder.
    """

    encoder: EncoderConfig = CameraEncoderConfig()
    decoder: LaneDecoderConfig = LaneDecoderConfig(refine="fixed")
    elements: ElementDecoderConfig | None = ElementDecoderConfig()
    control_points: Annotated[int, counted(2)] | None = None
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
        """Lanes are compared point by point; control points are fitted to points at equal steps of the parameter."""
        return {"lane_points": (self.decoder.points, "as many as it predicts for a lane (task.model.decoder.points)")}

    def build(self) -> BevFormerDetr:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        check_settings(self)
        return BevFormerDetr(self)

    def limits(self) -> Rules:
        """Those of a host with traffic elements, references that stay, and control points that points determine."""
        yield from super().limits()
        yield from element_limits(self.elements, self.encoder, self.decoder.layers)
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


class BevFormerDetr(Host):
    """From one example to the predictions of every decoder layer."""

    config: BevFormerDetrConfig

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
        """Return lanes of every decoder layer and the topology of the last, from BEV features and prior tokens.

        Sows the queries of every layer as `layer_queries` if the collection `intermediates` is mutable.
        """
        return decode_lanes(self, self._lines(), bev, elements, tokens or {}, self._in_controls(lanes), deterministic)

    def _lines(self) -> LaneDecoderConfig:
        """Return the decoder's sizes, with `points` the number of predicted (control) points."""
        controls = self.config.control_points
        return self.config.decoder if controls is None else replace(self.config.decoder, points=controls)

    def _in_controls(self, lanes: LaneGraph | None) -> LaneGraph | None:
        """Return true lanes for denoising with as many points as the heads predict: control points where they do."""
        controls = self.config.control_points
        if controls is None or lanes is None or not self.is_mutable_collection(AUXILIARY):
            return lanes
        points = jnp.asarray(lanes.points)
        fit = jnp.asarray(bezier_fit(points.shape[-2], controls), points.dtype)
        return replace(lanes, points=jnp.einsum("kp,npc->nkc", fit, points, precision="highest"))

    def decode_queries(self, start, bev, elements, tokens, deterministic) -> Prediction:
        """Return the predictions of one set of queries; `start` as from `LaneQueries`."""
        controls, config, spec = self.config.control_points, self._lines(), self.config.spec
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
