"""LSTR: lane lines in one image as parameters of the lane shape model (Liu et al. 2020), with exchangeable encoders.

Image -> reduced ResNet-18 -> encoder (transformer, or one of the graph encoders of the GTN paper) -> decoder with one
query per lane -> class, extent and curve of each lane. Facts: shared specs/modules.md section 2; GTN paper section 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.masks import key_mask
from tflane_jax.layers.positions import image_sine_encoding
from tflane_jax.layers.resnet import ResNet, ResNetConfig
from tflane_jax.layers.transformer import DecoderLayer, EncoderLayer, TransformerConfig
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName
from tflane_jax.models.graph_encoders import GcnEncoderConfig, GtnEncoderConfig, HanEncoderConfig
from tflane_jax.scene import CurvePrediction

# Of TuSimple images in [0, 1], blue, green, red: the order in which the published weights read them.
MEAN_BGR = (0.40789654, 0.44719302, 0.47026115)
STD_BGR = (0.28863828, 0.27408164, 0.27809835)


@dataclass(frozen=True)
class TransformerEncoderConfig:
    """LSTR's own encoder.

    Attributes:
        layers: encoder layers.
        layer: sizes of each.
    """

    layers: int = 2
    layer: TransformerConfig = TransformerConfig()

    def build(self, dim: int, name: str) -> TransformerEncoder:
        """Return the Linen module; `dim` is what its input has."""
        del dim
        return TransformerEncoder(self, name=name)


# What anchored heads count in, orders of magnitude of a road: alpha, beta; k'', f'', m'', n'; columns at the two rows.
# (A bend of 500 m is an m'' of about 1e-3; a change of 1e-5 in k'' moves a lane's far end by a fiftieth of the image.)
_TYPICAL = np.array([0.38, 0.95, 0.0, 0.3, 0.0, 0.5, 0.0, 0.0], np.float32)
_SPREAD = np.array([0.05, 0.1, 1e-5, 0.03, 2e-3, 0.05, 0.1, 1.0], np.float32)

EncoderConfig = TransformerEncoderConfig | GtnEncoderConfig | GcnEncoderConfig | HanEncoderConfig


@dataclass(frozen=True)
class LstrConfig:
    """The network; the defaults are LSTR's.

    Attributes:
        backbone: features of the image.
        dim: channels behind the backbone, a multiple of 4.
        encoder: what lets the cells of the feature map look at each other.
        decoder_layers, decoder: layers that answer the queries.
        queries: most lanes that can be found.
        shrink: side of the blocks of pixels that are averaged before the network sees them; 2 takes a quarter of the
            time (the last stage's stride 1 then leaves as many cells as at full size).
        located: add the position encoding to the features themselves, so that what is attended to says where it is.
            In LSTR positions steer attention only, and where something is must be learned from the image's borders.
        cells: say of each cell of the encoder's memory whether a lane line passes through it, for an auxiliary loss.
            Without it the first few thousand steps answer alike to every image.
        anchors: two rows (shares of the image); the network then says where a lane's straight part crosses them, and
            b'' and b''' follow; and all numbers are counted in what they typically are. The same curves, but LSTR's own
            numbers (None) differ in size by five orders of magnitude, which takes it half a million small steps.
    """

    backbone: ResNetConfig = ResNetConfig()
    dim: int = 32
    encoder: EncoderConfig = TransformerEncoderConfig()
    decoder_layers: int = 2
    decoder: TransformerConfig = TransformerConfig()
    queries: int = 7
    shrink: int = 1
    located: bool = False
    anchors: tuple[float, float] | None = None
    cells: bool = False

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """Auxiliary outputs that the network has in training."""
        return ("line_cells",) if self.cells else ()

    def build(self) -> Lstr:
        """Return the Linen module."""
        return Lstr(self)


class TransformerEncoder(nn.Module):
    """Encoder layers over the cells of a feature map."""

    config: TransformerEncoderConfig

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "h w c"],
        position: Float[Array, "h w c"],
        valid: Bool[Array, "h w"],
        *,
        deterministic: bool = True,
    ) -> Float[Array, "h w c"]:
        """Return the memory; cells that are not valid influence nothing."""
        shape, mask = features.shape, key_mask(valid.reshape(-1))
        x = jnp.where(valid[..., None], features, 0.0).reshape(-1, shape[-1])
        position = position.reshape(-1, shape[-1])
        for i in range(self.config.layers):
            x = EncoderLayer(self.config.layer, name=f"layer_{i}")(x, position, mask, deterministic=deterministic)
        return x.reshape(shape)


class Lstr(nn.Module):
    """One normalised image in, the predictions of every decoder layer out."""

    config: LstrConfig

    @nn.compact
    def __call__(
        self, image: Float[Array, "h w 3"], valid: Bool[Array, "h w"], *, train: bool = False
    ) -> CurvePrediction:
        """Return predictions with a leading axis over decoder layers; the last one is the answer.

        Args:
            image: see `normalise`.
            valid: pixels that show something; cells of the feature map whose pixel is not valid are not attended to.
            train: batch statistics in the norms (under `vmap` over the axis `batch_norm.BATCH_AXIS`), and dropout.
        """
        config = self.config
        image, valid = shrink(image, valid, config.shrink)
        features = ResNet(config.backbone, name="backbone")(image[None], train=train)[-1][0]
        features = nn.Dense(config.dim, name="input_projection")(features)
        cells = nearest(valid, *features.shape[:2])
        position = image_sine_encoding(cells, config.dim // 2)
        if config.located:
            features = features + position
        encoder = config.encoder.build(config.dim, "encoder")
        memory = encoder(features, position, cells, deterministic=not train)
        if config.cells and self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "line_cells", nn.Dense(1, name="cell_head")(memory)[..., 0])
        memory = memory.reshape(-1, config.dim)
        position, seen = position.reshape(-1, config.dim), key_mask(cells.reshape(-1))

        query = self.param("queries", nn.initializers.normal(1.0), (config.queries, config.dim))
        x, outputs = jnp.zeros_like(query), []
        norm = nn.LayerNorm(epsilon=1e-5, name="decoder_norm")
        for i in range(config.decoder_layers):
            layer = DecoderLayer(config.decoder, name=f"decoder_{i}")
            x = layer(x, memory, query, position, None, seen, deterministic=not train)
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
        # Lanes of one image share these four (GTN paper, section 2.4); the mean runs over all queries, as in LSTR.
        shared = jnp.broadcast_to(shared.mean(-2, keepdims=True), shared.shape)
        curves = jnp.concatenate([specific[..., :2], shared, specific[..., 2:]], -1)
        if self.anchors is not None:
            curves = _from_columns(_like(_TYPICAL, curves) + _like(_SPREAD, curves) * curves, self.anchors)
        return CurvePrediction(logits, curves)


def _from_columns(curves: Float[Array, "*b 8"], anchors: tuple[float, float]) -> Float[Array, "*b 8"]:
    """Return curves whose last two numbers, columns of the straight part at two rows, have become b'' and b'''."""
    upper, lower = anchors
    slope = (curves[..., 7] - curves[..., 6]) / (lower - upper)
    straight = jnp.stack([slope, slope * upper - curves[..., 6]], -1)
    return jnp.concatenate([curves[..., :6], straight], -1)


def _like(values: np.ndarray, x: Array) -> Array:
    return jnp.asarray(values, x.dtype).reshape((1,) * (x.ndim - 1) + (-1,))


def normalise(image: UInt8[Array, "*b h w 3"], valid: Bool[Array, "*b h w"]) -> Float[Array, "*b h w 3"]:
    """Return what the network reads of RGB images: BGR, zero mean and unit variance over TuSimple, padding black."""
    image = jnp.where(valid[..., None], image, 0)
    lead = (1,) * (image.ndim - 1)
    mean, std = (jnp.asarray(values).reshape(*lead, 3) for values in (MEAN_BGR, STD_BGR))
    return (image[..., ::-1].astype(jnp.float32) / 255.0 - mean) / std


def shrink(
    image: Float[Array, "h w 3"], valid: Bool[Array, "h w"], side: int
) -> tuple[Float[Array, "hs ws 3"], Bool[Array, "hs ws"]]:
    """Return means of blocks of side x side pixels, valid where all are; raises ValueError where some are left."""
    if side == 1:
        return image, valid
    height, width = valid.shape
    if height % side or width % side:
        raise ValueError(f"an image of {height} x {width} does not shrink by blocks of {side} x {side}")
    blocks = (height // side, side, width // side, side)
    return image.reshape(*blocks, 3).mean((1, 3)), valid.reshape(blocks).all((1, 3))


def nearest(mask: Bool[Array, "h w"], rows: int, columns: int) -> Bool[Array, "rows columns"]:
    """Return the mask at `rows` x `columns` cells: of each its first pixel, floor(i * size / cells)."""
    height, width = mask.shape
    return mask[jnp.arange(rows) * height // rows][:, jnp.arange(columns) * width // columns]
