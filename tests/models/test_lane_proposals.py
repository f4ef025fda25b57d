"""Dense lane proposals: places, headings, local maxima, and queries on the lanes that cells propose."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import BASELINE, make_example
from tests.parameters import random_params, zero_params
from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import SettingError
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.lane_proposals import LaneProposals, _placed, best_cells, jittered_middles, lane_middles
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneProposalConfig
from tflane_jax.scene import LaneGraph, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

RANGE = PerceptionRange((0.0, 16.0), (0.0, 8.0), (-1.0, 1.0))
SHAPE = (4, 8)  # cells of two metres
PROPOSALS = LaneProposalConfig(count=3, headings=8, hidden=8)
DECODER = LaneDecoderConfig(dim=8, heads=2, queries=5, points=5, hidden=8, proposals=PROPOSALS)


def graph(*ends, capacity=4, garbage=np.nan):
    lanes = LaneGraph.empty(capacity, 5)
    lanes.points[:] = garbage
    for i, (first, last) in enumerate(ends):
        lanes.points[i] = np.linspace((*first, 0.0), (*last, 0.0), 5)
        lanes.valid[i] = True
    return lanes


LANES = graph(((1.0, 3.0), (9.0, 3.0)), ((5.0, 8.0), (5.0, 2.0)))


def test_middles_and_headings_ignore_padding():
    place, heading = lane_middles(LANES)
    np.testing.assert_allclose(place[:2], [[5.0, 3.0], [5.0, 5.0]])
    np.testing.assert_allclose(heading[:2], [0.0, -np.pi / 2], atol=1e-6)
    np.testing.assert_array_equal(place[2:], 0.0)
    assert np.isfinite(heading).all()
    assert lane_middles(graph(capacity=0))[0].shape == (0, 2)


def test_without_jitter_the_cell_and_bin_of_the_middle_are_drawn():
    still = replace(PROPOSALS, jitter=(0.0, 0.0), turn=0.0)
    cell, heading = jittered_middles(jax.random.key(0), LANES, still, RANGE, SHAPE)
    np.testing.assert_array_equal(cell[:2], [1 * 8 + 2, 2 * 8 + 2])
    np.testing.assert_array_equal(heading[:2], [0, 6])


def test_jitter_runs_along_and_across_the_lane():
    lanes = graph(*[((1.0, 1.0), (1.0, 7.0))] * 200, capacity=200)
    along = replace(PROPOSALS, jitter=(2.0, 0.0), turn=0.0)
    cell, _ = jittered_middles(jax.random.key(0), lanes, along, RANGE, SHAPE)
    assert set(np.asarray(cell % 8)) == {0}  # the lane heads along y
    assert set(np.asarray(cell // 8)) == {0, 1, 2, 3}


def test_local_maxima_come_first_and_neighbouring_bins_are_suppressed():
    heat = np.full((4, 8, 8), -9.0, np.float32)
    heat[1, 1, 0], heat[1, 2, 0], heat[0, 1, 7], heat[1, 1, 4] = 4.0, 3.0, 2.0, 1.0
    cell, heading, score = best_cells(jnp.asarray(heat), 3)
    assert (int(cell[0]), int(heading[0]), float(score[0])) == (9, 0, 4.0)
    # The cell beside and the bin next to it belong to the same lane, the opposite bin to another.
    assert (int(cell[1]), int(heading[1]), float(score[1])) == (9, 4, 1.0)
    assert float(score[2]) == -9.0


@pytest.mark.parametrize("headings", [1, 2])
def test_few_bins_have_no_neighbours_to_wrap_to(headings):
    heat = jax.random.normal(jax.random.key(1), (4, 8, headings))
    cell, heading, score = best_cells(heat, 4)
    np.testing.assert_array_equal(score, np.asarray(heat).reshape(32, headings)[cell, heading])


def proposals(bev, lanes=None, mutable=(), config=DECODER):
    module = LaneProposals(config, RANGE)
    params = random_params(module.init, bev, None)
    return module.apply(params, bev, lanes, mutable=list(mutable), rngs={"dropout": jax.random.key(2)})


def test_points_are_turned_by_the_bin_and_moved_to_the_cell():
    points = jnp.array([[[3.0, 1.0, 0.5]]] * 4)
    center = jnp.array([[10.0, -2.0], [0.0, 0.0], [0.0, 0.0], [5.0, 7.0]])
    placed = _placed(points, center, jnp.array([0, 2, 1, 6]), 8)
    half = np.sqrt(0.5)
    expected = [(13.0, -1.0, 0.5), (-1.0, 3.0, 0.5), (2 * half, 4 * half, 0.5), (6.0, 4.0, 0.5)]
    np.testing.assert_allclose(placed[:, 0], expected, atol=1e-5)


@pytest.mark.slow
def test_queries_lie_on_the_lanes_of_their_cells_and_the_shape_head_sees_the_truth_only_in_training():
    bev = jax.random.normal(jax.random.key(0), (*SHAPE, 6))
    ((content, position, reference), state) = proposals(bev)
    assert content.shape == position.shape == (3, 8)
    assert reference.shape == (3, 5, 3)
    assert np.asarray((reference >= 0.01) & (reference <= 0.99)).all()  # where a sigmoid has a slope
    assert not state
    clean, dirty = (proposals(bev, graph(((1, 3), (9, 3)), garbage=g), ["auxiliary"])[1] for g in (0.0, np.nan))
    for one, other in zip(jax.tree.leaves(clean), jax.tree.leaves(dirty), strict=True):
        np.testing.assert_array_equal(one, other)
    assert clean["auxiliary"]["lane_proposals"][0].lanes.shape == (4, 5, 3)


def test_where_layers_look_at_one_point_it_is_the_middle_of_the_proposed_lane():
    bev = jax.random.normal(jax.random.key(0), (*SHAPE, 6))
    (lanes, points) = (proposals(bev, config=replace(DECODER, refine=refine))[0] for refine in ("iterative", "fixed"))
    np.testing.assert_array_equal(points[2], np.repeat(lanes[2][:, 2:3], 5, axis=1))
    np.testing.assert_array_equal(points[1], lanes[1])  # the position is of the whole lane


def test_more_proposals_than_cells_and_bins_are_refused():
    config = LaneDecoderConfig(queries=99, proposals=LaneProposalConfig(count=13, headings=2))
    with pytest.raises(SettingError, match=r"proposals\.count is 13: .* at most 12: .* 2 x 3 cells, 2 headings"):
        jax.eval_shape(LaneProposals(config, PerceptionRange()).init, jax.random.key(0), jnp.zeros((2, 3, 8)), None)


def test_an_untrained_shape_head_proposes_straight_lanes_along_the_bin():
    bev = jnp.zeros((*SHAPE, 6))
    module = LaneProposals(
        replace(DECODER, output="metric"), PerceptionRange((-100.0, 100.0), (-100.0, 100.0), (-1.0, 1.0))
    )
    params = zero_params(lambda key: module.init(key, bev, None))
    _, _, reference = jax.jit(lambda p: module.apply(p, bev, None))(params)
    length = np.linalg.norm(np.asarray(200.0 * (reference[:, -1, :2] - reference[:, 0, :2])), axis=-1)
    np.testing.assert_allclose(length, 24.0, rtol=1e-5)


@pytest.mark.slow  # tests/models/test_lanesegnet.py trains LaneSegNet with proposals
@pytest.mark.parametrize("host", ["toponet", "bevformer_detr"])
def test_hosts_train_with_proposals_and_all_their_parameters_learn(host):
    example = make_example()
    points = example.lanes.points.shape[1]
    decoder = replace(BASELINE.decoder, proposals=LaneProposalConfig(count=4, hidden=8), points=points)
    model = replace(BASELINE, decoder=decoder)
    if host == "bevformer_detr":
        fixed = replace(decoder, refine="fixed")
        model = BevFormerDetrConfig(encoder=model.encoder, decoder=fixed, elements=None, control_points=None)
    task = LaneGraphTask(model)
    params = jax.jit(task.init)(jax.random.key(0), example)
    batch = stack_examples([example, example])

    def loss(params):
        return task.loss(params, batch, jax.random.key(1))

    (_, report), grads = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    assert {"proposal_heat", "proposal_points"} <= set(report)
    silent = [name for name, leaf in grads["proposals"].items() for x in jax.tree.leaves(leaf) if not np.any(x)]
    assert not silent
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(grads))
