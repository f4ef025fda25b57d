"""From the BEV evidence raster to BEV features: a CPU-sized substitute for cameras and BEVFormer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.layers.positions import sine_encoding
from tflane_jax.layers.precision import Precision, computing, run_layer, run_part
from tflane_jax.limits import Count, Rules
from tflane_jax.models.auxiliary import LaneCellHead
from tflane_jax.models.prior import BevHook, fuse_priors

# Of channels, in every norm.
_GROUPS = 8


@dataclass(frozen=True)
class EvidenceEncoderConfig:
    """Sizes of the encoder.

    Attributes:
        dim: channels of the BEV features.
        cell: a block of `cell` x `cell` raster cells becomes one feature cell.
        dilations: of the convolutions, one residual block each.
        cells: see `CameraEncoderConfig.cells`.
        range: the box that the raster covers, metres; equal to that of `BevSensorConfig.grid`, which training checks.
        levels: channels of the coarser levels of a U-Net before these blocks, each half as fine as the one before:
            context from the whole box.
        coordinates: whether x, y, abs x and abs y of the cells are input channels.
        precision: dtype of convolutions, see `layers.precision`; parameters and features are float32.
        remat: recompute the activations of each block and of the U-Net for the gradient instead of keeping them.
    """

    dim: Count = 32
    cell: Count = 4
    dilations: tuple[Count, ...] = (1, 2, 4, 1)
    cells: bool = False
    range: PerceptionRange = BevGrid().range
    levels: tuple[Count, ...] = ()
    coordinates: bool = False
    precision: Precision = "float32"
    remat: bool = False

    open_base: ClassVar[bool] = True
    """Settings of this type accept any subclass, see `config_io.subclasses`."""

    def build(self) -> nn.Module:
        """Return the module, which is called as `EvidenceEncoder` is."""
        return EvidenceEncoder(self)

    def limits(self) -> Rules:
        """Channels split over the groups of the norms, and so over sine and cosine of x and y."""
        yield "dim", self.dim % _GROUPS == 0, f"a multiple of {_GROUPS}, the groups of its norms"
        yield "dilations", bool(self.dilations or self.levels), "not empty where there are no levels, either"
        split = all(channels % _GROUPS == 0 for channels in self.levels)
        yield "levels", split, f"multiples of {_GROUPS}, the groups of their norms"

    @property
    def bev_range(self) -> PerceptionRange:
        """The box that the BEV features cover, metres."""
        return self.range


class EvidenceEncoder(nn.Module):
    """Raster cells folded into channels, a U-Net if it has levels, then dilated residual blocks."""

    config: EvidenceEncoderConfig

    @nn.compact
    def __call__(self, bev: UInt8[Array, "h w c"], fuse: BevHook | None = None) -> Float[Array, "hf wf d"]:
        """Return BEV features, `cell` times coarser than the raster.

        Args:
            bev: (h, w, c) evidence, row 0 at the smallest y.
            fuse: how priors change the features: before the U-Net, if there is one, and after each residual block. The
                positions that it receives are a sine encoding of (x, y).

        Raises:
            ValueError: `cell` does not divide the size of the raster.
        """
        (h, w, c), n = bev.shape, self.config.cell
        if h % n or w % n:
            raise ValueError(
                f"a raster of {h} x {w} cells does not fold into blocks of {n} x {n}: choose a `cell` that divides "
                "both sides"
            )
        x = bev.astype(jnp.float32) / 255.0
        # Folding is lossless and avoids convolutions at full resolution, the most expensive ones on a CPU.
        x = x.reshape(h // n, n, w // n, n, c).transpose(0, 2, 1, 3, 4).reshape(h // n, w // n, n * n * c)
        if self.config.coordinates:
            places = 2.0 * cell_points(BevGrid(rows=h // n, columns=w // n)).reshape(h // n, w // n, 2) - 1.0
            x = jnp.concatenate([x, jnp.asarray(np.concatenate([places, np.abs(places)], -1))], -1)
        with computing(self.config.precision):
            x = nn.Conv(self.config.dim, (3, 3), name="stem")(x)
        x = nn.relu(_norm("stem_norm")(x))
        first = 0  # what priors count as the layer of the first residual block
        if self.config.levels:
            x, first = fuse_priors(fuse, 0, x, partial(_positions, x)), 1
            x = run_layer(self, partial(UNet, self.config.levels, name="context"), self.config, x)
        for i, dilation in enumerate(self.config.dilations):
            x = run_part(self, partial(_block, i, dilation), self.config, x)
            x = fuse_priors(fuse, first + i, x, partial(_positions, x))
        if self.config.cells:
            LaneCellHead(name="cells")(x)
        return x


def _block(i: int, dilation: int, encoder: EvidenceEncoder, x: Float[Array, "h w d"]) -> Float[Array, "h w d"]:
    """Return the features after residual block `i`, which is a part of the encoder."""
    y = nn.Conv(encoder.config.dim, (3, 3), kernel_dilation=(dilation, dilation), name=f"block_{i}")(x)
    return nn.relu(x + _norm(f"block_{i}_norm")(y))


class UNet(nn.Module):
    """Levels of half the resolution each and back, with skip connections (Ronneberger et al. 2015).

    Attributes:
        channels: of each coarser level.
    """

    channels: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Float[Array, "h w d"]) -> Float[Array, "h w d"]:
        """Return features of the same shape."""
        if not self.channels:
            return x
        channels, rest = self.channels[0], self.channels[1:]
        y = nn.relu(_norm("down_norm")(nn.Conv(channels, (3, 3), (2, 2), name="down")(x)))
        y = _Block(name="coarse")(y)
        y = UNet(rest, name="context")(y)
        y = nn.Dense(x.shape[-1], use_bias=False, name="up")(y)
        y = jnp.repeat(jnp.repeat(y, 2, 0), 2, 1)[: x.shape[0], : x.shape[1]]
        return _Block(name="fine")(nn.relu(x + y))


class _Block(nn.Module):
    """Residual convolution."""

    @nn.compact
    def __call__(self, x: Float[Array, "h w d"]) -> Float[Array, "h w d"]:
        y = nn.Conv(x.shape[-1], (3, 3), name="conv")(x)
        return nn.relu(x + _norm("norm")(y))


def _positions(x: Float[Array, "h w d"]) -> Float[Array, "h*w d"]:
    """Return the position encoding of the cells of features, with as many channels (a multiple of 4)."""
    places = cell_points(BevGrid(rows=x.shape[0], columns=x.shape[1]))
    # With 8 bands on 25 x 50 cells, the shortest wavelengths are two and three cells.
    return sine_encoding(jnp.asarray(places, x.dtype), x.shape[-1] // 4, lowest=0.125)


def _norm(name: str) -> nn.GroupNorm:
    # Group norm: statistics of one example, as modules have no batch axis.
    return nn.GroupNorm(num_groups=_GROUPS, name=name)
