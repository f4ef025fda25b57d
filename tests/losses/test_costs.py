"""Matching costs and the focal loss against the reference's numbers."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.golden import case_id, golden_modules, load_module_case, options
from tests.golden_compare import assert_gradients_close
from tflane_jax.layers.positions import inverse_sigmoid
from tflane_jax.losses.common import quality_focal
from tflane_jax.losses.costs import focal_cost, generalised_iou, pairwise_l1
from tflane_jax.losses.toponet import TopoNetLossConfig, matching_cost
from tflane_jax.losses.traffic_elements import ElementLossConfig, element_cost
from tflane_jax.matching import match
from tflane_jax.scene import CenterlinePrediction, ElementPrediction, LaneGraph, TrafficElements


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("mmdet_match_costs*"), ids=case_id)
def test_focal_cost_and_inverse_sigmoid(path):
    case = load_module_case(path)
    cost = focal_cost(jnp.asarray(case.inputs["cls_pred"]))[:, case.inputs["gt_labels"]]
    # The reference object carries mmdet's weight 2.
    np.testing.assert_allclose(2.0 * cost, case.outputs["focal"], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        inverse_sigmoid(jnp.asarray(case.inputs["inv_sigmoid_x"])), case.outputs["inv_sigmoid"], rtol=2e-5, atol=2e-5
    )


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("mmdet_match_costs*"), ids=case_id)
def test_box_costs(path):
    case = load_module_case(path)
    boxes, truth = case.inputs["box_pred_cxcywh"], case.inputs["gt_boxes_xyxy"].reshape(-1, 2, 2)
    corners = np.stack([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], 1)
    iou = jax.jit(lambda a, b: generalised_iou(a[:, None], b[None]))(corners, truth)
    np.testing.assert_allclose(-iou, case.outputs["giou"], rtol=2e-5, atol=2e-5)
    # Elements on an image of one pixel: boxes are fractions of it, and the two other terms are switched off.
    count = len(truth)
    logits = np.zeros((1, *case.inputs["cls_pred"].shape), np.float32)
    prediction = ElementPrediction(corners[None], logits, np.zeros((1, 1, 1)))
    elements = TrafficElements.empty(count, 1).replace(box=truth, valid=np.ones(count, bool))
    config = ElementLossConfig(class_weight=0.0, iou_weight=0.0)
    cost = jax.jit(element_cost, static_argnums=3)(prediction, elements, np.ones(2, np.int32), config)
    np.testing.assert_allclose(cost[0], case.outputs["bbox_l1_xywh"], rtol=2e-5, atol=2e-5)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("mmdet_losses*"), ids=case_id)
def test_overlap_and_its_gradient(path):
    case = load_module_case(path)
    boxes, truth = (case.inputs[name].reshape(-1, 2, 2) for name in ("box_pred", "box_target"))
    np.testing.assert_allclose(1.0 - generalised_iou(boxes, truth), case.outputs["giou_none"], rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose((1.0 - generalised_iou(boxes, truth)).mean(), case.outputs["giou_mean"], rtol=2e-5)

    # The number of positives that weighted losses are divided by is not in the file, but follows from one of them.
    positives = (case.inputs["weight"] * case.outputs["giou_none"]).sum() / case.outputs["giou_weighted_avg"]
    assert positives == pytest.approx(round(float(positives)), rel=1e-4)

    def scalar(boxes):
        """Sum what the fixture sums of the boxes: L1 of weight 2.5 and overlap, plain and weighted."""
        apart, error = 1.0 - generalised_iou(boxes, truth), 2.5 * jnp.abs(boxes - truth).sum((1, 2))
        terms = {
            "giou_none": apart,
            "giou_mean": apart.mean(),
            "l1_mean": error.mean() / 4,
            "giou_weighted_avg": (case.inputs["weight"] * apart).sum() / positives,
            "l1_weighted_avg": (case.inputs["weight"] * error).sum() / positives,
        }
        return sum((case.weights[name] * term).sum() for name, term in terms.items() if name in case.weights)

    if "in/box_pred" in case.gradients:
        gradient = jax.jit(jax.grad(scalar))(boxes).reshape(-1, 4)
        assert_gradients_close({"in/box_pred": gradient}, {"in/box_pred": case.gradients["in/box_pred"]})


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("mmdet_losses*"), ids=case_id)
def test_focal_loss(path):
    case = load_module_case(path)
    logits, labels = case.inputs["cls_pred"], case.inputs["labels"]
    one_hot = np.eye(logits.shape[1] + 1, dtype=np.float32)[labels][:, :-1]
    # Weight 1.5 is the fixture's (its note says so).
    loss = 1.5 * optax.losses.sigmoid_focal_loss(jnp.asarray(logits), one_hot, alpha=0.25, gamma=2.0)
    np.testing.assert_allclose(loss, case.outputs["focal_none"], rtol=2e-5, atol=2e-6)
    assert float(loss.mean()) == pytest.approx(float(case.outputs["focal_mean"]), rel=2e-5)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("toponet_lane_assigner*"), ids=case_id)
def test_lane_assignment(path):
    check_assignment(load_module_case(path))


def check_assignment(case):
    found = options(case, normalize_gt=False, pc_range=None, cls_cost=None, reg_cost=None)
    logits, labels = jnp.asarray(case.inputs["cls_pred"]), case.inputs["gt_labels"]
    queries, lanes = len(logits), len(labels)
    points = case.inputs["gt_lanes"].reshape(lanes, case.inputs["lane_pred"].shape[1] // 3, 3)
    if found.normalize_gt:
        low, high = np.array(found.pc_range, np.float32).reshape(2, 3)
        points = (points - low) / (high - low)
    config = TopoNetLossConfig()
    weights = {"class_weight": found.cls_cost, "points_weight": found.reg_cost}
    config = replace(config, **{name: cost["weight"] for name, cost in weights.items() if cost})
    # Our lanes have one class. A case of several is the sum of the cost of points and that of its own classes.
    prediction = CenterlinePrediction(
        points=jnp.asarray(case.inputs["lane_pred"]).reshape(1, queries, -1, 3),
        logits=logits[None, :, :1],
        successor_logits=jnp.zeros((1, queries, queries)),
    )
    truth = LaneGraph.empty(lanes, points.shape[1]).replace(points=points, valid=np.ones(lanes, bool))
    cost = matching_cost(prediction, truth, config)[0]
    by_class = config.class_weight * focal_cost(logits)
    cost = cost + (by_class[:, labels] - by_class[:, :1])
    np.testing.assert_allclose(cost, case.outputs["cost"], rtol=1e-4, atol=1e-4)
    assigned = np.zeros(queries, int)
    assigned[np.asarray(match(cost, truth.valid).query)] = np.arange(lanes) + 1
    np.testing.assert_array_equal(assigned, case.outputs["gt_inds"])


@pytest.mark.parametrize(("queries", "targets"), [(0, 3), (3, 0), (1, 1), (4, 2)])
def test_pairwise_l1(queries, targets):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(queries, 5)), rng.normal(size=(targets, 5))
    got = np.asarray(pairwise_l1(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)))
    assert got.shape == (queries, targets)
    for q in range(queries):
        for n in range(targets):
            assert got[q, n] == pytest.approx(np.abs(a[q] - b[n]).sum(), rel=1e-5)


@pytest.mark.parametrize("gamma", [0.0, 0.5, 1.0, 2.0])
def test_quality_focal_loss_has_a_finite_gradient_at_saturated_logits_and_at_its_target(gamma):
    logits, target = jnp.array([0.0, 20.0, 200.0, -200.0, 1.0]), jnp.array([0.5, 1.0, 1.0, 0.0, 0.3])
    p = 1.0 / (1.0 + np.exp(-np.asarray(logits, np.float64)))
    entropy = np.logaddexp(0.0, np.asarray(logits, np.float64)) - np.asarray(logits * target, np.float64)
    loss, gradient = quality_focal(logits, target, gamma), jax.grad(lambda x: quality_focal(x, target, gamma).sum())
    # At p = target, the loss of an exponent below 1 is that of a distance of 1e-6.
    np.testing.assert_allclose(loss, np.abs(target - p) ** gamma * entropy, rtol=1e-5, atol=1e-3)
    found = gradient(logits)
    assert np.isfinite(found).all()
    if gamma == 0.0:  # plain cross-entropy
        np.testing.assert_allclose(found, p - np.asarray(target), atol=1e-6)


@pytest.mark.parametrize(("other", "expected"), [((0.0, 0.0), 0.0), ((2.0, 1.0), -1.0)])
def test_boxes_without_area_do_not_overlap(other, expected):
    here, there = jnp.zeros((2, 2)), jnp.broadcast_to(jnp.array(other), (2, 2))
    np.testing.assert_allclose(generalised_iou(here, there), expected, atol=1e-5)
