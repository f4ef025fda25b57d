"""Dense lane proposals: BEV cells predict lanes whose middle lies in them; the best become queries of the decoder.

Not part of the lane papers. A heat map scores every BEV cell: does the middle of a lane lie there, in bins of its
heading? A shape head gives the lane's points relative to the cell, in the frame of the bin. The best cells after
suppression are the decoder's reference lanes, and their features its queries. Every cell learns from every frame,
whereas a learned query learns only from the lanes that it is matched with: small models need that.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.layers.graph import Mlp
from tflane_jax.limits import SettingError
from tflane_jax.models.auxiliary import AUXILIARY, LaneProposalOutputs
from tflane_jax.models.lane_decoder import smooth_basis
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneProposalConfig, LaneStart
from tflane_jax.scene import LaneGraph

# Half the length of the straight lane that the untrained shape head proposes, metres.
_HALF_LENGTH = 12.0


class LaneProposals(nn.Module):
    """Heat map, shape head and selection.

    Attributes:
        config: of the decoder; `config.proposals` is set.
        range: the box that BEV features cover and normalised coordinates span, metres.
    """

    config: LaneDecoderConfig
    range: PerceptionRange

    @nn.compact
    def __call__(self, bev: Float[Array, "h w e"], lanes: LaneGraph | None) -> LaneStart:
        """Return the proposed queries, best first.

        Sows the auxiliary output `lane_proposals` if lanes are given and the collection is mutable.

        Args:
            bev: BEV features, row 0 at the smallest y, column 0 at the smallest x.
            lanes: ground truth near which the shape head is trained; not used otherwise.

        Raises:
            SettingError: more proposals than cells and bins.
        """
        config, proposals = self.config, _proposals(self.config)
        h, w, _ = bev.shape
        if proposals.count > (most := h * w * proposals.headings):
            allowed = f"at most {most}: BEV features of {h} x {w} cells, {proposals.headings} headings each"
            raise SettingError("task.model.decoder.proposals.count", proposals.count, allowed)
        x = nn.Conv(proposals.hidden, (3, 3), name="conv")(bev)
        x = nn.relu(nn.LayerNorm(epsilon=1e-5, name="norm")(x))
        # Bias -log 99: the initial probability is 0.01 (focal loss prior, Lin et al. 2017).
        bias = nn.initializers.constant(-np.log(99.0))
        heat = nn.Dense(proposals.headings, bias_init=bias, name="heat")(x)
        table, centers = x.reshape(h * w, -1), jnp.asarray(self._centers(h, w))
        embedding = self.param(
            "heading", nn.initializers.normal(0.1), (proposals.headings, proposals.hidden), jnp.float32
        )
        shape = Mlp((proposals.hidden, proposals.hidden, config.points * 3), name="shape")

        def propose(cell: Int[Array, " k"], heading: Int[Array, " k"]):
            feature = table[cell] + jnp.take(embedding, heading, axis=0)
            points = _in_bin(shape(feature).reshape(-1, config.points, 3), config)
            return feature, _placed(points, centers[cell], heading, proposals.headings)

        if lanes is not None and self.is_mutable_collection(AUXILIARY):
            cell, heading = jittered_middles(self.make_rng("dropout"), lanes, proposals, self.range, (h, w))
            self.sow(AUXILIARY, "lane_proposals", LaneProposalOutputs(heat, propose(cell, heading)[1]))
        cell, heading, score = best_cells(lax.stop_gradient(heat), proposals.count)
        feature, points = propose(cell, heading)
        # Away from 0 and 1, where the sigmoid of the points is flat.
        border = 0.01 if config.output == "sigmoid" else 0.0
        reference = lax.stop_gradient(jnp.clip(self.range.normalise(points), border, 1.0 - border))
        content = nn.Dense(config.dim, name="content")(jnp.concatenate([feature, score[:, None]], -1))
        position = nn.Dense(config.dim, name="position")(reference.reshape(len(cell), -1))
        if config.refine == "fixed":  # all layers look at one point
            middle = config.points // 2
            reference = jnp.broadcast_to(reference[:, middle : middle + 1], reference.shape)
        return LaneStart(content, position, reference)

    def _centers(self, h: int, w: int) -> Float[np.ndarray, "q 2"]:
        """Return the centers of all cells, metres."""
        return np.asarray(self.range.denormalise(cell_points(BevGrid(rows=h, columns=w))))


def lane_middles(lanes: LaneGraph) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """Return the middle point (x, y) of each lane, metres, and the heading there, radians; padding gives 0."""
    points = jnp.where(lanes.valid[:, None, None], lanes.points, 0.0)
    middle = points.shape[1] // 2
    step = points[:, min(middle + 1, points.shape[1] - 1), :2] - points[:, max(middle - 1, 0), :2]
    along = jnp.where(jnp.any(step != 0.0, -1)[:, None], step, jnp.array([[1.0, 0.0]]))
    return points[:, middle, :2], jnp.arctan2(along[:, 1], along[:, 0])


def jittered_middles(
    key: jax.Array, lanes: LaneGraph, config: LaneProposalConfig, range_: PerceptionRange, shape: tuple[int, int]
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Return a cell near the middle of each lane, and a heading bin near its heading."""
    (h, w), (middle, heading) = shape, lane_middles(lanes)
    place, turn = jax.random.split(key)
    shift = jax.random.normal(place, (len(middle), 2)) * jnp.asarray(config.jitter)[None]
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    spot = middle + jnp.stack([cos * shift[:, 0] - sin * shift[:, 1], sin * shift[:, 0] + cos * shift[:, 1]], -1)
    size = jnp.array([w, h])
    cell = jnp.clip(jnp.floor(range_.normalise(spot) * size[None]).astype(jnp.int32), 0, size[None] - 1)
    angle = heading + config.turn * jax.random.normal(turn, heading.shape)
    bins = jnp.round(angle * (config.headings / (2.0 * math.pi))).astype(jnp.int32) % config.headings
    return cell[:, 1] * w + cell[:, 0], bins


def best_cells(
    heat: Float[Array, "h w k"], count: int
) -> tuple[Int[Array, " q"], Int[Array, " q"], Float[Array, " q"]]:
    """Return cell index, heading bin and logit of the `count` best local maxima, best first.

    A maximum exceeds the 3 x 3 cells around it in its own bin and the two next to it (bins form a circle). If there are
    fewer, other cells follow.
    """
    k = heat.shape[-1]
    circle = jnp.concatenate([heat[..., -1:], heat, heat[..., :1]], -1) if k > 2 else heat
    depth = ((1, 1), (1, 1), (0, 0) if k > 2 else (1, 1))
    largest = lax.reduce_window(circle, -jnp.inf, lax.max, (3, 3, 3), (1, 1, 1), depth)
    # Others rank below every maximum, in their own order.
    ranked = jnp.where(heat >= largest, heat, heat - 100.0)
    _, index = lax.top_k(ranked.reshape(-1), count)
    return index // k, index % k, heat.reshape(-1)[index]


def _in_bin(coefficients: Float[Array, "q p 3"], config: LaneDecoderConfig) -> Float[Array, "q p 3"]:
    """Return points relative to the cell, metres, in the frame of the heading bin."""
    straight = np.zeros((1, config.points, 3), np.float32)
    # Column 1 of the basis falls from 1 to -1 along the lane.
    straight[0, 1, 0] = -_HALF_LENGTH
    coefficients = jnp.asarray(straight) + coefficients * jnp.asarray(config.metres)[None, None]
    return jnp.einsum("pk,qkc->qpc", smooth_basis(config.points), coefficients, precision="highest")


def _placed(
    points: Float[Array, "q p 3"], center: Float[Array, "q 2"], heading: Int[Array, " q"], headings: int
) -> Float[Array, "q p 3"]:
    """Return points in the ego frame, metres."""
    angle = heading * (2.0 * math.pi / headings)
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return jnp.stack([center[:, :1] + cos * x - sin * y, center[:, 1:] + sin * x + cos * y, z], -1)


def _proposals(config: LaneDecoderConfig) -> LaneProposalConfig:
    if config.proposals is None:
        raise ValueError("config.proposals is None")
    return config.proposals
