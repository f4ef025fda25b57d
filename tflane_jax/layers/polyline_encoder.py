"""Polylines to tokens: a sine encoding of their points, and a transformer.

SMERF (Luo et al. 2024) makes one token of the points of a line, and the lines attend to each other. In marker fusion
(section III-A) the points of a line attend to each other, and are then joined to one token.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.masks import key_mask
from tflane_jax.layers.precision import PLAIN, Computation, computing, full, run_layer, run_part
from tflane_jax.layers.transformer import EncoderLayer, TransformerConfig
from tflane_jax.limits import Count, CountOrZero, FractionBelowOne, Positive, Rules, splits

Layout = Literal["blocks", "interleaved"]


def temperature_encoding(
    coordinates: Float[Array, "*b d"], bands: int, *, temperature: float = 1000.0, layout: Layout = "blocks"
) -> Float[Array, "*b f"]:
    """Return sines and cosines of 2 pi p / temperature^(2 j / bands), j < bands / 2, of every coordinate p.

    Eq. (1) of marker fusion (bands 32, interleaved), and SMERF's encoding (bands 16, blocks); f = d bands.

    Args:
        coordinates: in [0, 1] across the perception range; others are encoded as well.
        bands: channels of each coordinate, even.
        temperature: ratio of the longest to the shortest wavelength, nearly.
        layout: the channels of a coordinate: "blocks" has all sines, then all cosines; "interleaved" has them in turn.

    Raises:
        ValueError: an odd number of bands.
    """
    if bands % 2:
        raise ValueError(f"every frequency has a sine and a cosine, so bands must be even, not {bands}")
    frequency = 2.0 * math.pi * temperature ** (-2.0 * jnp.arange(bands // 2, dtype=coordinates.dtype) / bands)
    angle = coordinates[..., None] * jnp.expand_dims(frequency, tuple(range(coordinates.ndim)))
    # Eq. (1) of marker fusion.
    waves = jnp.stack([jnp.sin(angle), jnp.cos(angle)], -2 if layout == "blocks" else -1)
    return waves.reshape(*coordinates.shape[:-1], coordinates.shape[-1] * bands)


@dataclass(frozen=True)
class PolylineEncoderConfig:
    """Sizes of the encoder; the defaults are SMERF's.

    Attributes:
        dim: channels of a token.
        layers, heads, hidden, dropout: sizes and dropout of the transformer.
        bands: channels of each coordinate of a point, half of them sines and half cosines; 0 leaves coordinates as
            they are.
        temperature, layout: of the encoding of points.
        attend: what attends to each other: "lines" (SMERF), or the "points" of one line (marker fusion).
    """

    dim: Count = 256
    layers: CountOrZero = 6
    heads: Count = 4
    hidden: Count = 256
    dropout: FractionBelowOne = 0.1
    bands: CountOrZero = 16
    temperature: Positive = 1000.0
    layout: Layout = "blocks"
    attend: Literal["lines", "points"] = "lines"

    def limits(self) -> Rules:
        """Channels split over heads, and every frequency has a sine and a cosine."""
        yield splits("heads", self.heads, "dim", self.dim)
        yield "bands", self.bands % 2 == 0, "even: every frequency has a sine and a cosine"


# Marker fusion, section IV-C. It does not give hidden channels and dropout, which are SMERF's, nor the width of the
# transformer: a linear layer takes the 2 d = 64 channels of Eq. (1) to that of a token.
MARKER_POLYLINES = PolylineEncoderConfig(bands=32, layout="interleaved", attend="points")


class PolylineEncoder(nn.Module):
    """N polylines of P points to N tokens.

    Attributes:
        config: sizes.
        computation: precision of linear layers, and whether each layer is computed again for the gradient.
    """

    config: PolylineEncoderConfig
    computation: Computation = PLAIN

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "n p 2"],
        labels: Float[Array, "n k"],
        valid: Bool[Array, " n"],
        *,
        deterministic: bool = True,
    ) -> Float[Array, "n c"]:
        """Return one token for each line, 0 for an invalid one.

        Args:
            points: in [0, 1] across the perception range.
            labels: further inputs of a line, such as its one-hot category; k may be 0.
            valid: of the lines; invalid ones may hold anything.
            deterministic: no dropout; with it, the key `dropout` is needed.
        """
        config, (lines, count) = self.config, points.shape[:2]
        points, labels = jnp.where(valid[:, None, None], points, 0.0), jnp.where(valid[:, None], labels, 0.0)
        x = points
        if config.bands:
            x = temperature_encoding(points, config.bands, temperature=config.temperature, layout=config.layout)
        sizes = TransformerConfig(config.heads, config.hidden, config.dropout)
        if config.attend == "lines":
            x = self._dense("embed", jnp.concatenate([x.reshape(lines, count * x.shape[-1]), labels], -1))
            nowhere, mask = jnp.zeros_like(x), key_mask(valid)
            for i in range(config.layers):
                layer = partial(EncoderLayer, sizes, name=f"layer_{i}")
                x = run_layer(self, layer, self.computation, x, nowhere, mask, deterministic=deterministic)
        else:
            each = jnp.broadcast_to(labels[:, None], (lines, count, labels.shape[-1]))
            x = self._dense("embed", jnp.concatenate([x, each], -1))
            nowhere = jnp.zeros_like(x)
            for i in range(config.layers):
                run = partial(_over_lines, partial(EncoderLayer, sizes, name=f"layer_{i}"), deterministic)
                x = run_part(self, run, self.computation, x, nowhere)
            x = self._dense("out", x.reshape(lines, count * config.dim))
        return jnp.where(valid[:, None], x, 0.0)

    def _dense(self, name: str, x: Float[Array, "*b c"]) -> Float[Array, "*b d"]:
        """Return a linear layer's output; called by the compact method."""
        with computing(self.computation.precision):
            return full(nn.Dense(self.config.dim, name=name)(x))


def _over_lines(make: Callable[[], EncoderLayer], deterministic: bool, parent: nn.Module, x: Array, position: Array):
    """Return the features of all lines after a layer of `parent`, whose points attend to those of their own line."""
    del parent  # `make` is called within it
    over_lines = nn.vmap(
        lambda layer, x, position: layer(x, position, deterministic=deterministic),
        variable_axes={"params": None, "intermediates": 0},
        split_rngs={"params": False, "dropout": True},
        in_axes=0,
    )
    return over_lines(make(), x, position)
