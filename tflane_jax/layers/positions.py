"""Position encodings."""

from __future__ import annotations

import math

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def sine_encoding(coordinates: Float[Array, "*b d"], bands: int, lowest: float = 0.5) -> Float[Array, "*b f"]:
    """Return sines and cosines of normalised coordinates, f = 2 d bands.

    Args:
        coordinates: in [0, 1] across the perception range.
        bands: frequencies per coordinate, each twice the one before.
        lowest: periods of the lowest band across the range.
    """
    frequency = 2.0 * math.pi * lowest * 2.0 ** jnp.arange(bands, dtype=coordinates.dtype)
    angle = coordinates[..., None] * jnp.expand_dims(frequency, tuple(range(coordinates.ndim)))
    angle = angle.reshape(*coordinates.shape[:-1], -1)
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


def inverse_sigmoid(x: Float[Array, "*b"], eps: float = 1e-5) -> Float[Array, "*b"]:
    """Return the logit of x clamped to [0, 1], finite at both ends as in Deformable DETR."""
    x = jnp.clip(x, 0.0, 1.0)
    return jnp.log(jnp.maximum(x, eps) / jnp.maximum(1.0 - x, eps))


def image_sine_encoding(
    valid: Bool[Array, "h w"], bands: int, *, normalise: bool = True, offset: float = 0.0, temperature: float = 1e4
) -> Float[Array, "h w f"]:
    """Return DETR's sine encoding of the cells of a feature map, f = 2 bands: [row | column], each sine, cosine, ...

    Rows and columns are counted among valid cells, from 1. Every option is one of the code of DETR and mmdet, for
    weights trained with it. All published systems here normalise, at a temperature of 10,000.

    Args:
        valid: cells that show the image, not padding.
        bands: channels of each axis, even.
        normalise: scale each axis to (0, 2 pi].
        offset: added to the counts if they are normalised (mmdet: -0.5). Rows and columns without a valid cell then
            get huge arguments; they must be masked.
        temperature: of the frequencies 1 / temperature^(2 floor(i / 2) / bands).
    """
    band = jnp.arange(bands, dtype=jnp.float32)
    frequency = temperature ** (-2.0 * (band // 2) / bands)
    cosine = band % 2 * (math.pi / 2)

    def encode(counts, last):
        if normalise:
            counts = (counts + offset) / (last + 1e-6) * (2.0 * math.pi)
        angle = counts[..., None] * frequency[None, None]
        return jnp.where(cosine[None, None] > 0, jnp.cos(angle), jnp.sin(angle))

    rows, columns = (jnp.cumsum(valid, axis, dtype=jnp.float32) for axis in (0, 1))
    return jnp.concatenate([encode(rows, rows[-1:]), encode(columns, columns[:, -1:])], -1)


class LearnedImageEncoding(nn.Module):
    """Learned encoding of the cells of a feature map, f = 2 bands: [column | row].

    Attributes:
        rows, columns: largest map.
        bands: channels of each axis.
        init_table: initial values of both tables.
    """

    rows: int
    columns: int
    bands: int
    init_table: nn.initializers.Initializer = nn.initializers.uniform(1.0)

    @nn.compact
    def __call__(self, height: int, width: int) -> Float[Array, "h w f"]:
        """Return the encoding of a map of `height` x `width` cells; raises ValueError where that is too large."""
        if height > self.rows or width > self.columns:
            raise ValueError(f"positions are learned up to {self.rows} x {self.columns}, not {height} x {width}")
        row = self.param("row", self.init_table, (self.rows, self.bands), jnp.float32)[:height, None]
        column = self.param("column", self.init_table, (self.columns, self.bands), jnp.float32)[None, :width]
        shape = (height, width, self.bands)
        return jnp.concatenate([jnp.broadcast_to(column, shape), jnp.broadcast_to(row, shape)], -1)
