"""Denoising queries for training (DN-DETR, Li et al. 2022): noised ground-truth lanes to be restored.

Not part of the lane papers. Early in training, the matching of learned queries changes from step to step, and queries
settle between lanes. A denoising query belongs to one lane from the start, so the decoder gets a stable target; small
models need this to converge. There are no denoising queries in prediction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange, transform_points, yaw_pose
from tflane_jax.limits import Count, Fraction, PositiveOrZero
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneStart
from tflane_jax.scene import LaneGraph, MapLines, Prediction


@dataclass(frozen=True)
class DenoisingConfig:
    """Noise added to ground-truth lanes.

    Attributes:
        copies: groups of noised lanes.
        shift: standard deviation of a lane's translation along x and y, metres.
        turn: standard deviation of its rotation about its mean point, radians.
        stretch: standard deviation of the logarithm of its scale.
        straighten: upper limit of the uniform weight with which a lane is blended with the chord between its ends. A
            ring has none and keeps its form.
    """

    copies: Count = 2
    shift: PositiveOrZero = 1.5
    turn: PositiveOrZero = 0.1
    stretch: PositiveOrZero = 0.15
    straighten: Fraction = 1.0


class NoisedQueries(nn.Module):
    """Queries placed on noised lanes; surplus queries get random straight lanes as negative examples.

    Attributes:
        config: sizes of the decoder.
        noise: noise added to lanes.
        range: the box that normalised coordinates span.
    """

    config: LaneDecoderConfig
    noise: DenoisingConfig
    range: PerceptionRange

    @nn.compact
    def __call__(self, lanes: LaneGraph) -> LaneStart:
        """Return the queries of every copy, as a leading axis; query i of a copy belongs to lane i."""
        config, copies = self.config, self.noise.copies
        keys = jax.random.split(self.make_rng("dropout"), copies)
        lines = jax.vmap(lambda key: noised_lanes(key, lanes, config.queries, self.range, self.noise))(keys)
        # Away from 0 and 1, where the sigmoid of the points is flat.
        border = 0.01 if config.output == "sigmoid" else 0.0
        reference = jnp.clip(self.range.normalise(lines), border, 1.0 - border)
        position = nn.Dense(config.dim, name="position")(reference.reshape(copies, config.queries, -1))
        if config.refine == "fixed":
            middle = config.points // 2
            reference = jnp.broadcast_to(reference[:, :, middle : middle + 1], reference.shape)
        content = self.param("content", nn.initializers.normal(1.0), (config.dim,), jnp.float32)
        return LaneStart(jnp.broadcast_to(content, position.shape), position, lax.stop_gradient(reference))


def decode_groups(host: Any, start: Any, noised: Any, *arguments: Any) -> Prediction:
    """Return the predictions of the queries `start`, and sow those of `noised`, with a leading axis over copies.

    Args:
        host: module with `decode_queries(start, *arguments)`.
        start, noised: one set of queries, and others with a leading axis over copies.
        arguments: the same for all sets.
    """
    starts = jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), start, noised)
    decode = nn.vmap(
        type(host).decode_queries,
        in_axes=(0, *(None,) * len(arguments)),  # pyright: ignore[reportArgumentType]
        variable_axes={"params": None, "intermediates": 0},
        split_rngs={"params": False, "dropout": True},
    )
    every = decode(host, starts, *arguments)
    found = next(part for part in (every.segments, every.lines, every.centerlines) if part is not None)
    host.sow(AUXILIARY, "denoised", jax.tree.map(lambda leaf: leaf[1:], found))
    return jax.tree.map(lambda leaf: leaf[0], every)


def noised_lanes(
    key: jax.Array, lanes: LaneGraph | MapLines, count: int, range_: PerceptionRange, noise: DenoisingConfig
) -> Float[Array, "q p 3"]:
    """Return the first `count` lanes noised, metres; in place of padding, random straight lanes in the range."""
    shift, turn, stretch, bend, place, way = jax.random.split(key, 6)
    truth = jnp.where(lanes.valid[:, None, None], lanes.points, 0.0)[:count]
    spare = count - len(truth)
    truth = jnp.pad(truth, ((0, spare), (0, 0), (0, 0)))
    valid = jnp.pad(lanes.valid[:count], (0, spare))
    fraction = jnp.linspace(0.0, 1.0, truth.shape[1])[None, :, None]
    # Partly straightened, so that the decoder learns to bend lanes.
    chord = truth[:, :1] + fraction * (truth[:, -1:] - truth[:, :1])
    weight = noise.straighten * jax.random.uniform(bend, (count, 1, 1))
    if isinstance(lanes, MapLines):
        # The chord of a ring is a point.
        weight = jnp.where(jnp.pad(lanes.closed[:count], (0, spare))[:, None, None], 0.0, weight)
    truth = truth + weight * (chord - truth)
    middle = truth.mean(1, keepdims=True)
    size = jnp.exp(noise.stretch * jax.random.normal(stretch, (count, 1, 1)))
    angle = noise.turn * jax.random.normal(turn, (count,))
    spot = middle[:, 0] + noise.shift * jnp.pad(jax.random.normal(shift, (count, 2)), ((0, 0), (0, 1)))
    moved = placed(size * (truth - middle), angle, spot)
    # Random lanes are 24 m long.
    along = jnp.concatenate([24.0 * (fraction - 0.5), jnp.zeros((1, truth.shape[1], 2))], -1)
    heading = jax.random.uniform(way, (count,), maxval=2 * jnp.pi)
    anywhere = range_.denormalise(jax.random.uniform(place, (count, 3)))
    elsewhere = placed(jnp.broadcast_to(along, truth.shape), heading, anywhere)
    return jnp.where(valid[:, None, None], moved, elsewhere)


def placed(
    lines: Float[Array, "q p 3"], heading: Float[Array, " q"], spot: Float[Array, "q 3"]
) -> Float[Array, "q p 3"]:
    """Return polylines rotated by `heading` (radians, about z) and moved from the origin to `spot` (metres)."""
    pose = yaw_pose(spot[:, 0], spot[:, 1], heading).at[:, 2, 3].set(spot[:, 2])
    return transform_points(pose, lines)
