"""What models say for their losses alone."""

from __future__ import annotations

import flax.linen as nn
from jaxtyping import Array, Float

from tflane_jax.losses.lane_cells import CHANNELS

AUXILIARY = "auxiliary"
"""Collection in which a model leaves what an auxiliary loss looks at; it is filled only where a caller asks for it."""


class LaneCellHead(nn.Module):
    """Says of every BEV cell what `losses.lane_cells` asks, in the collection `AUXILIARY` as `lane_cells`."""

    @nn.compact
    def __call__(self, bev: Float[Array, "h w c"]) -> None:
        """Look at BEV features; does nothing where nobody asks."""
        if self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "lane_cells", nn.Dense(CHANNELS, name="out")(bev))
