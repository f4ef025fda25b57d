"""From the bird's-eye-view evidence raster to BEV features: the CPU-sized stand-in for cameras and BEVFormer."""

from __future__ import annotations

from dataclasses import dataclass

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from tflane_jax.models.auxiliary import LaneCellHead


@dataclass(frozen=True)
class EvidenceEncoderConfig:
    """Sizes of the encoder.

    Attributes:
        dim: channels of the BEV features.
        cell: raster cells a side that become one feature cell.
        dilations: one residual block for each.
        cells: see `CameraEncoderConfig.cells`.
    """

    dim: int = 32
    cell: int = 4
    dilations: tuple[int, ...] = (1, 2, 4, 1)
    cells: bool = False


class EvidenceEncoder(nn.Module):
    """Raster cells folded into channels, then residual blocks of growing reach."""

    config: EvidenceEncoderConfig

    @nn.compact
    def __call__(self, bev: UInt8[Array, "h w c"]) -> Float[Array, "hf wf d"]:
        """Return features, `cell` times coarser than the raster; raises ValueError where that does not divide it."""
        (h, w, c), n = bev.shape, self.config.cell
        if h % n or w % n:
            raise ValueError(f"a raster of {h} x {w} cells does not fold into blocks of {n} x {n}")
        x = bev.astype(jnp.float32) / 255.0
        # Folding loses nothing and spares the convolutions at full resolution, which would cost most on a CPU.
        x = x.reshape(h // n, n, w // n, n, c).transpose(0, 2, 1, 3, 4).reshape(h // n, w // n, n * n * c)
        x = nn.relu(_norm("stem_norm")(nn.Conv(self.config.dim, (3, 3), name="stem")(x)))
        for i, dilation in enumerate(self.config.dilations):
            y = nn.Conv(self.config.dim, (3, 3), kernel_dilation=(dilation, dilation), name=f"block_{i}")(x)
            x = nn.relu(x + _norm(f"block_{i}_norm")(y))
        if self.config.cells:
            LaneCellHead(name="cells")(x)
        return x


def _norm(name: str) -> nn.GroupNorm:
    # Statistics of the example alone: no batch axis exists in here.
    return nn.GroupNorm(num_groups=8, name=name)
