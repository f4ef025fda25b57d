"""The parts of the lane decoder that have a geometry of their own."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import qmc

from tests.models.cases import BASELINE
from tests.parameters import random_params, zero_params
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.models.lane_decoder import (
    LaneHeads,
    PointwiseRefinement,
    clip_with_return,
    directions,
    next_reference,
    smooth_basis,
    spread_points,
)
from tflane_jax.models.lane_queries import spread_lanes

RANGE = BevGrid().range


@pytest.mark.parametrize("points", [2, 3, 11, 20])
def test_basis_reaches_every_polyline(points):
    basis = smooth_basis(points)
    anything = np.random.default_rng(0).normal(size=(points, 3))
    np.testing.assert_allclose(basis @ np.linalg.solve(basis, anything), anything, atol=1e-3)


def test_initial_anchors_lie_as_in_scipys_halton_sequence():
    config = BASELINE.decoder
    sample = qmc.Halton(3, scramble=False).random(config.queries + 1)[1:]
    middle = spread_lanes(config.queries, config.points, RANGE, length=0.0)[:, 0, :2]
    np.testing.assert_allclose(middle, np.clip(sample[:, :2], 0.02, 0.98), atol=1e-6)


def test_heads_look_along_the_whole_lane_and_a_single_one_at_its_middle():
    assert [spread_points(11, heads).tolist() for heads in (1, 2, 3)] == [[5], [0, 10], [0, 5, 10]]


def test_basis_bends_rather_than_zigzags():
    basis = smooth_basis(11)
    np.testing.assert_array_equal(basis[:, 0], 1.0)
    bend = np.abs(np.diff(basis, 2, axis=0)).max(0)
    assert (bend[2:] < 0.45).all()  # the alternating column alone, unscaled, would bend by 4


@settings(max_examples=30)
@given(st.integers(0, 1000), st.floats(-3, 3), st.floats(-50, 50))
def test_directions_turn_with_the_line(seed, angle, shift):
    line = np.cumsum(np.random.default_rng(seed).uniform(0.2, 1.0, (7, 2)), 0).astype(np.float32)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], np.float32)
    moved, before = (jax.jit(directions)(x) for x in (line @ turn.T + np.float32(shift), line))
    np.testing.assert_allclose(moved, np.asarray(before) @ turn.T, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=-1), 1.0, atol=1e-3)


def test_direction_of_a_point_is_zero_with_a_finite_gradient():
    still = jnp.zeros((3, 2))
    np.testing.assert_array_equal(directions(still), 0.0)
    assert np.isfinite(jax.grad(lambda line: directions(line).sum())(still)).all()


def test_pointwise_refinement_starts_at_zero_and_looks_only_where_the_point_is():
    config = BASELINE.decoder
    rng = np.random.default_rng(0)
    queries = jnp.asarray(rng.normal(size=(config.queries, config.dim)), jnp.float32)
    reference = jnp.asarray(spread_lanes(config.queries, config.points, RANGE))
    bev = jnp.asarray(rng.normal(size=(6, 10, 5)), jnp.float32)
    module = PointwiseRefinement(config, RANGE)
    params = jax.jit(module.init)(jax.random.key(0), queries, reference, bev)
    apply = jax.jit(module.apply)
    np.testing.assert_array_equal(apply(params, queries, reference, bev), 0.0)

    params["params"]["change"]["kernel"] += 1.0
    # Cells far from every point of the first lane may hold anything.
    column, row = np.meshgrid((np.arange(10) + 0.5) / 10, (np.arange(6) + 0.5) / 6)
    away = np.abs(np.stack([column, row], -1)[:, :, None] - np.asarray(reference)[0, :, :2]) > [0.11, 0.17]
    other = jnp.where(away.any(-1).all(-1)[..., None], 7.0, bev)
    before, after = (np.asarray(apply(params, queries, reference, b)) for b in (bev, other))
    np.testing.assert_array_equal(before[0], after[0])
    assert not np.allclose(before, after)


@pytest.mark.slow
def test_pointwise_refinement_sees_headings_in_metres():
    """Beside equal features, a lane moves alike in boxes of any shape."""
    config = BASELINE.decoder
    rng = np.random.default_rng(1)
    lane = np.stack([np.linspace(-8, 8, config.points), np.linspace(-2, 6, config.points), np.zeros(config.points)], -1)
    queries, bev = jnp.asarray(rng.normal(size=(1, config.dim)), jnp.float32), jnp.ones((4, 8, 5))
    found = []
    for box in (RANGE, PerceptionRange((-20.0, 20.0), (-40.0, 40.0), (-2.3, 1.7))):
        module, reference = PointwiseRefinement(config, box), jnp.asarray(box.normalise(lane[None]), jnp.float32)
        found.append(module.apply(random_params(module.init, queries, reference, bev), queries, reference, bev))
    np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-5)
    assert np.abs(found[0]).max() > 0.01


@pytest.mark.parametrize("refine", ["fixed", "iterative"])
def test_the_next_layer_begins_at_the_refined_lane_and_teaches_this_one_nothing(refine):
    config = dataclasses.replace(BASELINE.decoder, refine=refine)
    before, after = jnp.full((2, config.points, 3), 0.2), jnp.full((2, config.points, 3), 0.7)
    np.testing.assert_array_equal(next_reference(before, after, config), before if refine == "fixed" else after)
    assert not jax.grad(lambda unit: next_reference(before, unit, config).sum())(after).any()


def metric_heads(reference, unit_change, limits=None):
    """The output of heads whose every point changes by `unit_change` units."""
    config = dataclasses.replace(BASELINE.decoder, output="metric", points=reference.shape[1], relation=4)
    queries, bev = jnp.zeros((len(reference), config.dim)), jnp.zeros((4, 8, 5))
    heads = LaneHeads(config, RANGE, relations=False, limits=limits)
    params = zero_params(heads.init, queries, reference, bev)
    # Column 0 of the basis moves all points alike.
    params["params"]["points"]["linear_2"]["bias"] = jnp.zeros((config.points, 3)).at[0].set(unit_change).reshape(-1)
    return jax.jit(lambda p: heads.apply(p, queries, reference, bev))(params), params, heads, (queries, reference, bev)


def test_one_unit_of_the_metric_output_is_one_distance_everywhere():
    reference = jnp.asarray([[[0.5, 0.5, 0.5]] * 5, [[0.9, 0.1, 0.2]] * 5])
    output, *_ = metric_heads(reference, jnp.array([0.4, -0.2, 1.0]))
    moved = np.asarray(output.points) - np.asarray(RANGE.denormalise(reference))
    np.testing.assert_allclose(moved, np.broadcast_to([2.0, -1.0, 0.3], moved.shape), atol=1e-4)


def test_lanes_end_at_the_limits_and_can_come_back_but_not_drift_away():
    limits = PerceptionRange((-50.0, 50.0), (-25.0, 25.0), (-2.3, 1.7))
    reference = jnp.full((1, 5, 3), 0.5).at[..., 0].set(0.95)  # 5 m before the border
    output, params, heads, given = metric_heads(reference, jnp.array([9.0, 0.0, 0.0]), limits)
    np.testing.assert_allclose(output.points[..., 0], 50.0, rtol=1e-6)

    def slope(sign):
        grads = jax.jit(jax.grad(lambda p: sign * heads.apply(p, *given).points[..., 0].sum()))(params)
        return grads["params"]["points"]["linear_2"]["bias"].reshape(5, 3)[0, 0]

    np.testing.assert_allclose(slope(1.0), 25.0, rtol=1e-4)  # five points, 5 m each
    assert slope(-1.0) == 0.0


def test_the_clip_keeps_the_gradient_inside():
    x, low, high = jnp.array([-0.2, 0.5, 1.4]), jnp.zeros(3), jnp.ones(3)
    np.testing.assert_array_equal(clip_with_return(x, low, high), [0.0, 0.5, 1.0])
    for weights, expected in (([1.0, 1.0, 1.0], [0.0, 1.0, 1.0]), ([-1.0, -1.0, -1.0], [-1.0, -1.0, 0.0])):
        slope = jax.vjp(clip_with_return, x, low, high)[1](jnp.array(weights))[0]
        np.testing.assert_array_equal(slope, expected)
