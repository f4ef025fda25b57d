"""What models say for their losses alone."""

from __future__ import annotations

import flax.linen as nn
from jaxtyping import Array, Float

AUXILIARY = "auxiliary"
"""Collection in which a model leaves what an auxiliary loss looks at; it is filled only where a caller asks for it."""

CELL_CHANNELS = 5
"""What a BEV cell says: the logit that a lane is in it, the x and y of the way to the nearest lane, in cells, and those
of that lane's direction."""


class LaneCellHead(nn.Module):
    """Says of every BEV cell what `losses.lane_cells` asks, in the collection `AUXILIARY` as `lane_cells`."""

    @nn.compact
    def __call__(self, bev: Float[Array, "h w c"]) -> None:
        """Look at BEV features; does nothing where nobody asks."""
        if self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "lane_cells", nn.Dense(CELL_CHANNELS, name="out")(bev))
