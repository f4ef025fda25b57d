"""Base classes of the hosts whose queries are lanes: TopoNet, BEVFormer-DETR and LaneSegNet.

Read from top to bottom: `Host.__call__` encodes, `decode_example` adds the truth that training may use, `decode` makes
the queries, and `decode_queries`, which each host has of its own, decodes them layer by layer. The queries are the
papers' learned ones (`LaneQueries`) and, in small models, proposals and noised lanes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.limits import Rules
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.element_decoder import ElementOutput
from tflane_jax.models.host import Host, HostConfig
from tflane_jax.models.lane_denoising import DenoisingConfig, NoisedQueries, decode_groups
from tflane_jax.models.lane_proposals import LaneProposals
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneQueries, LaneStart
from tflane_jax.models.priors import ByPrior
from tflane_jax.scene import Example, LaneGraph, Prediction


@dataclass(frozen=True, kw_only=True)
class LaneHostConfig(HostConfig):
    """Settings common to hosts with lane queries.

    Attributes:
        decoder: lane decoder.
        denoising: noised lanes in training (`models.lane_denoising`); None as in the papers.
        encoder, range, priors, elements: see `HostConfig`; elements need as many layers as the decoder.
    """

    decoder: LaneDecoderConfig = LaneDecoderConfig()
    denoising: DenoisingConfig | None = None

    abstract_base: ClassVar[bool] = True

    @property
    def query_dim(self) -> int:
        """Channels of a query."""
        return self.decoder.dim

    @property
    def lines(self) -> LaneDecoderConfig:
        """The decoder's sizes, where `points` are those that queries refer to and heads predict."""
        return self.decoder

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """Those of queries made in training, and those of every host."""
        made: dict[AuxiliaryName, object] = {"denoised": self.denoising, "lane_proposals": self.decoder.proposals}
        return (*(name for name, config in made.items() if config is not None), *super().auxiliary)

    @property
    def example_points(self) -> dict[str, tuple[int, str]]:
        """Lanes are compared point by point."""
        return {"lane_points": (self.decoder.points, "as many as it predicts for a lane (task.model.decoder.points)")}

    def limits(self) -> Rules:
        """Those of every host, and a front view for traffic elements, with as many layers as the lane decoder."""
        yield from super().limits()
        elements, encoder, layers = self.elements, self.encoder, self.decoder.layers
        if elements is None:
            return
        seen = isinstance(encoder, CameraEncoderConfig)
        yield "elements", seen, "None without an encoder of cameras: traffic elements are detected in the front image"
        fits = elements.layers == layers
        yield "elements.layers", fits, f"decoder.layers ({layers}): a lane layer reads the element layer of its index"
        if isinstance(encoder, CameraEncoderConfig):
            pyramid, name = encoder.images.pyramid, "encoder.images.pyramid"
            yield "elements.levels", elements.levels == pyramid.levels, f"{name}.levels ({pyramid.levels})"
            yield "elements.dim", elements.dim == pyramid.dim, f"{name}.dim ({pyramid.dim})"


class LaneHost(Host):
    """From one example to the predictions of every decoder layer; subclasses implement `decode_queries`."""

    config: LaneHostConfig

    def decode_example(self, example, bev, elements, tokens, *, deterministic):
        return self.decode(bev, elements, tokens, self.true_lanes(example), deterministic=deterministic)

    def true_lanes(self, example: Example) -> LaneGraph | None:
        """Return the lanes that denoising and proposals learn, in the form in which heads predict them."""
        return example.lanes

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
        """Return lanes and topology from BEV features, traffic elements and prior tokens.

        Sows the queries of every layer as `layer_queries` if the collection `intermediates` is mutable.

        Args:
            bev: BEV features, row 0 at the smallest y, column 0 at the smallest x.
            elements: outputs of the traffic-element decoder, or None.
            tokens: of the priors, by name.
            lanes: ground truth of denoising and proposals; not used otherwise.
            deterministic: no dropout, and the form of the evaluation.
        """
        return self.decode_lanes(bev, elements, tokens or {}, lanes, deterministic)

    def decode_lanes(
        self,
        bev: Float[Array, "h w e"],
        elements: ElementOutput | None,
        tokens: ByPrior,
        lanes: LaneGraph | None,
        deterministic: bool,
    ) -> Prediction:
        """Return the predictions of learned queries and proposals, and sow those of noised lanes as `denoised`.

        Both pass through the same decoder without exchanging information. To be called in `decode`, see there.
        """
        config, range_, noise = self.config.lines, self.config.spec.bev_range, self.config.denoising
        start = LaneQueries(config, range_, name="queries")()
        if config.proposals is not None:
            proposed = LaneProposals(config, range_, name="proposals")(bev, lanes)
            start = jax.tree.map(lambda *parts: jnp.concatenate(parts), start, proposed)
        rest = bev, elements, tokens, deterministic
        if noise is None or lanes is None or not self.is_mutable_collection(AUXILIARY):
            return self.decode_queries(start, *rest)
        noised = NoisedQueries(config, noise, range_, name="noised")(lanes)
        return decode_groups(self, start, noised, *rest)

    def decode_queries(
        self,
        start: LaneStart,
        bev: Float[Array, "h w e"],
        elements: ElementOutput | None,
        tokens: ByPrior,
        deterministic: bool,
    ) -> Prediction:
        """Return the predictions of one set of queries, with a leading axis over decoder layers.

        Args:
            start: the queries, as from `LaneQueries`.
            bev, tokens: see `decode`.
            elements: E traffic elements of every decoder layer: queries (D, E, C), boxes (D, E, 2, 2) in pixels, logits
                (D, E, K). Or None.
            deterministic: no dropout, and the form of the evaluation.
        """
        raise NotImplementedError
