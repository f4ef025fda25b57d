"""Lanes of markers written into BEV features: a second way in for the prior. Ours, not in the marker paper.

In Eq. (3) a cell gets the same value from a lane wherever the lane passes, so that a host that was trained without
markers has to learn much before it can use them. Here each cell that a lane passes reads its place and direction, as
cells read traffic in `models.traffic_raster`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.limits import Count, CountOrZero
from tflane_jax.priors.marker_raster import MarkerRaster


@dataclass(frozen=True)
class MarkerRasterConfig:
    """The raster and its projection.

    Attributes:
        layers: of the BEV encoder that the lanes are added to, each with separate parameters: "first" or "all".
        between: points between successive points of a lane. A lane of 100 m has 11 points 10 m apart; seven leave no
            gap in cells of 2 m.
        hidden: channels between the two linear layers of the projection.
    """

    layers: Literal["first", "all"] = "first"
    between: CountOrZero = 7
    hidden: Count = 32


class MarkerRasterFusion(nn.Module):
    """F + trust * MLP(raster), cell by cell, with the trust of the lane in place of the frame's c of Eq. (3).

    The last layer starts at zero, so that training can continue from a host without markers.
    """

    config: MarkerRasterConfig

    @nn.compact
    def __call__(self, bev: Float[Array, "q c"], raster: MarkerRaster) -> Float[Array, "q c"]:
        """Return the BEV features; cells without a trusted lane stay exactly as they are."""
        hidden = nn.relu(nn.Dense(self.config.hidden, name="hidden")(raster.features))
        added = nn.Dense(bev.shape[-1], kernel_init=nn.initializers.zeros, name="output")(hidden)
        trust = raster.trust[:, None]
        return jnp.where(trust > 0.0, bev + trust * added, bev)
