"""The heat map of lane middles and the loss of lane proposals."""

import jax
import jax.numpy as jnp
import numpy as np

from tflane_jax.geometry import PerceptionRange
from tflane_jax.losses import lane_proposals as losses
from tflane_jax.models.auxiliary import LaneProposalOutputs
from tflane_jax.scene import LaneGraph

RANGE = PerceptionRange((0.0, 16.0), (0.0, 8.0), (-1.0, 1.0))
SHAPE = (4, 8, 8)  # cells of two metres, bins of 45 degrees
heat_target = jax.jit(losses.heat_target, static_argnums=(1, 2))
lane_proposal_sums = jax.jit(losses.lane_proposal_sums, static_argnums=2)


def graph(*ends, capacity=3, garbage=np.nan):
    lanes = LaneGraph.empty(capacity, 5)
    lanes.points[:] = garbage
    for i, (first, last) in enumerate(ends):
        lanes.points[i] = np.linspace((*first, 0.0), (*last, 0.0), 5)
        lanes.valid[i] = True
    return lanes


def expected(ends):
    """The Gaussian of every lane, by loops."""
    heat = np.zeros(SHAPE)
    for first, last in ends:
        middle, way = (np.asarray(first) + last) / 2, np.subtract(last, first)
        heading = np.arctan2(way[1], way[0])
        for row, column, bin_ in np.ndindex(*SHAPE):
            dx, dy = 2 * column + 1 - middle[0], 2 * row + 1 - middle[1]
            along, across = (np.cos(heading) * dx + np.sin(heading) * dy, np.cos(heading) * dy - np.sin(heading) * dx)
            turn = (heading - bin_ * np.pi / 4 + np.pi) % (2 * np.pi) - np.pi
            value = np.exp(-0.5 * ((along / 2.5) ** 2 + across**2 + (turn / np.deg2rad(20)) ** 2))
            heat[row, column, bin_] = max(heat[row, column, bin_], value)
    return heat


def test_target_equals_a_loop_over_lanes_and_cells():
    ends = [((1.0, 3.0), (9.0, 3.0)), ((14.0, 7.0), (3.0, 1.0))]
    np.testing.assert_allclose(heat_target(graph(*ends), SHAPE, RANGE), expected(ends), atol=1e-5)


def test_no_lanes_give_no_heat():
    for capacity in (0, 2):
        np.testing.assert_array_equal(heat_target(graph(capacity=capacity), SHAPE, RANGE), 0.0)


def test_loss_counts_valid_lanes_and_is_least_at_the_target():
    lanes = graph(((1.0, 3.0), (9.0, 3.0)))
    heat = heat_target(lanes, SHAPE, RANGE)
    logits = jnp.log(jnp.maximum(heat, 1e-6)) - jnp.log1p(-jnp.minimum(heat, 1.0 - 1e-6))
    points = jnp.nan_to_num(jnp.asarray(lanes.points)).at[:, 0, 0].add(2.0)
    perfect, error = lane_proposal_sums(LaneProposalOutputs(logits, points), lanes, RANGE)
    assert float(perfect) < 1e-4
    assert float(error) == 2.0  # one point of the one valid lane
    slope = jax.grad(lambda x: lane_proposal_sums(LaneProposalOutputs(x, points), lanes, RANGE)[0])(logits + 1.0)
    assert float(lane_proposal_sums(LaneProposalOutputs(logits + 1.0, points), lanes, RANGE)[0]) > float(perfect)
    assert np.isfinite(slope).all()
