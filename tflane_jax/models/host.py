"""What all hosts share: an example goes in, BEV features and traffic elements are made of it, lanes come out."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.bev_encoder import BevMemory
from tflane_jax.models.camera_encoder import look, make_encoder
from tflane_jax.models.element_decoder import ElementDecoder, ElementOutput
from tflane_jax.models.lane_denoising import NoisedQueries
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneQueries
from tflane_jax.scene import Example, LaneGraph, Prediction


class Host(nn.Module):
    """A model from an example to the predictions of every decoder layer; subclasses say how lanes are decoded.

    Attributes:
        config: has `encoder`, and `elements` that is None in a host without traffic elements.
    """

    config: Any

    def setup(self):
        self.encoder = make_encoder(self.config.encoder)
        if self.config.elements is not None:
            self.elements = ElementDecoder(self.config.elements)

    def __call__(self, example: Example, memory: BevMemory | None = None, *, train: bool = False) -> Prediction:
        """Return predictions with a leading axis over decoder layers; the last one is the answer."""
        return self.step(example, memory, train=train)[0]

    def step(
        self, example: Example, memory: BevMemory | None = None, *, train: bool = False
    ) -> tuple[Prediction, BevMemory | None]:
        """Return what `__call__` does, and the memory for the next frame (None for a model without cameras).

        Args:
            example: one frame.
            memory: of the frame before it; None is a frame on its own. No gradient flows through it.
            train: dropout, which needs the key `dropout`, and the batch's own statistics.

        Raises:
            UserError: the example lacks what the model reads.
        """
        seen = look(self.encoder, example, memory, train=train)
        elements = None
        if self.config.elements is not None and seen.front is not None:
            elements = self.elements(*seen.front, deterministic=not train)
        return self.decode_example(example, seen.bev, elements, deterministic=not train), seen.memory

    def decode_example(
        self, example: Example, bev: Float[Array, "h w e"], elements: ElementOutput | None, *, deterministic: bool
    ) -> Prediction:
        """Return lanes and topology of every decoder layer; a host with priors reads them from the example."""
        raise NotImplementedError


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
        type(host).decode_queries, in_axes=(0, None, None, None, None),  # pyright: ignore[reportArgumentType]
        variable_axes={"params": None, "intermediates": 0}, split_rngs={"params": False, "dropout": True},
    )  # fmt: skip
    every = decode(host, starts, bev, elements, priors, deterministic)
    host.sow(AUXILIARY, "denoised", jax.tree.map(lambda leaf: leaf[1:], every.lanes))
    return jax.tree.map(lambda leaf: leaf[0], every)
