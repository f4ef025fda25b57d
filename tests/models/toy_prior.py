"""A prior in one file, for tests: pedestrian crossings, into BEV features and into queries, with a memory.

Together with the line of `tests.models.test_priors.WithToy`, the line that a new prior adds to `PriorsConfig`, this
file is the whole prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.models.prior import BevCells, HostQueries, HostSpec, Prior
from tflane_jax.scene import Example


@dataclass(frozen=True)
class CrossingsConfig:
    """Pedestrian crossings as a prior.

    Attributes:
        width: channels of a token.
    """

    width: int = 8

    def build(self, host: HostSpec) -> Crossings:
        return Crossings(self, host)


@struct.dataclass
class Seen:
    """How many frames of the scene had a crossing."""

    frames: Float[Array, ""]


class Tokens(NamedTuple):
    features: Float[Array, "a c"]
    valid: Bool[Array, " a"]


class Crossings(Prior):
    reads = ("areas",)

    def __init__(self, config: CrossingsConfig, host: HostSpec):
        self.config, self.host = config, host
        self.crossing_tokens = nn.Dense(config.width)

    def modules(self):
        return {"crossing_tokens": self.crossing_tokens}

    def start(self):
        return Seen(jnp.zeros(()))

    def observe(self, example: Example, memory: Seen | None):
        valid = jnp.asarray(example.areas.valid)
        points = jnp.where(valid[:, None, None], jnp.asarray(example.areas.points), 0.0)
        before = jnp.zeros(()) if memory is None else jnp.where(example.has_previous, memory.frames, 0.0)
        unit = self.host.bev_range.normalise(points).mean(1)
        observation = jnp.concatenate([unit, jnp.full((len(unit), 1), before)], -1), valid
        return observation, None if memory is None else Seen(before + valid.any())

    def encode(self, observation, *, deterministic):
        features, valid = observation
        return Tokens(jnp.where(valid[:, None], self.crossing_tokens(features), 0.0), valid)

    def into_bev(self, tokens: Tokens, layer: int, cells: BevCells):
        attention = MultiHeadAttention(8, 2, out=cells.features.shape[-1], name=f"crossings_{layer}")
        found = attention(cells.features + cells.position, tokens.features, tokens.features, tokens.valid[None])
        return jnp.where(tokens.valid.any(), cells.features + found, cells.features)

    def into_queries(self, tokens: Tokens, layer: int, queries: HostQueries):
        attention = MultiHeadAttention(8, 2, out=self.host.dim, name=f"crossings_to_queries_{layer}")
        where = queries.features + queries.position
        found = attention(where, tokens.features, tokens.features, tokens.valid[None])
        return jnp.where(tokens.valid.any(), queries.features + found, queries.features)


def with_crossings(example: Example, count: int, seed: int = 0, filler: float = 0.0) -> Example:
    """Return an example with some crossings; padding holds `filler`."""
    rng = jax.random.key(seed)
    points = jax.random.uniform(rng, (4, 5, 3), minval=-20.0, maxval=20.0)
    valid = jnp.arange(4) < count
    points = jnp.where(valid[:, None, None], points, filler)
    areas = example.areas.replace(points=points, category=jnp.ones(4, jnp.int32), valid=valid)
    return example.replace(areas=areas)
