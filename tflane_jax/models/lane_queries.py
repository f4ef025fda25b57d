"""The sizes of the lane decoder, and its learned queries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.positions import inverse_sigmoid
from tflane_jax.layers.precision import Precision
from tflane_jax.limits import Count, FractionBelowOne, Positive, PositiveOrZero, Rules, counted, splits


@dataclass(frozen=True)
class LaneProposalConfig:
    """Dense lane proposals (`models.lane_proposals`); not part of the lane papers.

    Attributes:
        count: how many of the decoder's queries are proposals.
        headings: heading bins of the heat map.
        hidden: channels of the heads.
        jitter: standard deviation of the places at which the shape head is trained, along and across the lane, metres.
        turn: the same of the heading, radians.
    """

    count: Count = 40
    headings: Count = 8
    hidden: Count = 64
    jitter: tuple[PositiveOrZero, PositiveOrZero] = (2.0, 0.8)
    turn: PositiveOrZero = 0.25


@dataclass(frozen=True)
class LaneDecoderConfig:
    """Sizes of the decoder. The defaults train on two CPU cores; `PAPER_LANE_DECODER` has TopoNet's.

    Attributes:
        dim: channels of a query.
        heads: attention heads.
        layers: decoder layers.
        queries: lane queries Q.
        points: points P of a centerline.
        sampling_points: deformable sampling points per head.
        hidden: channels inside the feed-forward block.
        relation: channels of each partner in the relationship head.
        bands: frequencies per coordinate in the position encoding of a refined lane.
        refine: see `models.lane_decoder`.
        output: "sigmoid" adds the change of a lane to the logit of its reference, as in Deformable DETR. "metric" adds
            it in units of `metres` and clips at the border of the perception range, where the sigmoid is flat: lanes
            that leave the range end there.
        metres: unit of change along x, y and z where the output is "metric".
        proposals: queries from a heat map of lanes beside the learned ones; None for learned ones only.
        dropout: probability, for attention weights, hidden channels, messages and every residual branch.
        precision: dtype of linear layers, see `layers.precision`; parameters, points and scores are float32.
        remat: recompute each layer's activations for the gradient instead of keeping them.
    """

    dim: Count = 64
    heads: Count = 8
    layers: Count = 3
    queries: Count = 48
    points: Annotated[int, counted(2)] = 11
    sampling_points: Count = 4
    hidden: Count = 128
    relation: Count = 16
    bands: Count = 6
    refine: Literal["fixed", "iterative"] = "iterative"
    output: Literal["sigmoid", "metric"] = "sigmoid"
    metres: tuple[Positive, Positive, Positive] = (5.0, 5.0, 0.3)
    proposals: LaneProposalConfig | None = None
    dropout: FractionBelowOne = 0.0
    precision: Precision = "float32"
    remat: bool = False

    def limits(self) -> Rules:
        """Channels split over heads, and proposals are among the queries."""
        yield splits("heads", self.heads, "dim", self.dim)
        if self.proposals is not None:
            fits = self.proposals.count <= self.queries
            yield "proposals.count", fits, f"at most the decoder's queries ({self.queries})"

    @property
    def learned_queries(self) -> int:
        """Number of queries that are not proposals."""
        return self.queries - (0 if self.proposals is None else self.proposals.count)


PAPER_LANE_DECODER = LaneDecoderConfig(
    dim=256, layers=6, queries=200, hidden=512, relation=128, refine="fixed", dropout=0.1
)


class LaneStart(NamedTuple):
    """The queries of Q lanes before the first layer.

    Attributes:
        content, position: (Q, C); the position is added to the content in attention.
        reference: (Q, P, 3) lanes in [0, 1] of the BEV range.
    """

    content: Float[Array, "*b q c"]
    position: Float[Array, "*b q c"]
    reference: Float[Array, "*b q p 3"]


class LaneQueries(nn.Module):
    """The learned queries: content, position and reference points.

    Attributes:
        config: sizes.
        range: the box that normalised coordinates span.
    """

    config: LaneDecoderConfig
    range: PerceptionRange

    @nn.compact
    def __call__(self) -> LaneStart:
        """Return content, position and initial reference points.

        "fixed": one point per lane, a linear function of the position; "iterative": learned anchor lanes.
        """
        config = self.config
        embedding = self.param(
            "embedding", nn.initializers.normal(1.0), (config.learned_queries, 2 * config.dim), jnp.float32
        )
        position, content = jnp.split(embedding, 2, -1)
        if config.refine == "iterative":
            start = spread_lanes(config.learned_queries, config.points, self.range)
            anchors = self.param("anchors", lambda _: inverse_sigmoid(jnp.asarray(start, jnp.float32)))
            return LaneStart(content, position, nn.sigmoid(anchors))
        spot = nn.sigmoid(nn.Dense(3, kernel_init=nn.initializers.xavier_uniform(), name="reference")(position))
        shape = (config.learned_queries, config.points, 3)
        return LaneStart(content, position, jnp.broadcast_to(spot[:, None], shape))


def spread_lanes(count: int, points: int, range_: PerceptionRange, length: float = 24.0) -> Float[np.ndarray, "q p 3"]:
    """Return the initial anchors: `count` straight lanes spread evenly over the range, in [0, 1].

    Centers and headings follow a Halton sequence: 30 percent head along the ego's x axis, 30 percent against it, 40
    percent in any direction. `length` is in metres.
    """
    sample = np.stack([_radical_inverse(np.arange(1, count + 1), base) for base in (2, 3, 5)], -1)
    middle = np.asarray(range_.low(2)) + sample[:, :2] * np.asarray(range_.size(2))
    fraction = sample[:, 2] / 0.6  # below 0.5: against x; below 1: along x; above: any direction
    along_x = np.where(fraction < 0.5, np.pi, 0.0)
    heading = np.where(fraction < 1.0, along_x, 2 * np.pi * (sample[:, 2] - 0.6) / 0.4)
    along = np.linspace(-length / 2, length / 2, points)
    direction = np.stack([np.cos(heading), np.sin(heading)], -1)
    lanes = np.zeros((count, points, 3), np.float32)
    lanes[..., :2] = middle[:, None] + along[None, :, None] * direction[:, None]
    # Away from 0 and 1, where the sigmoid of the points is flat.
    return np.clip(range_.normalise(lanes), 0.02, 0.98)


def _radical_inverse(number: Int[np.ndarray, " n"], base: int) -> Float[np.ndarray, " n"]:
    """Return the digits of natural numbers in a base, mirrored at the point: a coordinate of the Halton sequence."""
    found, weight = np.zeros(len(number)), 1.0
    while number.any():
        number, digit = np.divmod(number, base)
        weight /= base
        found += digit * weight
    return found
