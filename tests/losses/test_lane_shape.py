"""The fitting loss: padding, permutations, gradients, and matching costs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tflane_jax.losses.lane_shape import LaneShapeLossConfig, cell_loss, lane_shape_loss, lane_shape_targets
from tflane_jax.scene import CurvePrediction, LaneLines

LINES, POINTS, QUERIES, LAYERS = 4, 9, 7, 2


def lines(seed=0, batch=2, count=3):
    """Return straight lines with gaps at their upper ends."""
    rng = np.random.default_rng(seed)
    rows = np.broadcast_to(np.linspace(0.4, 0.95, POINTS, dtype=np.float32), (batch, LINES, POINTS))
    columns = 0.5 + rng.normal(0, 0.3, (batch, LINES, 1)) * (rows - 0.3)
    first = rng.integers(0, 4, (batch, LINES, 1))
    valid = np.broadcast_to(np.arange(LINES) < count, (batch, LINES))
    points = np.stack([columns, rows], -1).astype(np.float32)
    return LaneLines(*map(jnp.asarray, (points, np.arange(POINTS) >= first, valid)))


def predictions(seed=1, batch=2):
    rng = np.random.default_rng(seed)
    logits = rng.normal(size=(batch, LAYERS, QUERIES, 2))
    curves = rng.normal([0.4, 0.9, 0.0, 0.2, 0.0, 0.5, 0.0, 0.0], 0.1, (batch, LAYERS, QUERIES, 8))
    return CurvePrediction(jnp.asarray(logits, jnp.float32), jnp.asarray(curves, jnp.float32))


@jax.jit
def value_and_gradient(prediction, truth):
    config = LaneShapeLossConfig()

    def loss(prediction):
        return lane_shape_loss(prediction, lane_shape_targets(truth, shared_horizon=config.shared_horizon), config)

    (value, terms), gradient = jax.value_and_grad(loss, has_aux=True)(prediction)
    return value, terms, gradient


def dirty(truth):
    """Fill everything that is not valid with NaN."""
    there = truth.point_valid & truth.valid[..., None]
    return truth.replace(points=jnp.where(there[..., None], truth.points, jnp.nan))


def test_padding_changes_nothing():
    clean, soiled = (value_and_gradient(predictions(), t) for t in (lines(), dirty(lines())))
    assert np.isfinite(clean[0])
    jax.tree.map(np.testing.assert_array_equal, clean, soiled)


def test_a_line_without_points_is_no_target():
    truth = lines(count=3)
    without = truth.replace(valid=truth.valid.at[:, 2].set(False))
    pointless = truth.replace(point_valid=truth.point_valid.at[:, 2].set(False))
    expected, got = value_and_gradient(predictions(), without), value_and_gradient(predictions(), pointless)
    jax.tree.map(np.testing.assert_array_equal, expected, got)


@pytest.mark.parametrize("count", [0, 1])
def test_few_lines(count):
    value, terms, gradient = value_and_gradient(predictions(), lines(count=count))
    assert np.isfinite(value)
    assert float(terms["matching/lanes"]) == count
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    if count == 0:
        assert float(terms["curve"]) == float(terms["extent"]) == 0.0
        np.testing.assert_array_equal(gradient.curves, np.zeros_like(gradient.curves))


def test_a_line_without_a_query_does_not_weigh_on_the_others():
    """One query and two lines: the short one, far away, is not matched, so that the other one weighs 1."""
    truth = lines(batch=1, count=2)
    truth = truth.replace(
        points=truth.points.at[:, 1, :, 0].add(9.0),
        point_valid=truth.point_valid.at[:, 0].set(True).at[:, 1].set(jnp.arange(POINTS) >= POINTS - 2),
    )
    one = jax.tree.map(lambda leaf: leaf[:, :, :1], predictions(batch=1))
    both, alone = (value_and_gradient(one, truth.replace(valid=jnp.arange(LINES)[None] < count)) for count in (2, 1))
    assert both[1]["matching/lanes"] == 1.0
    np.testing.assert_allclose(2.0 * both[1]["curve"], alone[1]["curve"], rtol=1e-5)  # sums are divided by all lines
    assert alone[1]["curve"] > 0.01


def test_the_order_of_lines_and_queries_does_not_matter():
    truth, prediction = lines(), predictions()
    turn = lambda tree, order, axis: jax.tree.map(lambda leaf: jnp.take(leaf, order, axis), tree)  # noqa: E731
    mixed = value_and_gradient(
        turn(prediction, jnp.array([3, 1, 6, 0, 2, 5, 4]), 2), turn(truth, jnp.array([2, 3, 0, 1]), 1)
    )
    for ours, expected in zip(mixed[:2], value_and_gradient(prediction, truth)[:2], strict=True):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), ours, expected)


def test_gradient_is_that_of_finite_differences():
    targets = lane_shape_targets(lines())
    config = LaneShapeLossConfig(least_depth=1e-2)
    check_grads(
        jax.jit(lambda p: lane_shape_loss(p, targets, config)[0]),
        (predictions(),),
        1,
        ["rev"],
        eps=1e-3,
        atol=2e-2,
        rtol=2e-2,
    )


def test_a_perfect_prediction_costs_only_its_class_loss():
    truth = lines(batch=1, count=2)
    slopes = [(truth.points[0, i, -1] - truth.points[0, i, 0])[0] / 0.55 for i in range(2)]
    curves = np.zeros((1, 1, QUERIES, 8), np.float32)
    targets = lane_shape_targets(truth)
    for i in range(2):
        u, v = truth.points[0, i, 0]
        # u + slope (V - v) = slope V - (slope v - u)
        curves[0, 0, i] = [*targets.extent[0, i], 0, -1, 0, 0, slopes[i], slopes[i] * v - u]
    logits = np.tile(np.array([9.0, -9.0], np.float32), (1, 1, QUERIES, 1))
    logits[0, 0, :2] *= -1
    value, terms, _ = value_and_gradient(CurvePrediction(jnp.asarray(logits), jnp.asarray(curves)), truth)
    assert float(value) < 1e-4
    assert float(terms["matching/lanes"]) == 2


def test_lines_share_the_highest_row_if_configured():
    truth = lines()
    shared, own = (lane_shape_targets(truth, shared_horizon=flag).extent for flag in (True, False))
    assert (np.ptp(shared[:, :3, 0], axis=1) == 0).all()
    np.testing.assert_array_equal(shared[:, :3, 0].min(1), own[:, :3, 0].min(1))
    assert not np.array_equal(shared, own)


def test_cells_are_those_with_a_point():
    points = np.zeros((1, 2, 5, 2), np.float32)
    # The third and the last two lie outside: to the right, above by less than a cell, and above by more than one.
    points[0, 0] = [[0.1, 0.1], [0.6, 0.3], [1.2, 0.6], [0.3, -0.2], [0.9, -0.6]]
    points[0, 1] = np.nan
    truth = LaneLines(points, np.ones((1, 2, 5), bool), np.array([[True, False]]))
    targets = jax.tree.map(lambda leaf: leaf[0], lane_shape_targets(truth))
    taken = np.zeros((2, 4))
    taken[0, 0] = taken[0, 2] = 1
    logits = np.random.default_rng(0).normal(size=(2, 4)).astype(np.float32)
    expected = np.log1p(np.exp(np.where(taken == 1, -logits, logits))).mean()
    np.testing.assert_allclose(cell_loss(jnp.asarray(logits), targets), expected, rtol=1e-6)
    nothing = jax.tree.map(jnp.zeros_like, targets)
    np.testing.assert_allclose(cell_loss(jnp.asarray(logits), nothing), np.log1p(np.exp(logits)).mean(), rtol=1e-6)


@pytest.mark.parametrize(("lines", "points"), [(0, POINTS), (LINES, 0), (0, 0)])
def test_no_room_for_lines_or_points_costs_what_no_lines_cost(lines, points):
    nothing = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None].repeat(2, 0), LaneLines.empty(lines, points))
    padded = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None].repeat(2, 0), LaneLines.empty(LINES, POINTS))
    got, expected = (value_and_gradient(predictions(), truth) for truth in (nothing, padded))
    jax.tree.map(np.testing.assert_array_equal, got, expected)
