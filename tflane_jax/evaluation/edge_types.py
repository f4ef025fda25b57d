"""Which edge types a trained graph encoder of the GTN lane paper uses.

A GTN layer selects edge types by weights that are parameters, Eq. (1). A HAN layer weights its meta-paths by the image,
so that its numbers are means over images.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from tflane_jax.models.graph_encoders import GtnEncoderConfig, HanEncoderConfig
from tflane_jax.models.lstr import LstrConfig, normalise
from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.scene import RoadImage


@dataclass(frozen=True)
class EdgeTypes:
    """Weights of the edge types in every layer of an encoder.

    Attributes:
        names: of the edge types.
        layers: weights by layer; they sum to 1 over the types. NaN where a hop is not offered a type. A HAN has one
            hop and one channel.
    """

    names: tuple[str, ...]
    layers: tuple[Float[np.ndarray, "hops channels types"], ...]

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row of a table for each hop of each meta-path (channel); layers, hops and channels count from 1."""
        for layer, by_hop in enumerate(self.layers, 1):
            for hop, by_channel in enumerate(by_hop, 1):
                for channel, weights in enumerate(by_channel, 1):
                    place = {
                        "layer": layer,
                        "hop": hop,
                        "channel": channel,
                        "wins": self.names[int(np.nanargmax(weights))],
                    }
                    shown = {name: float(w) for name, w in zip(self.names, weights, strict=True) if np.isfinite(w)}
                    yield place | shown


def has_edge_weights(model: LstrConfig) -> bool:
    """Return whether a model's encoder weights its edge types: GTN and HAN do, transformer and GCN do not."""
    return isinstance(model.encoder, (GtnEncoderConfig, HanEncoderConfig))


def edge_types(model: LstrConfig, params: Params, images: RoadImage) -> EdgeTypes | None:
    """Return the weights of a model's edge types, means over stacked images; None for encoders that do not choose."""
    encoder = model.encoder
    if not isinstance(encoder, (GtnEncoderConfig, HanEncoderConfig)):
        return None
    names, offered = tuple(encoder.relations), np.ones((1, 1, len(encoder.relations)), bool)
    if isinstance(encoder, GtnEncoderConfig) and encoder.similarity is not None:
        names = (*names, "similarity")
        similar = [encoder.offers_similarity(hop) for hop in range(encoder.hops)]
        offered = np.array([[[True] * len(encoder.relations) + [one]] for one in similar])
    layers = _layers(model, params, images.image, images.image_valid)
    return EdgeTypes(names, tuple(np.where(offered, np.asarray(layer).mean(0), np.nan) for layer in layers))


@functools.partial(jax.jit, static_argnums=0)
def _layers(model: LstrConfig, params: Params, images: Any, valid: Any) -> list[Float[Array, "b hops channels types"]]:
    """Return what each layer of the encoder sows as `relations`, by image."""
    learned, statistics = split_statistics(params)

    def one(image, valid):
        variables = {"params": learned} | statistics
        _, seen = model.build().apply(variables, normalise(image, valid), valid, mutable="intermediates")
        layers = seen["intermediates"]["encoder"]
        return [layers[f"layer_{i}"]["graph"]["relations"][0] for i in range(model.encoder.layers)]

    by_image: Any = jax.vmap(one)
    return by_image(images, valid)
