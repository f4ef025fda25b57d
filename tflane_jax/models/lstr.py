"""LSTR: lane lines in one image as parameters of the lane shape model (Liu et al. 2021), with exchangeable encoders.

Image -> reduced ResNet-18 -> encoder (transformer, or one of the graph encoders of the GTN paper) -> decoder with one
query per lane -> class, extent and curve of each lane. Source: docs/reference/lstr.md; GTN lane paper, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.masks import key_mask
from tflane_jax.layers.positions import image_sine_encoding
from tflane_jax.layers.precision import PLAIN, Computation, Precision, computing, full, run_layer
from tflane_jax.layers.resnet import ResNet, ResNetConfig
from tflane_jax.layers.transformer import DecoderLayer, EncoderLayer, TransformerConfig
from tflane_jax.limits import INCREASING, Count, Fraction, Rules, check_settings, splits
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName
from tflane_jax.models.graph_encoders import GraphEncoderConfig
from tflane_jax.scene import CurvePrediction

# Mean and deviation of values in [0, 1], in BGR order: CornerNet's, which LSTR took over.
MEAN_BGR = (0.40789654, 0.44719302, 0.47026115)
STD_BGR = (0.28863828, 0.27408164, 0.27809835)


@dataclass(frozen=True)
class TransformerEncoderConfig:
    """LSTR's own encoder.

    Attributes:
        layers: encoder layers.
        layer: sizes of a layer.
    """

    layers: Count = 2
    layer: TransformerConfig = TransformerConfig()

    def build(self, name: str, computation: Computation = PLAIN) -> TransformerEncoder:
        """Return the Linen module; it infers the number of features from its input."""
        return TransformerEncoder(self, computation, name=name)


# Mean and scale of the outputs of anchored heads: alpha, beta; k'', f'', m'', n'; columns at the two anchor rows.
# (A curve radius of 500 m is an m'' of about 1e-3; 1e-5 in k'' moves a lane's far end by 1/50 of the image.)
_TYPICAL = np.array([0.38, 0.95, 0.0, 0.3, 0.0, 0.5, 0.0, 0.0], np.float32)
_SPREAD = np.array([0.05, 0.1, 1e-5, 0.03, 2e-3, 0.05, 0.1, 1.0], np.float32)

LaneShapeEncoderConfig = TransformerEncoderConfig | GraphEncoderConfig


@dataclass(frozen=True)
class LstrConfig:
    """The network; the defaults are LSTR's.

    Attributes:
        backbone: sizes of the ResNet.
        dim: channels after the backbone, a multiple of 4.
        encoder: transformer or graph encoder over the cells of the feature map.
        decoder_layers, decoder: number and sizes of the decoder layers.
        queries: largest number of lanes found.
        shrink: side in pixels of the blocks that are averaged before the backbone; 2 takes a quarter of the time (with
            stride 1 in the last stage, the feature map has as many cells as at full size).
        located: add the position encoding to the features, so that attention values carry positions. In LSTR
            positions enter queries and keys only, and must otherwise be learned from the image's borders.
        cells: predict for each cell of the encoder output whether a lane line passes through it, for an auxiliary
            loss. Without it, predictions hardly depend on the image for the first few thousand steps.
        anchors: two rows, as fractions of the image height: the network predicts the columns where a lane's straight
            part crosses them, from which b'' and b''' follow, and all outputs are scaled to typical values. None:
            LSTR's parameters, which span five orders of magnitude and take about 500,000 small steps to train. Both
            describe the same curves.
        init: of the parameters: "flax" has this project's initial values, "lstr" those of LSTR's program
            (`models.lstr_init`).
        precision: dtype of convolutions and linear layers, see `layers.precision`; parameters, norms, heads and
            predictions are float32.
        remat: recompute the activations of each stage of the backbone and of each layer for the gradient instead of
            keeping them.
    """

    backbone: ResNetConfig = ResNetConfig()
    dim: Count = 32
    encoder: LaneShapeEncoderConfig = TransformerEncoderConfig()
    decoder_layers: Count = 2
    decoder: TransformerConfig = TransformerConfig()
    queries: Count = 7
    shrink: Count = 1
    located: bool = False
    anchors: Annotated[tuple[Fraction, Fraction], INCREASING] | None = None
    cells: bool = False
    init: Literal["flax", "lstr"] = "flax"
    precision: Precision = "float32"
    remat: bool = False

    def limits(self) -> Rules:
        """Channels split over rows and columns, sine and cosine, and over heads and meta-paths."""
        yield "dim", self.dim % 4 == 0, "a multiple of 4, for sine and cosine of rows and columns"
        yield splits("decoder.heads", self.decoder.heads, "dim", self.dim)
        if isinstance(self.encoder, TransformerEncoderConfig):
            yield splits("encoder.layer.heads", self.encoder.layer.heads, "dim", self.dim)
        for name in ("heads", "channels"):
            if hasattr(self.encoder, name):
                yield splits(f"encoder.{name}", getattr(self.encoder, name), "dim", self.dim)

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """Auxiliary outputs that the network has in training."""
        return ("line_cells",) if self.cells else ()

    def build(self) -> Lstr:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        check_settings(self)
        return Lstr(self)


class TransformerEncoder(nn.Module):
    """Encoder layers over the cells of a feature map."""

    config: TransformerEncoderConfig
    computation: Computation = PLAIN

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "h w c"],
        position: Float[Array, "h w c"],
        valid: Bool[Array, "h w"],
        *,
        deterministic: bool = True,
    ) -> Float[Array, "h w c"]:
        """Return the encoder output; invalid cells have no influence."""
        shape, mask = features.shape, key_mask(valid.reshape(-1))
        x = jnp.where(valid[..., None], features, 0.0).reshape(-1, shape[-1])
        position = position.reshape(-1, shape[-1])
        for i in range(self.config.layers):
            layer = partial(EncoderLayer, self.config.layer, name=f"layer_{i}")
            x = run_layer(self, layer, self.computation, x, position, mask, deterministic=deterministic)
        return x.reshape(shape)


class Lstr(nn.Module):
    """From one normalised image to the predictions of every decoder layer."""

    config: LstrConfig

    @nn.compact
    def __call__(
        self, image: Float[Array, "h w 3"], valid: Bool[Array, "h w"], *, train: bool = False
    ) -> CurvePrediction:
        """Return predictions with a leading axis over decoder layers; the last layer is the result.

        Args:
            image: as from `normalise`.
            valid: pixels that are not padding; cells of the feature map whose pixel is padding are not attended to.
            train: dropout is on, and norms use batch statistics (under `vmap` over `batch_norm.BATCH_AXIS`).
        """
        config = self.config
        image, valid = shrink(image, valid, config.shrink)
        dtype = jnp.bfloat16 if config.precision == "bfloat16" else None
        backbone = ResNet(config.backbone, remat=config.remat, dtype=dtype, name="backbone")
        features = backbone(image[None], train=train)[-1][0]
        with computing(config.precision):
            features = full(nn.Dense(config.dim, name="input_projection")(features))
        cells = nearest(valid, *features.shape[:2])
        position = image_sine_encoding(cells, config.dim // 2)
        if config.located:
            features = features + position
        encoder = config.encoder.build("encoder", config)
        memory = encoder(features, position, cells, deterministic=not train)
        if config.cells and self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "line_cells", nn.Dense(1, name="cell_head")(memory)[..., 0])
        memory = memory.reshape(-1, config.dim)
        position, mask = position.reshape(-1, config.dim), key_mask(cells.reshape(-1))

        query = self.param("queries", nn.initializers.normal(1.0), (config.queries, config.dim), jnp.float32)
        x, outputs = jnp.zeros_like(query), []
        norm = nn.LayerNorm(epsilon=1e-5, name="decoder_norm")
        for i in range(config.decoder_layers):
            layer = partial(DecoderLayer, config.decoder, name=f"decoder_{i}")
            x = run_layer(self, layer, config, x, memory, query, position, None, mask, deterministic=not train)
            outputs.append(norm(x))
        return LaneShapeHeads(config.dim, config.anchors, name="heads")(jnp.stack(outputs))


class LaneShapeHeads(nn.Module):
    """Class, extent and curve of every query (GTN paper, Eq. 8).

    Attributes:
        dim: channels inside the heads.
        anchors: see `LstrConfig`.
    """

    dim: int
    anchors: tuple[float, float] | None = None

    @nn.compact
    def __call__(self, queries: Float[Array, "layers q c"]) -> CurvePrediction:
        """Return the predictions of every layer."""
        logits = nn.Dense(2, name="class")(queries)
        specific = Mlp((self.dim, self.dim, 4), name="specific")(queries)  # alpha, beta, b'', b'''
        shared = Mlp((self.dim, self.dim, 4), name="shared")(queries)  # k'', f'', m'', n'
        # All lanes of an image have these four in common (GTN paper, section 2.4): their mean over queries, as in LSTR.
        shared = jnp.broadcast_to(shared.mean(-2, keepdims=True), shared.shape)
        curves = jnp.concatenate([specific[..., :2], shared, specific[..., 2:]], -1)
        if self.anchors is not None:
            curves = _from_columns(_like(_TYPICAL, curves) + _like(_SPREAD, curves) * curves, self.anchors)
        return CurvePrediction(logits, curves)


def _from_columns(curves: Float[Array, "*b 8"], anchors: tuple[float, float]) -> Float[Array, "*b 8"]:
    """Return curves with the last two entries, columns at the anchor rows, converted to b'' and b'''."""
    upper, lower = anchors
    slope = (curves[..., 7] - curves[..., 6]) / (lower - upper)
    straight = jnp.stack([slope, slope * upper - curves[..., 6]], -1)
    return jnp.concatenate([curves[..., :6], straight], -1)


def _like(values: np.ndarray, x: Array) -> Array:
    return jnp.asarray(values, x.dtype).reshape((1,) * (x.ndim - 1) + (-1,))


def normalise(image: UInt8[Array, "*b h w 3"], valid: Bool[Array, "*b h w"]) -> Float[Array, "*b h w 3"]:
    """Return the network's input from RGB images: BGR, less CornerNet's mean, over its deviation; black padding."""
    image = jnp.where(valid[..., None], image, 0)
    lead = (1,) * (image.ndim - 1)
    mean, std = (jnp.asarray(values).reshape(*lead, 3) for values in (MEAN_BGR, STD_BGR))
    return (image[..., ::-1].astype(jnp.float32) / 255.0 - mean) / std


def shrink(
    image: Float[Array, "h w 3"], valid: Bool[Array, "h w"], side: int
) -> tuple[Float[Array, "hs ws 3"], Bool[Array, "hs ws"]]:
    """Return means of blocks of side x side pixels, valid where all pixels are.

    Sums of slices: on a CPU, XLA's own reduction over blocks takes 8 times as long, an eighth of a small step.

    Raises ValueError if `side` does not divide the image size.
    """
    if side == 1:
        return image, valid
    height, width = valid.shape
    if height % side or width % side:
        raise ValueError(
            f"an image of {height} x {width} does not shrink by blocks of {side} x {side}: choose a `shrink` that "
            "divides both sides"
        )
    blocks = (height // side, side, width // side, side)
    pixels = image.reshape(height // side, side, width // side, side * 3)
    parts = [pixels[:, i, :, 3 * j : 3 * j + 3] for i in range(side) for j in range(side)]
    return sum(parts[1:], parts[0]) / side**2, valid.reshape(blocks).all((1, 3))


def nearest(mask: Bool[Array, "h w"], rows: int, columns: int) -> Bool[Array, "rows columns"]:
    """Return the mask at `rows` x `columns` cells, read at each cell's first pixel, floor(i * size / cells)."""
    height, width = mask.shape
    return mask[jnp.arange(rows) * height // rows][:, jnp.arange(columns) * width // columns]
