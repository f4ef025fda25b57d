"""Denoising queries for training (DN-DETR, Li et al. 2022): lanes of the truth, moved and bent, to be put right.

Not part of any of the papers. A learned query must find out by itself which lane is meant for it, and while that keeps
changing it learns to stand between lanes. A noised lane belongs to one lane from the start, so that the decoder learns
to see where that runs; small models need it to converge. In prediction there are none.
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
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.element_decoder import ElementOutput
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneQueries
from tflane_jax.scene import LaneGraph, Prediction


@dataclass(frozen=True)
class DenoisingConfig:
    """How lanes are noised.

    Attributes:
        copies: groups of noised lanes.
        shift: standard deviation of a whole lane's place along x and y, metres.
        turn: of its angle about its middle, radians.
        stretch: of the logarithm of its length.
        straighten: largest share of its way to the straight line between its ends; a lane goes a uniform part of it.
    """

    copies: int = 2
    shift: float = 1.5
    turn: float = 0.1
    stretch: float = 0.15
    straighten: float = 1.0


class NoisedQueries(nn.Module):
    """Queries placed on noised lanes; those without a lane are placed anywhere and must learn to reject it.

    Attributes:
        config: sizes of the decoder.
        noise: how lanes are noised.
        range: the box that normalised coordinates span.
    """

    config: LaneDecoderConfig
    noise: DenoisingConfig
    range: PerceptionRange

    @nn.compact
    def __call__(
        self, lanes: LaneGraph
    ) -> tuple[Float[Array, "g q c"], Float[Array, "g q c"], Float[Array, "g q p 3"]]:
        """Return content, position and reference points in [0, 1] of every copy; query i belongs to lane i."""
        config, copies = self.config, self.noise.copies
        keys = jax.random.split(self.make_rng("dropout"), copies)
        lines = jax.vmap(lambda key: noised_lanes(key, lanes, config.queries, self.range, self.noise))(keys)
        reference = jnp.clip(self.range.normalise(lines), 0.01, 0.99)
        position = nn.Dense(config.dim, name="position")(reference.reshape(copies, config.queries, -1))
        if config.refine == "fixed":
            middle = config.points // 2
            reference = jnp.broadcast_to(reference[:, :, middle : middle + 1], reference.shape)
        content = self.param("content", nn.initializers.normal(1.0), (config.dim,))
        return jnp.broadcast_to(content, position.shape), position, lax.stop_gradient(reference)


def decode_lanes(
    host: Any,
    config: LaneDecoderConfig,
    bev: Float[Array, "h w e"],
    elements: ElementOutput | None,
    tokens: Any,
    lanes: LaneGraph | None,
    deterministic: bool,
) -> Prediction:
    """Return what the learned queries predict; predictions of denoising queries become the auxiliary output `denoised`.

    Both kinds go through one decoder and exchange nothing.

    Args:
        host: has the decoder, `decode_queries(start, bev, elements, tokens, deterministic)`, where `start` is what
            `LaneQueries` returns, and `config.denoising`.
        config: of the queries.
        bev, elements, tokens, deterministic: handed on.
        lanes: truth to denoise; nothing else looks at it.
    """
    start, noise = LaneQueries(config, host.config.spec.bev_range, name="queries")(), host.config.denoising
    if noise is None or lanes is None or not host.is_mutable_collection(AUXILIARY):
        return host.decode_queries(start, bev, elements, tokens, deterministic)
    noised = NoisedQueries(config, noise, host.config.spec.bev_range, name="noised")(lanes)
    starts = jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), start, noised)
    decode = nn.vmap(
        type(host).decode_queries,
        in_axes=(0, None, None, None, None),  # pyright: ignore[reportArgumentType]
        variable_axes={"params": None, "intermediates": 0},
        split_rngs={"params": False, "dropout": True},
    )
    every = decode(host, starts, bev, elements, tokens, deterministic)
    host.sow(AUXILIARY, "denoised", jax.tree.map(lambda leaf: leaf[1:], every.centerlines))
    return jax.tree.map(lambda leaf: leaf[0], every)


def noised_lanes(
    key: jax.Array, lanes: LaneGraph, count: int, range_: PerceptionRange, noise: DenoisingConfig
) -> Float[Array, "q p 3"]:
    """Return the first `count` lanes noised, metres; where there is none, a straight one anywhere in the range."""
    shift, turn, stretch, bend, place, way = jax.random.split(key, 6)
    truth = jnp.where(lanes.valid[:, None, None], lanes.points, 0.0)[:count]
    truth = jnp.pad(truth, ((0, count - len(truth)), (0, 0), (0, 0)))
    valid = jnp.pad(lanes.valid[:count], (0, count - len(lanes.valid[:count])))
    share = jnp.linspace(0.0, 1.0, truth.shape[1])[None, :, None]
    # Partly straightened, or it would never learn to bend.
    chord = truth[:, :1] + share * (truth[:, -1:] - truth[:, :1])
    truth = truth + noise.straighten * jax.random.uniform(bend, (count, 1, 1)) * (chord - truth)
    middle = truth.mean(1, keepdims=True)
    size = jnp.exp(noise.stretch * jax.random.normal(stretch, (count, 1, 1)))
    angle = noise.turn * jax.random.normal(turn, (count,))
    spot = middle[:, 0] + noise.shift * jnp.pad(jax.random.normal(shift, (count, 2)), ((0, 0), (0, 1)))
    moved = placed(size * (truth - middle), angle, spot)
    # A lane of 24 m.
    along = jnp.concatenate([24.0 * (share - 0.5), jnp.zeros((1, truth.shape[1], 2))], -1)
    heading = jax.random.uniform(way, (count,), maxval=2 * jnp.pi)
    anywhere = range_.denormalise(jax.random.uniform(place, (count, 3)))
    elsewhere = placed(jnp.broadcast_to(along, truth.shape), heading, anywhere)
    return jnp.where(valid[:, None, None], moved, elsewhere)


def placed(
    lines: Float[Array, "q p 3"], heading: Float[Array, " q"], spot: Float[Array, "q 3"]
) -> Float[Array, "q p 3"]:
    """Return polylines about the origin, turned in the plane and moved to their spots."""
    pose = yaw_pose(spot[:, 0], spot[:, 1], heading).at[:, 2, 3].set(spot[:, 2])
    return transform_points(pose, lines)
