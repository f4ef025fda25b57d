"""Graph convolution on soft selections of edge types, without products of adjacencies (FastGTN, Yun et al. 2022).

Equation numbers are those of the GTN lane paper, section 2.1. The tests hold the dense networks too (GTN, Yun et al.
2019, and its sparse revision).
"""

from __future__ import annotations

from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float


def propagate(
    mix: Callable[[int, Float[Array, "e d"], Float[Array, "*n d"]], Float[Array, "*n d"]],
    weights: Float[Array, "hops c e"],
    x: Float[Array, "*n d"],
) -> Float[Array, "*n d"]:
    """Return ... Q_2 (Q_1 x): the mixtures of Eq. (1) applied in turn, without a product of adjacencies.

    By associativity this is convolution on the meta-path graph ... Q_2 Q_1 (FastGTN). If the edges into every node sum
    to 1 in each edge type, they sum to 1 in the product too, which then needs no normalisation.

    Args:
        mix: maps (hop, edge-type weights, x) to sum_e weight_e A_e x; it decides how the A_e are stored.
        weights: W of Eq. (1) by hop; -inf excludes an edge type from a hop.
        x: features of the channels side by side, d a multiple of c.
    """
    by_hop = jnp.repeat(nn.softmax(weights, -1), x.shape[-1] // weights.shape[1], axis=1).swapaxes(1, 2)
    for hop, type_weights in enumerate(by_hop):
        x = mix(hop, type_weights, x)
    return x
