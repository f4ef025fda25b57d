"""Priors written into BEV features: a place where a prior enters that neither paper has. Ours.

Traffic flow: the TFM changes queries only. A lane that the sensors do not see has no query near it in a host whose
queries come from the BEV features; traffic in these features can propose it. Only cells that road users passed change;
the layers of the encoder that follow spread what they learn.

Markers: in Eq. (3), a cell gets the same value from a lane wherever the lane passes, so that a host that was trained
without markers has to learn much before it can use them. Here each cell that a lane passes reads its place and
direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.limits import Count, CountOrZero


@dataclass(frozen=True)
class RasterConfig:
    """A raster of a prior and its projection.

    Attributes:
        layers: of the BEV encoder that the raster is added to, each with separate parameters: "first" or "all".
        between: points between successive points of a track or lane, so that no cell that it passes is left out.
        hidden: channels between the two linear layers of the projection.
    """

    layers: Literal["first", "all"] = "first"
    between: CountOrZero = 3
    hidden: Count = 32

    def enters(self, layer: int) -> bool:
        """Return whether the raster is added to this layer of the BEV encoder."""
        return layer == 0 or self.layers == "all"


@dataclass(frozen=True)
class TrafficRasterConfig(RasterConfig):
    """Of traffic flow (`priors.traffic_raster`): three points between fill cells of 2 m up to 8 m a frame."""


@dataclass(frozen=True)
class MarkerRasterConfig(RasterConfig):
    """Of marker lanes (`priors.marker_raster`).

    A lane of 100 m has 11 points 10 m apart; seven between them leave no gap in cells of 2 m.
    """

    between: CountOrZero = 7


class RasterFusion(nn.Module):
    """F + factor * MLP(raster), cell by cell.

    The last layer starts at zero, so that training can continue from a host without the prior.

    Attributes:
        hidden: channels between the two linear layers.
    """

    hidden: int

    @nn.compact
    def __call__(
        self,
        bev: Float[Array, "q c"],
        features: Float[Array, "q f"],
        there: Bool[Array, " q"],
        factor: Float[Array, " q"] | None = None,
    ) -> Float[Array, "q c"]:
        """Return the BEV features; cells that are not `there` stay exactly as they are.

        Args:
            bev: features of the cells.
            features: of the raster.
            there: cells that the raster has something to say about.
            factor: of each cell, for markers in place of the frame's c of Eq. (3); None: 1.
        """
        hidden = nn.relu(nn.Dense(self.hidden, name="hidden")(features))
        added = nn.Dense(bev.shape[-1], kernel_init=nn.initializers.zeros, name="output")(hidden)
        added = added if factor is None else factor[:, None] * added
        return jnp.where(there[:, None], bev + added, bev)
