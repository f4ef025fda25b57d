"""Depth of image cells as a distribution over bins, and features to be lifted by it (BEVDepth, Li et al. 2023).

The parameters of the cameras are inputs too: they gate the channels.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.batch_norm import BatchNorm
from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.resnet import BasicBlock

# MapTRv2 initialises all kernels of the network so.
_INIT = nn.initializers.xavier_uniform()
_DILATIONS = (1, 6, 12, 18)


class DepthNet(nn.Module):
    """Depth logits and context features of image cells.

    Attributes:
        dim: channels in and out.
        bins: of the depth.
        pyramid: channels of each branch of the dilated convolutions.
        dropout: probability, behind them.
    """

    dim: int
    bins: int
    pyramid: int = 96
    dropout: float = 0.5

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "v h w c"],
        cameras: Float[Array, "v p"],
        valid: Bool[Array, " v"] | None = None,
        *,
        train: bool,
    ) -> tuple[Float[Array, "v h w d"], Float[Array, "v h w c"]]:
        """Return depth logits and context.

        Args:
            features: of V cameras.
            cameras: parameters of the cameras.
            valid: which cameras count in the batch statistics; None for all.
            train: norms use batch statistics, and dropout is on.
        """
        cameras = BatchNorm(name="camera_norm")(cameras, train=train, valid=valid)
        x = _conv(self.dim, 3, name="reduce", use_bias=True)(features)
        x = nn.relu(BatchNorm(name="reduce_norm")(x, train=train, valid=valid))
        context = CameraGate(name="context_gate")(x, Mlp((self.dim, self.dim), _INIT, name="context_mlp")(cameras))
        context = _conv(self.dim, 1, name="context", use_bias=True)(context)
        depth = CameraGate(name="depth_gate")(x, Mlp((self.dim, self.dim), _INIT, name="depth_mlp")(cameras))
        for i in range(3):
            depth = BasicBlock(self.dim, 1, False, kernel_init=_INIT, name=f"block_{i}")(
                depth, train=train, valid=valid
            )
        depth = DilatedPyramid(self.dim, self.pyramid, self.dropout, name="pyramid")(depth, train=train, valid=valid)
        return _conv(self.bins, 1, name="depth", use_bias=True)(depth), context


class CameraGate(nn.Module):
    """Squeeze and excitation by a vector of each camera in place of the mean of its features."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"], vector: Float[Array, "v c"]) -> Float[Array, "v h w c"]:
        """Return the features, each channel scaled by a number in (0, 1)."""
        dim = x.shape[-1]
        gate = nn.relu(nn.Dense(dim, kernel_init=_INIT, name="reduce")(vector))
        gate = nn.sigmoid(nn.Dense(dim, kernel_init=_INIT, name="expand")(gate))
        return x * gate[:, None, None]


class DilatedPyramid(nn.Module):
    """Convolutions of several dilations beside the mean of the map (ASPP, Chen et al. 2017).

    Attributes:
        dim: channels out.
        hidden: channels of each branch.
        dropout: probability of each channel of each cell.
    """

    dim: int
    hidden: int
    dropout: float

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w c"], *, train: bool, valid: Bool[Array, " v"] | None = None
    ) -> Float[Array, "v h w d"]:
        """Return the features; `valid` as in `DepthNet`."""
        branches = []
        for i, dilation in enumerate(_DILATIONS):
            y = _conv(self.hidden, 1 if i == 0 else 3, dilation, name=f"conv_{i}")(x)
            branches.append(nn.relu(BatchNorm(name=f"norm_{i}")(y, train=train, valid=valid)))
        mean = nn.Dense(self.hidden, use_bias=False, kernel_init=_INIT, name="mean")(x.mean((1, 2)))
        mean = nn.relu(BatchNorm(name="mean_norm")(mean, train=train, valid=valid))
        branches.append(jnp.broadcast_to(mean[:, None, None], branches[0].shape))
        y = _conv(self.dim, 1, name="out")(jnp.concatenate(branches, -1))
        y = nn.relu(BatchNorm(name="out_norm")(y, train=train, valid=valid))
        return nn.Dropout(self.dropout, name="out_dropout")(y, deterministic=not train)


def _conv(channels: int, size: int, dilation: int = 1, *, name: str, use_bias: bool = False) -> nn.Conv:
    return nn.Conv(
        channels,
        (size, size),
        kernel_dilation=(dilation, dilation),
        use_bias=use_bias,
        kernel_init=_INIT,
        name=name,
    )
