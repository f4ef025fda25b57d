"""MapTR (Liao et al. 2023), with or without priors: the lines of a vector map, by class.

Images -> BEV features -> instance and point queries -> (priors) -> decoder layers, each moving all points -> classes
and points of every layer. The small version reads BEV evidence instead of images; decoder, heads and losses are the
same. Source: docs/reference/maptr.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.layers.fpn import FeaturePyramidConfig
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.host import Host, HostConfig
from tflane_jax.models.image_encoder import PAPER_IMAGE_ENCODER
from tflane_jax.models.lane_denoising import DenoisingConfig, decode_groups
from tflane_jax.models.map_lines import (
    PAPER_LINE_DECODER,
    LineDecoderConfig,
    LineOutput,
    LineQueries,
    NoisedLines,
    PointQueries,
    decode_line_layers,
)
from tflane_jax.models.parameters import with_equal_heads
from tflane_jax.models.priors import ByPrior, fuse_into_queries
from tflane_jax.scene import LinePrediction, MapLines, Prediction


@dataclass(frozen=True, kw_only=True)
class MapTrConfig(HostConfig):
    """Configuration of MapTR; without priors, the vision-only baseline.

    Attributes:
        decoder: decoder of map lines.
        denoising: noised lines in training (`models.lane_denoising`), with `decoder.anchors="spread"` only; None as in
            the paper.
        encoder, range, priors: see `HostConfig`. MapTR predicts no traffic elements.
    """

    decoder: LineDecoderConfig = LineDecoderConfig()
    denoising: DenoisingConfig | None = None

    truth: ClassVar[tuple[str, ...]] = ("map_lines",)
    predicts: ClassVar[tuple[str, ...]] = ("lines",)
    query_type: ClassVar[Literal["instance", "point"]] = "point"

    @property
    def query_dim(self) -> int:
        """Channels of a query."""
        return self.decoder.dim

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """The denoised lines, and the outputs of every host."""
        return (*(() if self.denoising is None else ("denoised",)), *super().auxiliary)

    @property
    def example_points(self) -> dict[str, int]:
        """Lines are compared point by point."""
        return {"map_lines.points": self.decoder.points}

    def build(self) -> Host:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        self.check()
        return MapTr(self)

    def check(self) -> None:
        """Raise UserError where parts do not fit together."""
        if self.elements is not None:
            raise UserError("MapTR predicts no traffic elements: set task.model.elements to None")
        if self.encoder.cells:
            raise UserError("BEV cells learn directed lanes, which MapTR's truth lacks: unset task.model.encoder.cells")
        if self.denoising is not None and self.decoder.anchors != "spread":
            raise UserError(
                "queries on noised lines must know where their points are: set task.model.decoder.anchors to spread, "
                "or task.model.denoising to None"
            )


PAPER_RANGE = PerceptionRange((-30.0, 30.0), (-15.0, 15.0), (-2.0, 2.0))
"""60 m along the vehicle's axis and 30 m across it, as the paper has them."""
PAPER_MAP_ENCODER = CameraEncoderConfig(
    replace(PAPER_IMAGE_ENCODER, stages=(3,), pyramid=FeaturePyramidConfig(256, 1)),
    BevFormerConfig(BevGrid(PAPER_RANGE, 100, 200), layers=1, levels=1, cameras=6, attention="kernel"),
)


def paper_config() -> MapTrConfig:
    """Return the published sizes (tiny, GKT): ResNet-50, six cameras, 200 x 100 cells, 50 lines of 20 points."""
    return MapTrConfig(encoder=PAPER_MAP_ENCODER, range=PAPER_RANGE, decoder=PAPER_LINE_DECODER)


class MapTr(Host):
    """From one example to the predictions of every decoder layer."""

    config: MapTrConfig

    @nn.nowrap
    def init(self, *args: Any, **kwargs: Any) -> Any:
        """Return initial variables, as Linen does; the heads of all layers start as copies of the first layer's."""
        return with_equal_heads(super().init(*args, **kwargs), self.config.decoder.layers)

    def decode_example(self, example, bev, elements, tokens, *, deterministic):
        return self.decode(bev, tokens, example.map_lines, deterministic=deterministic)

    @nn.compact
    def decode(
        self,
        bev: Float[Array, "h w e"],
        tokens: ByPrior | None = None,
        lines: MapLines | None = None,
        *,
        deterministic: bool = True,
    ) -> Prediction:
        """Return the lines of every decoder layer from BEV features and prior tokens.

        Args:
            bev: BEV features, row 0 at the smallest y, column 0 at the smallest x.
            tokens: of the priors, by name.
            lines: ground truth to denoise; not used otherwise.
            deterministic: no dropout.
        """
        return self.decode_one_to_one(bev, tokens, lines, deterministic)

    def decode_one_to_one(self, bev, tokens, lines, deterministic) -> Prediction:
        """Return the predictions of the learned queries, and sow those of noised ones in training; in `decode`."""
        config, range_ = self.config, self.config.spec.bev_range
        start = LineQueries(config.decoder, range_, name="queries")()
        rest = bev, None, tokens or {}, deterministic
        if config.denoising is None or lines is None or not self.is_mutable_collection(AUXILIARY):
            return self.decode_queries(start, *rest)
        noised = NoisedLines(config.decoder, config.denoising, range_, name="noised")(lines)
        return decode_groups(self, start, noised, *rest)

    def decode_queries(self, start: PointQueries, bev, elements, tokens, deterministic) -> Prediction:
        """Return the predictions of one set of queries."""
        spec, priors = self.config.spec, self.priors.by_name
        outputs = decode_line_layers(
            self,
            self.config.decoder,
            start,
            bev,
            spec.bev_range,
            spec.range,
            deterministic=deterministic,
            fuse=lambda layer, queries: fuse_into_queries(priors, tokens, layer, queries),
        )
        return make_prediction(outputs)


def make_prediction(outputs: list[LineOutput]) -> Prediction:
    """Return lines with a leading axis over decoder layers."""
    layers: LineOutput = jax.tree.map(lambda *leaves: jnp.stack(leaves), *outputs)
    return Prediction(lines=LinePrediction(layers.points, layers.logits))
