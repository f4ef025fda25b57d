"""ResNet (He et al. 2016) with basic or bottleneck blocks, at any width.

A bottleneck's stride is on its 3x3 convolution, as in torchvision. Names are torchvision's: conv1, bn1, layer1_0, ...
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.batch_norm import BatchNorm
from tflane_jax.layers.pointwise import convolve
from tflane_jax.limits import NOT_EMPTY, Count, Rules

# PyTorch's default: uniform within 1 / sqrt(fan in).
_INIT = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")


@dataclass(frozen=True)
class ResNetConfig:
    """Sizes of the backbone; the defaults are LSTR's reduced ResNet-18.

    Attributes:
        blocks: blocks of each stage.
        channels: channels of each stage (before a bottleneck's expansion by 4).
        strides: stride of each stage.
        stem_channels: of the 7x7 convolution with stride 2.
        block: "basic" (ResNet-18, 34) or "bottleneck" (50, 101, 152).
        frozen_stem_norm: the norm after the stem is constant, as in the published LSTR, where it is the identity up to
            its epsilon.
        frozen_norms: all norms are constant (fine-tuning from ImageNet with few images per step).
    """

    blocks: Annotated[tuple[Count, ...], NOT_EMPTY] = (1, 2, 2, 2)
    channels: Annotated[tuple[Count, ...], NOT_EMPTY] = (16, 32, 64, 128)
    strides: Annotated[tuple[Count, ...], NOT_EMPTY] = (1, 2, 2, 2)
    stem_channels: Count = 16
    block: Literal["basic", "bottleneck"] = "basic"
    frozen_stem_norm: bool = False
    frozen_norms: bool = False

    def limits(self) -> Rules:
        """Every stage has blocks, channels and a stride."""
        for name in ("channels", "strides"):
            fits = len(getattr(self, name)) == len(self.blocks)
            yield name, fits, f"as many numbers as there are stages (blocks has {len(self.blocks)})"


RESNET_50 = ResNetConfig((3, 4, 6, 3), (64, 128, 256, 512), (1, 2, 2, 2), 64, "bottleneck")


class ResNet(nn.Module):
    """Maps a stack of views to the features of every stage.

    Attributes:
        config: sizes.
        frozen_stages: number of parts, from the input on, that are not trained: 1 is the stem, 2 the first stage too.
            Their parameters get a gradient of zero at no cost.
        remat: keep only the features between stages, and recompute the rest for the gradient.
        dtype: of the computation; parameters and statistics are float32.
    """

    config: ResNetConfig
    frozen_stages: int = 0
    remat: bool = False
    dtype: Any = None

    @nn.compact
    def __call__(
        self, images: Float[Array, "v h w c"], *, train: bool, valid: Bool[Array, " v"] | None = None
    ) -> list[Float[Array, "v _hs _ws _cs"]]:
        """Return the feature maps of the stages, finest first; the stem alone reduces height and width by 4.

        Args:
            images: stack of views, finite.
            train: norms use batch statistics, unless they or their stage are frozen.
            valid: which views count in these statistics; None for all.
        """
        config = self.config
        x = StemConvolution(config.stem_channels, self.dtype, name="conv1")(images)
        norm = BatchNorm(config.frozen_stem_norm or config.frozen_norms, name="bn1")
        x = max_pool(nn.relu(norm(x, train=train and self.frozen_stages == 0, valid=valid)))
        x = lax.stop_gradient(x) if self.frozen_stages > 0 else x
        block = BasicBlock if config.block == "basic" else Bottleneck

        def run_stage(self, x, valid, stage):
            for i in range(config.blocks[stage]):
                stride, name = config.strides[stage] if i == 0 else 1, f"layer{stage + 1}_{i}"
                part = block(config.channels[stage], stride, config.frozen_norms, self.dtype, name=name)
                x = part(x, train=train and self.frozen_stages <= stage + 1, valid=valid)
            return x

        outputs = []
        for stage in range(len(config.blocks)):
            run = partial(run_stage, stage=stage)
            x = nn.remat(run)(self, x, valid) if self.remat else run(self, x, valid)
            x = lax.stop_gradient(x) if self.frozen_stages > stage + 1 else x
            outputs.append(x)
        return outputs


class StemConvolution(nn.Module):
    """The 7x7 convolution with stride 2, without bias.

    For images with even sides, blocks of 2x2 pixels first become channels. The sums are the same, with four times the
    channels at half the size, and take a quarter less time on a CPU.

    Attributes:
        channels: out.
        dtype: of the computation.
    """

    channels: int
    dtype: Any = None

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v ho wo co"]:
        """Return the features."""
        v, h, w, c = x.shape
        kernel = self.param("kernel", _INIT, (7, 7, c, self.channels), jnp.float32)
        x, kernel = (a.astype(self.dtype or a.dtype) for a in (x, kernel))
        layout = ("NHWC", "HWIO", "NHWC")
        if h % 2 or w % 2:
            return lax.conv_general_dilated(x, kernel, (2, 2), [(3, 3), (3, 3)], dimension_numbers=layout)
        # Output i reads rows 2i-3 to 2i+3: blocks i-2 to i+1 without their first row.
        x = x.reshape(v, h // 2, 2, w // 2, 2, c).swapaxes(2, 3).reshape(v, h // 2, w // 2, 4 * c)
        kernel = jnp.pad(kernel, ((1, 0), (1, 0), (0, 0), (0, 0))).reshape(4, 2, 4, 2, c, self.channels)
        kernel = kernel.swapaxes(1, 2).reshape(4, 4, 4 * c, self.channels)
        return lax.conv_general_dilated(x, kernel, (1, 1), [(2, 1), (2, 1)], dimension_numbers=layout)


def max_pool(x: Float[Array, "v h w c"]) -> Float[Array, "v ho wo c"]:
    """Return the largest value of each 3x3 window, stride 2, padding 1.

    Rows, then columns, by elementwise maxima: the gradient of XLA's own pooling takes five times as long on a CPU. At
    a tie the gradient is split between the equal values.
    """
    return _pool_along(_pool_along(x, 1), 2)


def _pool_along(x: jax.Array, axis: int) -> jax.Array:
    """Return max(x[2i - 1], x[2i], x[2i + 1])."""
    width = [(0, 0)] * x.ndim
    width[axis] = (0, x.shape[axis] % 2)
    x = jnp.pad(x, width, constant_values=-jnp.inf)
    pairs = x.reshape(*x.shape[:axis], x.shape[axis] // 2, 2, *x.shape[axis + 1 :])
    even, odd = (lax.index_in_dim(pairs, i, axis + 1, keepdims=False) for i in (0, 1))
    width[axis] = (1, 0)
    before = jnp.pad(lax.slice_in_dim(odd, 0, odd.shape[axis] - 1, axis=axis), width, constant_values=-jnp.inf)
    return jnp.maximum(jnp.maximum(even, odd), before)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut."""

    channels: int
    stride: int
    frozen: bool
    dtype: Any = None
    kernel_init: nn.initializers.Initializer = _INIT

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w c"], *, train: bool, valid: Bool[Array, " v"] | None = None
    ) -> Float[Array, "v ho wo co"]:
        """Return the block's features; `valid` as in `ResNet`."""
        norm = partial(BatchNorm, self.frozen)
        y = _conv(self.channels, 3, self.stride, "conv1", self.dtype, self.kernel_init)(x)
        y = nn.relu(norm(name="bn1")(y, train=train, valid=valid))
        y = _conv(self.channels, 3, 1, "conv2", self.dtype, self.kernel_init)(y)
        y = norm(name="bn2")(y, train=train, valid=valid)
        return nn.relu(y + _shortcut(x, self.channels, self.stride, norm, train, valid, self.dtype))


class Bottleneck(nn.Module):
    """A 3x3 convolution between two 1x1 ones, the last of which has four times the channels."""

    channels: int
    stride: int
    frozen: bool
    dtype: Any = None

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w c"], *, train: bool, valid: Bool[Array, " v"] | None = None
    ) -> Float[Array, "v ho wo co"]:
        """Return the block's features; `valid` as in `ResNet`."""
        norm = partial(BatchNorm, self.frozen)
        y = _conv(self.channels, 1, 1, "conv1", self.dtype)(x)
        y = nn.relu(norm(name="bn1")(y, train=train, valid=valid))
        y = _conv(self.channels, 3, self.stride, "conv2", self.dtype)(y)
        y = nn.relu(norm(name="bn2")(y, train=train, valid=valid))
        y = _conv(4 * self.channels, 1, 1, "conv3", self.dtype)(y)
        y = norm(name="bn3")(y, train=train, valid=valid)
        return nn.relu(y + _shortcut(x, 4 * self.channels, self.stride, norm, train, valid, self.dtype))


def _shortcut(
    x: jax.Array,
    channels: int,
    stride: int,
    norm: Callable[..., BatchNorm],
    train: bool,
    valid: jax.Array | None,
    dtype: Any,
) -> jax.Array:
    """Return x, projected where the block changes its shape (inside the calling module's compact method)."""
    if stride == 1 and x.shape[-1] == channels:
        return x
    projected = _conv(channels, 1, stride, "downsample_conv", dtype)(x)
    return norm(name="downsample_bn")(projected, train=train, valid=valid)


def _conv(
    channels: int, size: int, stride: int, name: str, dtype: Any, init: nn.initializers.Initializer = _INIT
) -> nn.Conv:
    pad = size // 2
    return nn.Conv(
        channels,
        (size, size),
        (stride, stride),
        [(pad, pad), (pad, pad)],
        use_bias=False,
        kernel_init=init,
        dtype=dtype,
        conv_general_dilated=convolve,
        name=name,
    )
