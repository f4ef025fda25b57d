"""LaneSegNet (Li et al. 2024), with or without priors: lane segments with boundaries, line types and topology.

Images -> BEV encoder (SD map, markers, optional traffic raster) -> segment queries -> decoder layers (traffic flow
before each) -> centerlines, boundaries, line types, classes, masks -> topology of the last layer. The small version
reads BEV evidence instead of images; decoder, heads and losses are the same. The map-element-bucket variant has
decoders of their own for areas and traffic elements. Source: docs/reference/lanesegnet.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.layers.precision import run_layer
from tflane_jax.limits import Rules, check_settings
from tflane_jax.models.area_decoder import PAPER_AREA_DECODER, AreaDecoder, AreaDecoderConfig
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.camera_encoder import PAPER_CAMERA_ENCODER
from tflane_jax.models.element_decoder import PAPER_ELEMENT_DECODER
from tflane_jax.models.lane_decoder import LaneDecoderLayer, lane_position, relate
from tflane_jax.models.lane_host import LaneHost, LaneHostConfig
from tflane_jax.models.lane_segments import (
    PAPER_SEGMENT_DECODER,
    SegmentDecoderConfig,
    SegmentHeads,
    SegmentOutput,
    regions,
)
from tflane_jax.models.parameters import with_equal_heads
from tflane_jax.models.prior import HostQueries
from tflane_jax.models.priors import fuse_into_queries
from tflane_jax.models.segment_truth import Center, ordered_targets, target_lanes
from tflane_jax.scene import ElementPrediction, Example, LaneGraph, Prediction, SegmentPrediction


@dataclass(frozen=True, kw_only=True)
class LaneSegNetConfig(LaneHostConfig):
    """Configuration of LaneSegNet; without priors, the vision-only baseline.

    Attributes:
        decoder: segment decoder.
        last_step: "twice": outside training, the last layer's change of the centerline is applied to its own result
            once more. The published code does so by mistake, and its weights reach their published numbers with it.
        center: the centerline that is learned, see `segment_truth.segment_targets`.
        areas: decoder of crossings and road boundaries, as in the map-element-bucket variant; crossings are then no
            class of the segments (`decoder.classes=1`). None: crossings are segments of the second class.
        encoder, range, priors, elements, denoising: see `LaneHostConfig`.
    """

    decoder: SegmentDecoderConfig = SegmentDecoderConfig()
    last_step: Literal["once", "twice"] = "once"
    center: Center = "mean"
    areas: AreaDecoderConfig | None = None

    truth: ClassVar[tuple[str, ...]] = ("segments", "areas")
    predicts: ClassVar[tuple[str, ...]] = ("segments",)
    elements_of: ClassVar[Literal["centerlines", "segments"]] = "segments"

    @property
    def wanted_truth(self) -> tuple[str, ...]:
        """Segments; crossings too where they are segments of the second class."""
        return self.truth if self.areas is None else ("segments",)

    @property
    def example_points(self) -> dict[str, tuple[int, str]]:
        """Segments and areas are compared point by point; a crossing that is a segment has two sides."""
        points = self.decoder.points
        if self.areas is None:
            areas = 2 * points, f"two sides of a crossing with {points} points each (task.model.decoder.points)"
        else:
            areas = self.areas.points, "as many as it predicts for an area (task.model.areas.points)"
        return {
            "segment_points": (points, "as many as it predicts for a segment (task.model.decoder.points)"),
            "area_points": areas,
        }

    @property
    def example_forms(self) -> dict[str, tuple[str, str]]:
        """A crossing is a segment with two sides, or an area, which is a ring."""
        if self.areas is None:
            return {"crossings": ("sides", "it learns a crossing as a segment, by its two long sides")}
        return {"crossings": ("ring", "it learns a crossing as an area, by its outline (task.model.areas)")}

    def build(self) -> LaneSegNet:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        check_settings(self)
        return LaneSegNet(self)

    def limits(self) -> Rules:
        """Those of a host of lanes; crossings are a class of segments or areas with their own decoder."""
        yield from super().limits()
        fits = (self.areas is None) == (self.decoder.classes == 2)
        yield "decoder.classes", fits, "1 with areas, which then hold the crossings, and 2 without (areas is None)"


def paper_config() -> LaneSegNetConfig:
    """Return the published sizes: ResNet-50, 7 cameras, 200 x 100 cells, 200 queries of 10 points."""
    return LaneSegNetConfig(encoder=PAPER_CAMERA_ENCODER, decoder=PAPER_SEGMENT_DECODER, initial="xavier")


def paper_bucket_config() -> LaneSegNetConfig:
    """Return the sizes of the map-element-bucket variant: six encoder layers, areas and traffic elements."""
    encoder = replace(PAPER_CAMERA_ENCODER, bev=replace(PAPER_CAMERA_ENCODER.bev, layers=6))
    decoder = replace(PAPER_SEGMENT_DECODER, classes=1)
    return replace(
        paper_config(), encoder=encoder, decoder=decoder, areas=PAPER_AREA_DECODER, elements=PAPER_ELEMENT_DECODER
    )


class LaneSegNet(LaneHost):
    """From one example to the predictions of every decoder layer."""

    config: LaneSegNetConfig

    @nn.nowrap
    def init(self, *args: Any, **kwargs: Any) -> Any:
        """Return initial variables, as Linen does; the heads of all layers start as copies of the first layer's."""
        config = self.config
        variables = with_equal_heads(super().init(*args, **kwargs), config.decoder.layers)
        return variables if config.areas is None else with_equal_heads(variables, config.areas.layers, "areas")

    def true_lanes(self, example: Example) -> LaneGraph | None:
        """Return the centerlines of the true segments where training needs them."""
        config, learned = self.config, {"denoised", "lane_proposals"} & set(self.config.auxiliary)
        if not learned or example.segments is None or not self.is_mutable_collection(AUXILIARY):
            return None
        return target_lanes(ordered_targets(example.segments, example.areas, config.center, config.decoder.classes))

    @nn.compact
    def decode(self, bev, elements=None, tokens=None, lanes=None, *, deterministic=True) -> Prediction:
        """Return segments of every decoder layer, the topology of the last, and areas; see `LaneHost.decode`.

        Masks are predicted in training only.
        """
        config, spec = self.config, self.config.spec
        found = self.decode_lanes(bev, elements, tokens or {}, lanes, deterministic)
        if config.areas is None:
            return found
        assert found.segments is not None
        areas = AreaDecoder(config.areas, spec.bev_range, spec.range, name="areas")(bev, deterministic=deterministic)
        return replace(found, segments=replace(found.segments, areas=areas))

    def decode_queries(self, start, bev, elements, tokens, deterministic) -> Prediction:
        config, spec, (queries, position, reference) = self.config.decoder, self.config.spec, start
        training = not deterministic
        # Both boundaries start at the centerline.
        around = regions(reference, reference, config)
        outputs = []
        for i in range(config.layers):
            placed = lane_position(config, i, position, reference)
            queries = fuse_into_queries(self.priors.by_name, tokens, i, HostQueries(queries, placed, reference))
            layer, inputs = partial(LaneDecoderLayer, config, "star", name=f"layer_{i}"), (queries, placed, around, bev)
            queries = run_layer(self, layer, config, *inputs, None, deterministic=deterministic)
            self.sow("intermediates", "layer_queries", queries)
            heads = SegmentHeads(config, spec.bev_range, spec.range, name=f"heads_{i}")
            output = heads(queries, reference, bev, masks=training or self.is_initializing())
            reference = lax.stop_gradient(output.unit)
            if i == config.layers - 1 and not training and self.config.last_step == "twice":
                output = heads(queries, reference, bev)
            outputs.append(output)
            boundaries = [spec.bev_range.normalise(line) for line in (output.left, output.right)]
            around = lax.stop_gradient(regions(*boundaries, config))
        successor = relate(self, config, "successor", queries, queries)
        found = make_prediction(outputs, successor)
        if elements is None:
            return found
        # Only the queries of the last layer meet the segments.
        governed = relate(self, config, "element_lane", queries, elements.queries[-1])
        return replace(found, elements=ElementPrediction(elements.box, elements.logits, governed[None]))


def make_prediction(outputs: list[SegmentOutput], successor: Float[Array, "q q"]) -> Prediction:
    """Return segments with a leading axis over decoder layers; that of the topology has length 1, for the last."""
    with_masks = all(output.mask is not None for output in outputs)
    each = [output if with_masks else output._replace(mask=None) for output in outputs]
    layers: SegmentOutput = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return Prediction(
        segments=SegmentPrediction(
            points=layers.points,
            left=layers.left,
            right=layers.right,
            logits=layers.logits,
            left_type_logits=layers.left_type,
            right_type_logits=layers.right_type,
            mask_logits=layers.mask,
            successor_logits=successor[None],
        )
    )
