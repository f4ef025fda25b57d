"""A host and its loss, for tests: learned polylines of a vector map, moved by the mean of the BEV features.

A real one is a file in `models/` and one in `losses/`; nothing else has to know it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import flax.linen as nn
import jax.numpy as jnp

from tflane_jax.losses.common import HostLossConfig
from tflane_jax.models.host import Host, HostConfig
from tflane_jax.models.prior import HostQueries
from tflane_jax.models.priors import fuse_into_queries
from tflane_jax.scene import LinePrediction, Prediction


@dataclass(frozen=True, kw_only=True)
class ToyHostConfig(HostConfig):
    """Lines of a vector map from `queries` learned queries."""

    queries: int = 5
    points: int = 4

    truth: ClassVar[tuple[str, ...]] = ("map_lines", "segments", "areas")
    predicts: ClassVar[tuple[str, ...]] = ("lines",)

    @property
    def query_dim(self) -> int:
        return 16

    def build(self) -> ToyHost:
        return ToyHost(self)


class ToyHost(Host):
    config: ToyHostConfig

    @nn.compact
    def decode_example(self, example, bev, elements, tokens, *, deterministic):
        config = self.config
        queries = self.param("queries", nn.initializers.normal(1.0), (config.queries, config.query_dim))
        queries = queries + nn.Dense(config.query_dim, name="context")(bev.mean((0, 1)))[None]
        position, reference = jnp.zeros_like(queries), jnp.full((config.queries, 1, 2), 0.5)
        queries = fuse_into_queries(self.priors.by_name, tokens, 0, HostQueries(queries, position, reference))
        points = nn.Dense(config.points * 3, name="points")(queries).reshape(config.queries, config.points, 3)
        logits = nn.Dense(4, name="class")(queries)
        points = config.encoder.bev_range.denormalise(nn.sigmoid(points))
        return Prediction(lines=LinePrediction(points[None], logits[None]))


@dataclass(frozen=True)
class ToyHostLossConfig(HostLossConfig):
    """Pulls every line towards the mean of the true ones."""

    def loss(self, outputs, auxiliary, batch, host):
        lines = batch.map_lines
        weight = lines.valid[..., None, None].astype(jnp.float32)
        points = jnp.where(lines.valid[..., None, None], lines.points, 0.0)
        mean = (points * weight).sum((1, 2)) / jnp.maximum(weight.sum((1, 2)) * points.shape[2], 1.0)
        loss = jnp.abs(outputs.lines.points - mean[:, None, None, None]).mean()
        return loss, {"points": loss}
