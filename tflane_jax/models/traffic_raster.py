"""Traffic flow written into BEV features: a second place where the prior enters. Ours, not in the TF-Lane paper.

The paper's TFM changes queries only. A lane that the sensors do not see has no query near it in a host whose queries
come from the BEV features; traffic in these features can propose it. Only cells that road users passed change; the
layers of the encoder that follow spread what they learn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.limits import Count, CountOrZero
from tflane_jax.priors.traffic_raster import TrafficRaster


@dataclass(frozen=True)
class TrafficRasterConfig:
    """The raster and its projection.

    Attributes:
        layers: of the BEV encoder that the traffic is added to, each with separate parameters: "first" or "all".
        between: see `priors.traffic_raster.rasterise_traffic_flow`. Three fill cells of 2 m up to 8 m a frame.
        hidden: channels between the two linear layers of the projection.
    """

    layers: Literal["first", "all"] = "first"
    between: CountOrZero = 3
    hidden: Count = 32


class TrafficRasterFusion(nn.Module):
    """A two-layer perceptron on each cell's traffic, added to the cell's features.

    Its last layer starts at zero, so that training can continue from a host without traffic flow.
    """

    config: TrafficRasterConfig

    @nn.compact
    def __call__(self, bev: Float[Array, "q c"], raster: TrafficRaster) -> Float[Array, "q c"]:
        """Return the BEV features; cells without traffic stay exactly as they are."""
        hidden = nn.relu(nn.Dense(self.config.hidden, name="hidden")(raster.features))
        added = nn.Dense(bev.shape[-1], kernel_init=nn.initializers.zeros, name="output")(hidden)
        return jnp.where(raster.touched[:, None], bev + added, bev)
