"""Traffic lights and signs in the front view: Deformable DETR with iterative box refinement, TopoNet's TE head.

Source: Zhu et al. 2021, and TopoNet's published code (docs/reference/toponet.md). Multi-level features of the front
camera -> encoder -> E queries attend to all levels -> 13 class logits and a box in pixels after every decoder layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.deformable import DeformableAttention
from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.positions import image_sine_encoding, inverse_sigmoid
from tflane_jax.layers.precision import Precision, run_layer
from tflane_jax.layers.transformer import FeedForward, Residual, TransformerConfig
from tflane_jax.limits import Count, CountOrZero, FractionBelowOne, Rules, splits


@dataclass(frozen=True)
class ElementDecoderConfig:
    """Sizes. The defaults train on two CPU cores; `PAPER_ELEMENT_DECODER` has TopoNet's.

    Attributes:
        dim: channels of features and queries.
        heads: attention heads.
        levels: feature levels of the front camera.
        encoder_layers, layers: of encoder and decoder; `layers` must equal that of the host's lane decoder.
        queries: E, the largest number of traffic elements found.
        sampling_points: per head and level.
        hidden: channels inside the feed-forward blocks.
        dropout: probability, for attention weights, hidden channels and every residual branch.
        precision: dtype of linear layers, see `layers.precision`; parameters, boxes and scores are float32.
        remat: recompute each layer's activations for the gradient instead of keeping them.
    """

    dim: Count = 64
    heads: Count = 8
    levels: Count = 2
    encoder_layers: CountOrZero = 1
    layers: Count = 3
    queries: Count = 16
    sampling_points: Count = 4
    hidden: Count = 128
    dropout: FractionBelowOne = 0.0
    precision: Precision = "float32"
    remat: bool = False

    def limits(self) -> Rules:
        """Channels split over heads, and over rows and columns."""
        yield splits("heads", self.heads, "dim", self.dim)
        yield "dim", self.dim % 2 == 0, "even: half of the position encoding is for rows, half for columns"


PAPER_ELEMENT_DECODER = ElementDecoderConfig(
    dim=256, levels=4, encoder_layers=6, layers=6, queries=100, hidden=512, dropout=0.1
)


@struct.dataclass
class ElementOutput:
    """Outputs of the D decoder layers.

    Attributes:
        queries: (D, E, C) features, inputs of the lane decoder and its relationship heads.
        box: (D, E, 2, 2) top-left and bottom-right corners, pixels of the front image.
        logits: (D, E, K) of the classes, OpenLane-V2's 13 attributes.
    """

    queries: Float[Array, "layers e c"]
    box: Float[Array, "layers e 2 2"]
    logits: Float[Array, "layers e k"]


class ElementDecoder(nn.Module):
    """From feature maps of one image to traffic elements.

    Attributes:
        config: sizes.
        classes: K, classes of traffic elements.
    """

    config: ElementDecoderConfig
    classes: int = ATTRIBUTES

    @nn.compact
    def __call__(
        self,
        features: Sequence[Float[Array, "_h _w c"]],
        size: Int[Array, " 2"],
        padded: tuple[int, int],
        *,
        deterministic: bool = True,
    ) -> ElementOutput:
        """Return boxes and classes after every layer.

        Args:
            features: `levels` maps (h, w, C), finest first; cells that show padding only have no influence.
            size: width and height of the image, pixels; the rest of the array is padding.
            padded: (rows, columns) of the image array.
            deterministic: no dropout.

        Raises:
            ValueError: the number of feature maps is not `levels`.
        """
        config = self.config
        if len(features) != config.levels:
            raise ValueError(f"the element decoder is configured for {config.levels} levels and got {len(features)}")
        shapes = [(feature.shape[0], feature.shape[1]) for feature in features]
        masks = [image_cells(shape, size, padded) for shape in shapes]
        valid = jnp.concatenate([mask.reshape(-1) for mask in masks])
        ratios = jnp.stack([valid_ratio(mask) for mask in masks])  # (L, 2), x and y
        tokens = jnp.concatenate([feature.reshape(-1, feature.shape[-1]) for feature in features])
        tokens = jnp.where(valid[:, None], tokens, 0.0)

        level = self.param("level", nn.initializers.normal(1.0), (config.levels, config.dim), jnp.float32)
        position = jnp.concatenate(
            [
                image_sine_encoding(mask, config.dim // 2, offset=-0.5).reshape(-1, config.dim) + level[i][None]
                for i, mask in enumerate(masks)
            ]
        )
        cells = jnp.concatenate([cell_centers(shape, ratio) for shape, ratio in zip(shapes, ratios, strict=True)])
        around = cells[:, None, None] * ratios[None, None]  # (T, 1, L, 2): the same point on every level
        for i in range(config.encoder_layers):
            layer, given = partial(ElementEncoderLayer, config, name=f"encoder_{i}"), (tokens, position, around, valid)
            tokens = run_layer(self, layer, config, *given, shapes=shapes, deterministic=deterministic)
        return self._decode(tokens, shapes, valid, ratios, size, deterministic)

    def _decode(
        self,
        cells: Float[Array, "t c"],
        shapes: Sequence[tuple[int, int]],
        valid: Bool[Array, " t"],
        ratios: Float[Array, "levels 2"],
        size: Int[Array, " 2"],
        deterministic: bool,
    ) -> ElementOutput:
        """Return the outputs of the decoder's layers; `cells` are the encoded cells of all levels."""
        config = self.config
        embedding = self.param("queries", nn.initializers.normal(1.0), (config.queries, 2 * config.dim), jnp.float32)
        position, queries = jnp.split(embedding, 2, -1)
        # A point in the first layer, a box from the second on.
        reference = nn.sigmoid(nn.Dense(2, kernel_init=nn.initializers.xavier_uniform(), name="reference")(position))
        outputs = []
        for i in range(config.layers):
            scale = jnp.tile(ratios, (1, reference.shape[-1] // 2))  # (x, y) of a point; of a box (x, y, x, y)
            around = reference[:, None, None] * scale[None, None]
            layer = partial(ElementDecoderLayer, config, name=f"decoder_{i}")
            given = queries, position, cells, around, valid
            queries = run_layer(self, layer, config, *given, shapes=shapes, deterministic=deterministic)
            logits = nn.Dense(self.classes, bias_init=nn.initializers.constant(-np.log(99.0)), name=f"class_{i}")(
                queries
            )
            box = ElementBox(config.dim, first=i == 0, name=f"box_{i}")(queries, reference)
            reference = lax.stop_gradient(box)
            outputs.append(ElementOutput(queries, corners(box, size), logits))
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *outputs)


class ElementEncoderLayer(nn.Module):
    """Deformable self-attention over the cells of all levels, then feed-forward; post-norm."""

    config: ElementDecoderConfig

    @nn.compact
    def __call__(
        self,
        tokens: Float[Array, "t c"],
        position: Float[Array, "t c"],
        around: Float[Array, "t 1 levels 2"],
        valid: Bool[Array, " t"],
        *,
        shapes: Sequence[tuple[int, int]],
        deterministic: bool,
    ) -> Float[Array, "t c"]:
        """Return the cells' tokens after the layer; `around` are their own places on every level, in [0, 1]."""
        config, sizes = self.config, _sizes(self.config)
        attend = DeformableAttention(config.dim, config.heads, config.sampling_points, config.levels, name="attention")
        block = FeedForward(sizes, name="feed_forward")
        tokens = Residual(sizes, name="attended")(
            tokens, lambda x: attend(x + position, x, shapes, around, valid), deterministic=deterministic
        )
        return Residual(sizes, name="fed")(
            tokens, lambda x: block(x, deterministic=deterministic), deterministic=deterministic
        )


class ElementDecoderLayer(nn.Module):
    """Self-attention of the queries, deformable attention to all levels, feed-forward; post-norm."""

    config: ElementDecoderConfig

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "e c"],
        position: Float[Array, "e c"],
        cells: Float[Array, "t c"],
        around: Float[Array, "e 1 levels d"],
        valid: Bool[Array, " t"],
        *,
        shapes: Sequence[tuple[int, int]],
        deterministic: bool,
    ) -> Float[Array, "e c"]:
        """Return the queries after the layer.

        `cells` are the encoded cells of all levels; `around` are points (D = 2) or boxes (D = 4) on every level.
        """
        config, sizes = self.config, _sizes(self.config)
        attend = MultiHeadAttention(config.dim, config.heads, config.dropout, name="self_attention")
        sample = DeformableAttention(config.dim, config.heads, config.sampling_points, config.levels, name="attention")
        block = FeedForward(sizes, name="feed_forward")

        def among_queries(x):
            return attend(x + position, x + position, x, deterministic=deterministic)

        def to_image(x):
            return sample(x + position, cells, shapes, around, valid)

        queries = Residual(sizes, name="attended")(queries, among_queries, deterministic=deterministic)
        queries = Residual(sizes, name="crossed")(queries, to_image, deterministic=deterministic)
        return Residual(sizes, name="fed")(
            queries, lambda x: block(x, deterministic=deterministic), deterministic=deterministic
        )


class ElementBox(nn.Module):
    """Predicts the box of each query as an offset to its reference, in logits.

    Attributes:
        dim: channels of the queries.
        first: first layer, where references are points; initial boxes are small.
    """

    dim: int
    first: bool

    @nn.compact
    def __call__(self, queries: Float[Array, "e c"], reference: Float[Array, "e d"]) -> Float[Array, "e 4"]:
        """Return (cx, cy, w, h) in [0, 1]."""
        x = nn.relu(Mlp((self.dim, self.dim), name="hidden")(queries))
        small = jnp.array([0.0, 0.0, -2.0, -2.0] if self.first else [0.0] * 4, jnp.float32)
        change = nn.Dense(4, kernel_init=nn.initializers.zeros, bias_init=lambda *_: small, name="out")(x)
        known = inverse_sigmoid(reference)
        return nn.sigmoid(change + jnp.pad(known, ((0, 0), (0, 4 - known.shape[-1]))))


def image_cells(shape: tuple[int, int], size: Int[Array, " 2"], padded: tuple[int, int]) -> Bool[Array, "h w"]:
    """Return which cells of a feature map show the image, not padding: those whose first pixel lies inside it."""
    rows, columns = (
        jnp.asarray(np.arange(cells) * pixels // cells) < limit
        for cells, pixels, limit in zip(shape, padded, (size[1], size[0]), strict=True)
    )
    return rows[:, None] & columns[None, :]


def valid_ratio(mask: Bool[Array, "h w"]) -> Float[Array, " 2"]:
    """Return the fractions (x, y) of columns and rows that show the image, at least one cell of each."""
    h, w = mask.shape
    columns, rows = mask[0].sum(dtype=jnp.float32) / w, mask[:, 0].sum(dtype=jnp.float32) / h
    return jnp.maximum(jnp.stack([columns, rows]), jnp.array([1.0 / w, 1.0 / h]))


def cell_centers(shape: tuple[int, int], ratio: Float[Array, " 2"]) -> Float[Array, "hw 2"]:
    """Return the center (x, y) of every cell, row-major, as fractions of the part that shows the image."""
    h, w = shape
    y, x = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    return jnp.asarray(np.stack([x, y], -1).reshape(-1, 2), jnp.float32) / ratio[None]


def corners(box: Float[Array, "e 4"], size: Int[Array, " 2"]) -> Float[Array, "e 2 2"]:
    """Return top-left and bottom-right corners, pixels, of boxes (cx, cy, w, h), fractions of the image `size`."""
    center, half = box[:, :2], 0.5 * box[:, 2:]
    return jnp.stack([center - half, center + half], 1) * size.astype(box.dtype)[None, None]


def _sizes(config: ElementDecoderConfig) -> TransformerConfig:
    return TransformerConfig(config.heads, config.hidden, config.dropout)
