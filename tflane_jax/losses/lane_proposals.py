"""Auxiliary loss of lane proposals (`models.lane_proposals`): the heat map of lane middles, and the proposed shapes."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.losses.common import quality_focal
from tflane_jax.models.auxiliary import LaneProposalOutputs
from tflane_jax.models.lane_proposals import lane_middles
from tflane_jax.scene import LaneGraph

# Standard deviations of the target around the middle of a lane: along, across (metres), heading (radians).
_ALONG, _ACROSS, _TURN = 2.5, 1.0, math.radians(20.0)


def heat_target(lanes: LaneGraph, shape: tuple[int, int, int], range_: PerceptionRange) -> Float[Array, "h w k"]:
    """Return the target of the heat map, 0 to 1: a Gaussian around the middle of every lane, the largest of all lanes.

    Args:
        lanes: ground truth; padding may hold anything.
        shape: rows, columns and heading bins.
        range_: the box that the grid covers, metres.
    """
    h, w, k = shape
    if not len(lanes.valid):
        return jnp.zeros(shape)
    middle, heading = lane_middles(lanes)
    apart = jnp.asarray(range_.denormalise(cell_points(BevGrid(rows=h, columns=w))))[:, None] - middle[None]
    cos, sin = jnp.cos(heading)[None], jnp.sin(heading)[None]
    along, across = cos * apart[..., 0] + sin * apart[..., 1], cos * apart[..., 1] - sin * apart[..., 0]
    bins = jnp.asarray(2.0 * np.pi / k * np.arange(k), heading.dtype)
    turn = jnp.mod(heading[:, None] - bins[None] + math.pi, 2.0 * math.pi) - math.pi
    place = jnp.exp(-0.5 * ((along / _ALONG) ** 2 + (across / _ACROSS) ** 2))  # (hw, N)
    place = jnp.where(lanes.valid[None], place, 0.0)
    return (place[:, :, None] * jnp.exp(-0.5 * (turn / _TURN) ** 2)[None]).max(1).reshape(shape)


def lane_proposal_sums(
    outputs: LaneProposalOutputs, lanes: LaneGraph, range_: PerceptionRange
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the sums over one example of the heat map's quality focal loss, and of the L1 errors of proposed points.

    Args:
        outputs: of one example.
        lanes: ground truth; padding may hold anything.
        range_: the box that the heat map covers, metres.
    """
    rows, columns, bins = outputs.heat.shape
    target = heat_target(lanes, (rows, columns, bins), range_)
    truth = jnp.where(lanes.valid[:, None, None], lanes.points, 0.0)
    error = jnp.abs(outputs.lanes - truth).sum((-2, -1))
    return quality_focal(outputs.heat, target, 2.0).sum(), jnp.where(lanes.valid, error, 0.0).sum()
