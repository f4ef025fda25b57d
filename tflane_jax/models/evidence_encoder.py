"""From the bird's-eye-view evidence raster to BEV features: the CPU-sized stand-in for cameras and BEVFormer."""

from __future__ import annotations

from dataclasses import dataclass

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8


@dataclass(frozen=True)
class EvidenceEncoderConfig:
    """Sizes of the encoder.

    Attributes:
        dim: channels of the BEV features.
        stem: channels at half resolution.
        dilations: one residual block at quarter resolution for each.
    """

    dim: int = 64
    stem: int = 32
    dilations: tuple[int, ...] = (1, 2, 4, 1)


class EvidenceEncoder(nn.Module):
    """Strided convolutions, then residual blocks of growing reach."""

    config: EvidenceEncoderConfig

    @nn.compact
    def __call__(self, bev: UInt8[Array, "h w c"]) -> Float[Array, "h4 w4 d"]:
        """Return features at a quarter of the raster's resolution."""
        x = bev.astype(jnp.float32) / 255.0
        # Two cells a side folded into channels: the first convolution then runs on a quarter of the cells.
        h, w, c = x.shape
        x = x.reshape(h // 2, 2, w // 2, 2, c).transpose(0, 2, 1, 3, 4).reshape(h // 2, w // 2, 4 * c)
        x = nn.relu(_norm("stem_norm")(nn.Conv(self.config.stem, (3, 3), name="stem")(x)))
        x = nn.Conv(self.config.dim, (3, 3), strides=(2, 2), name="reduce")(x)
        x = nn.relu(_norm("reduce_norm")(x))
        for i, dilation in enumerate(self.config.dilations):
            y = nn.Conv(self.config.dim, (3, 3), kernel_dilation=(dilation, dilation), name=f"block_{i}")(x)
            x = nn.relu(x + _norm(f"block_{i}_norm")(y))
        return x


def _norm(name: str) -> nn.GroupNorm:
    # Statistics of the example alone: no batch axis exists in here.
    return nn.GroupNorm(num_groups=8, name=name)
