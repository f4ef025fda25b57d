"""The lane-graph loss: against plain numpy loops, padding, empty scenes, gradients."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from tflane_jax.losses.costs import focal_cost
from tflane_jax.losses.toponet import TopoNetLossConfig, lane_graph_loss, lane_losses, lane_quality, matching_cost
from tflane_jax.matching import Assignment
from tflane_jax.scene import CenterlinePrediction, LaneGraph, Prediction, stack_examples

CONFIG = TopoNetLossConfig()


@partial(jax.jit, static_argnums=2)
def jitted_loss(lanes, truth, config):
    return lane_graph_loss(Prediction(lanes), truth, config)


BATCH, LAYERS, QUERIES, LANES, POINTS = 3, 2, 7, 5, 4


def make_case(seed=0, counts=(3, 5, 0)):
    rng = np.random.default_rng(seed)
    graphs = []
    for count in counts:
        graph = LaneGraph.empty(LANES, POINTS)
        valid = rng.permutation(np.arange(LANES) < count)
        points = rng.normal(size=(LANES, POINTS, 3)).astype(np.float32) * 10
        graphs.append(graph.replace(points=points, successor=rng.random((LANES, LANES)) < 0.3, valid=valid))
    prediction = CenterlinePrediction(
        points=jnp.asarray(rng.normal(size=(len(counts), LAYERS, QUERIES, POINTS, 3)).astype(np.float32) * 10),
        logits=jnp.asarray(rng.normal(size=(len(counts), LAYERS, QUERIES, 1)).astype(np.float32)),
        successor_logits=jnp.asarray(rng.normal(size=(len(counts), LAYERS, QUERIES, QUERIES)).astype(np.float32)),
    )
    return prediction, stack_examples(graphs)


def focal(logit, target):
    p = 1 / (1 + np.exp(-logit))
    if target:
        return -0.25 * (1 - p) ** 2 * np.log(p)
    return -0.75 * p**2 * np.log(1 - p)


def loop_loss(prediction, lanes):
    """TopoNet's loss as docs/reference/toponet.md states it, one number at a time."""
    points, logits, edges = (np.asarray(x, np.float64) for x in jax.tree.leaves(prediction))
    total = 0.0
    for layer in range(LAYERS):
        classes = l1 = topology = 0.0
        positives = 0
        for b in range(points.shape[0]):
            real = np.flatnonzero(lanes.valid[b])
            cost = np.zeros((QUERIES, len(real)))
            for q in range(QUERIES):
                p = 1 / (1 + np.exp(-logits[b, layer, q, 0]))
                cls = -np.log(p) * 0.25 * (1 - p) ** 2 + np.log(1 - p) * 0.75 * p**2
                for j, n in enumerate(real):
                    cost[q, j] = 1.5 * cls + 0.025 * np.abs(points[b, layer, q] - lanes.points[b, n]).sum()
            queries, columns = linear_sum_assignment(cost)
            owner = {q: real[c] for q, c in zip(queries, columns, strict=True)}
            positives += len(owner)
            for q in range(QUERIES):
                classes += focal(logits[b, layer, q, 0], q in owner)
                if q in owner:
                    l1 += np.abs(points[b, layer, q] - lanes.points[b, owner[q]]).sum()
                for r in range(QUERIES):
                    joined = q in owner and r in owner and lanes.successor[b, owner[q], owner[r]]
                    topology += focal(edges[b, layer, q, r], joined)
        total += 1.5 * classes / max(positives, 1) + 0.025 * l1 / max(positives, 1)
        total += 5.0 * topology / (points.shape[0] * QUERIES**2)
    return total


@pytest.mark.parametrize("counts", [(3, 5, 0), (1, 1, 1), (0, 0, 0)])
def test_matches_plain_loops(counts):
    prediction, lanes = make_case(1, counts)
    total, report = jitted_loss(prediction, lanes, CONFIG)
    assert float(total) == pytest.approx(loop_loss(prediction, lanes), rel=1e-5)
    assert float(report["matching/lanes"]) == pytest.approx(np.mean(counts))


def test_published_class_losses_are_divided_by_the_lanes_of_their_own_frame():
    """Devices with one frame each, averaged: only the class loss differs from that of one batch."""
    prediction, truth = make_case(counts=(3, 5, 0))
    config = dataclasses.replace(CONFIG, class_mean="frame")
    alone = [
        jitted_loss(*jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], (prediction, truth)), CONFIG)[1] for i in range(3)
    ]
    loss, report = jitted_loss(prediction, truth, config)
    whole, batch = jitted_loss(prediction, truth, CONFIG)
    np.testing.assert_allclose(report["class"], np.mean([terms["class"] for terms in alone]), rtol=1e-5)
    assert abs(float(report["class"] - batch["class"])) > 0.1 * float(batch["class"])
    assert float(loss) != pytest.approx(float(whole), rel=1e-3)
    for name in ("points", "successor"):
        np.testing.assert_array_equal(report[name], batch[name])


def test_padding_changes_nothing():
    prediction, lanes = make_case(2)
    hole = ~lanes.valid
    dirty = lanes.replace(
        points=np.where(hole[..., None, None], np.nan, lanes.points),
        successor=lanes.successor | hole[:, :, None] | hole[:, None, :],
    )
    grad = jax.jit(jax.value_and_grad(lambda p, g: jitted_loss(p, g, CONFIG)[0]))
    jax.tree.map(np.testing.assert_array_equal, grad(prediction, lanes), grad(prediction, dirty))


def test_gradient_against_finite_differences():
    prediction, lanes = make_case(3)

    @jax.jit
    def loss(p):
        return jitted_loss(p, lanes, CONFIG)[0]

    gradient = jax.grad(loss)(prediction)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape).astype(np.float32)), prediction)
    step = 1e-3
    ahead, behind = (jax.tree.map(lambda x, d, s=s: x + s * d, prediction, direction) for s in (step, -step))
    slope = (loss(ahead) - loss(behind)) / (2 * step)
    along = sum(jax.tree.leaves(jax.tree.map(lambda g, d: (g * d).sum(), gradient, direction)))
    assert float(slope) == pytest.approx(float(along), rel=2e-2)


def test_perfect_prediction_is_cheap():
    _, lanes = make_case(4, (3, 3, 3))
    order = np.argsort(~lanes.valid, axis=1, kind="stable")
    pick = lambda x: np.take_along_axis(x, order.reshape(*order.shape, *[1] * (x.ndim - 2)), 1)  # noqa: E731
    points = np.zeros((3, 1, QUERIES, POINTS, 3), np.float32)
    points[:, 0, :LANES] = pick(lanes.points)
    logits = np.full((3, 1, QUERIES, 1), -20.0, np.float32)
    logits[:, 0, :3] = 20.0
    edges = np.full((3, 1, QUERIES, QUERIES), -20.0, np.float32)
    for b in range(3):
        edges[b, 0, :3, :3] = np.where(lanes.successor[b][np.ix_(order[b, :3], order[b, :3])], 20.0, -20.0)
    total, _ = jitted_loss(CenterlinePrediction(*map(jnp.asarray, (points, logits, edges))), lanes, CONFIG)
    assert float(total) < 1e-4


def test_matcher_backends_agree():
    prediction, lanes = make_case(5)
    totals = [
        float(jitted_loss(prediction, lanes, dataclasses.replace(CONFIG, matcher=m))[0]) for m in ("scipy", "jax")
    ]
    assert totals[0] == pytest.approx(totals[1], rel=1e-6)


def test_cost_shape_and_value():
    prediction, lanes = make_case(6)
    one = jax.tree.map(lambda x: x[0], prediction)
    cost = matching_cost(one, jax.tree.map(lambda x: x[0], lanes), CONFIG)
    assert cost.shape == (LAYERS, QUERIES, LANES)
    expected = 1.5 * focal_cost(one.logits[1, 2, 0]) + 0.025 * np.abs(one.points[1, 2] - lanes.points[0, 4]).sum()
    assert float(cost[1, 2, 4]) == pytest.approx(float(expected), rel=1e-5)


def test_quality_falls_with_the_largest_distance_of_a_point():
    truth = jnp.zeros((3, 4, 3))
    points = truth.at[1, 2, 0].set(2.0).at[2, :, 1].set(6.0)
    np.testing.assert_allclose(lane_quality(points, truth), [1.0, 0.5, 0.1], rtol=1e-6)


def test_quality_targets_rank_lanes_by_their_precision():
    """With free logits, the least loss gives every matched query its quality, and others 0."""
    lanes = stack_examples([LaneGraph.empty(2, POINTS).replace(valid=np.ones(2, bool))])
    points = jnp.zeros((1, 1, 3, POINTS, 3)).at[0, 0, 1, :, 0].set(2.0).at[0, 0, 2].set(40.0)
    assignment = Assignment(jnp.array([[[0, 1]]]), jnp.ones((1, 1, 2), bool))

    def loss(logits):
        prediction = CenterlinePrediction(points, logits, jnp.zeros((1, 1, 3, 3)))
        return lane_losses(prediction, assignment, lanes, TopoNetLossConfig(class_target="quality"))["class"].sum()

    logits = jnp.zeros((1, 1, 3, 1))
    step = jax.jit(lambda x: x - 2.0 * jax.grad(loss)(x))
    for _ in range(400):
        logits = step(logits)
    np.testing.assert_allclose(jax.nn.sigmoid(logits[0, 0, :2, 0]), [1.0, 0.5], atol=0.1)
    assert float(jax.nn.sigmoid(logits[0, 0, 2, 0])) < 0.1


@pytest.mark.parametrize("backend", ["scipy", "jax"])
def test_no_capacity_is_no_target(backend):
    prediction, lanes = make_case(2, (0, 0, 0))
    points = lanes.points.shape[-2]
    config = TopoNetLossConfig(matcher=backend)
    full, none = (
        jitted_loss(prediction, truth, config) for truth in (lanes, stack_examples([LaneGraph.empty(0, points)] * 3))
    )
    np.testing.assert_allclose(none[0], full[0], rtol=1e-6)
    assert full[0] > 0.0


def test_a_loss_of_one_example_is_refused():
    lanes = CenterlinePrediction(np.zeros((1, 6, 11, 3)), np.zeros((1, 6, 1)))
    with pytest.raises(ValueError, match=r"expected a batch \(lanes\.valid of shape \(batch, n\)\)"):
        lane_graph_loss(Prediction(lanes), LaneGraph.empty(8, 11), CONFIG)
