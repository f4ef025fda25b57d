"""What all hosts share: an example goes in, BEV features and traffic elements are made of it, lanes come out."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.bev_encoder import BevMemory, Fuse
from tflane_jax.models.camera_encoder import EncoderConfig, empty_memory, look, make_encoder
from tflane_jax.models.element_decoder import ElementDecoder, ElementOutput
from tflane_jax.models.lane_denoising import NoisedQueries
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneQueries
from tflane_jax.models.marker_fusion import (
    MarkerFusion,
    MarkerFusionConfig,
    MarkerTokens,
    empty_marker_memory,
    fusion_gate,
    fusion_mask,
    guide_frame,
)
from tflane_jax.models.sd_map_encoder import SdMapEncoder, SdMapFusion, sd_map_mask
from tflane_jax.priors.marker_memory import MarkerGuidance, MarkerMemory
from tflane_jax.scene import Example, LaneGraph, Prediction


@struct.dataclass
class HostMemory:
    """What a host carries from frame to frame; what it does not use is None.

    Attributes:
        bev: BEV features of the frame before.
        markers: lanes that markers gave in the last frames.
    """

    bev: BevMemory | None = None
    markers: MarkerMemory | None = None


class Host(nn.Module):
    """A model from an example to the predictions of every decoder layer; subclasses say how lanes are decoded.

    Attributes:
        config: has `encoder` and `decoder`, and `elements`, `markers` and `sd_map`, each None in a host without.
    """

    config: Any

    def setup(self):
        config = self.config
        self.encoder = make_encoder(config.encoder)
        if config.elements is not None:
            self.elements = ElementDecoder(config.elements)
        if config.markers is not None:
            self.marker_tokens = MarkerTokens(config.markers, config.decoder.range)
        if config.sd_map is not None:
            self.sd_map_tokens = SdMapEncoder(config.sd_map)

    def __call__(self, example: Example, memory: HostMemory | None = None, *, train: bool = False) -> Prediction:
        """Return predictions with a leading axis over decoder layers; the last one is the answer."""
        return self.step(example, memory, train=train)[0]

    def step(
        self, example: Example, memory: HostMemory | None = None, *, train: bool = False
    ) -> tuple[Prediction, HostMemory]:
        """Return what `__call__` does, and the memory for the next frame.

        Args:
            example: one frame.
            memory: of the frame before it; None is a frame on its own. No gradient flows through its BEV features.
            train: dropout, which needs the key `dropout`, and the batch's own statistics.

        Raises:
            UserError: the example lacks what the model reads.
        """
        memory = memory or HostMemory()
        guide, markers = None, memory.markers
        if self.config.markers is not None:
            guide, markers = guide_frame(example, memory.markers, self.config.markers)
        answer, bev = self.answer(example, memory.bev, guide, train=train)
        return answer, HostMemory(bev, markers)

    def answer(
        self, example: Example, memory: BevMemory | None, guide: MarkerGuidance | None, *, train: bool = False
    ) -> tuple[Prediction, BevMemory | None]:
        """Return predictions and BEV features for the next frame, from what markers tell of this one: the part of
        `step` that learns.
        """
        seen = look(self.encoder, example, memory, train=train, fuse=self._priors(example, guide, not train))
        elements = None
        if self.config.elements is not None and seen.front is not None:
            elements = self.elements(*seen.front, deterministic=not train)
        return self.decode_example(example, seen.bev, elements, deterministic=not train), seen.memory

    def _priors(self, example: Example, guide: MarkerGuidance | None, deterministic: bool) -> Fuse | None:
        """Return what the priors add to every layer of the BEV encoder."""
        markers, sd_map = self.config.markers, self.config.sd_map
        fusions = []
        if sd_map is not None:
            lines = self.sd_map_tokens(example.sd_map, deterministic=deterministic)
            fusions.append(
                lambda layer, cells, bev, position: SdMapFusion(sd_map, name=f"sd_map_{layer}")(
                    bev, position, *lines, sd_map_mask(example.sd_map, cells, sd_map)
                )
            )
        if markers is not None and guide is not None:
            tokens, (gate, valid) = self.marker_tokens(guide, deterministic=deterministic), fusion_gate(guide, markers)
            fusions.append(
                lambda layer, cells, bev, position: MarkerFusion(markers, name=f"markers_{layer}")(
                    bev, position, tokens, fusion_mask(guide, valid, cells, markers), gate
                )
            )

        def fuse(layer: int, places: Any, bev: Float[Array, "q c"], position: Float[Array, "q c"]):
            cells = self.config.decoder.range.denormalise(jnp.asarray(places))
            for each in fusions:
                bev = each(layer, cells, bev, position)
            return bev

        return fuse if fusions else None

    def decode_example(
        self, example: Example, bev: Float[Array, "h w e"], elements: ElementOutput | None, *, deterministic: bool
    ) -> Prediction:
        """Return lanes and topology of every decoder layer; a host with priors reads them from the example."""
        raise NotImplementedError


def start_memory(encoder: EncoderConfig, markers: MarkerFusionConfig | None) -> HostMemory:
    """Return the memory of a host before the first frame of a sequence."""
    return HostMemory(empty_memory(encoder), None if markers is None else empty_marker_memory(markers))


def decode_lanes(
    host: Any,
    config: LaneDecoderConfig,
    bev: Float[Array, "h w e"],
    elements: ElementOutput | None,
    priors: Any,
    lanes: LaneGraph | None,
    deterministic: bool,
) -> Prediction:
    """Return what the learned queries say; what the denoising queries say goes to the loss, where that asks.

    Both go through one decoder and know nothing of each other.

    Args:
        host: has the decoder, `decode_queries(start, bev, elements, priors, deterministic)`, where `start` is what
            `LaneQueries` returns, and `config.denoising`.
        config: of the queries.
        bev, elements, priors, deterministic: handed on.
        lanes: truth to denoise; nothing else looks at it.
    """
    start, noise = LaneQueries(config, name="queries")(), host.config.denoising
    if noise is None or lanes is None or not host.is_mutable_collection(AUXILIARY):
        return host.decode_queries(start, bev, elements, priors, deterministic)
    noised = NoisedQueries(config, noise, name="noised")(lanes)
    starts = jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), start, noised)
    decode = nn.vmap(
        type(host).decode_queries,
        in_axes=(0, None, None, None, None),  # pyright: ignore[reportArgumentType]
        variable_axes={"params": None, "intermediates": 0},
        split_rngs={"params": False, "dropout": True},
    )
    every = decode(host, starts, bev, elements, priors, deterministic)
    host.sow(AUXILIARY, "denoised", jax.tree.map(lambda leaf: leaf[1:], every.lanes))
    return jax.tree.map(lambda leaf: leaf[0], every)
