"""LaneSegNet's costs and losses against the reference's numbers, plain loops, and at their edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case, numbered
from tests.golden_compare import compare
from tflane_jax.convert.toponet import relationship_params
from tflane_jax.datasets.segment_targets import SegmentTargets
from tflane_jax.layers.graph import RelationshipHead
from tflane_jax.losses.costs import dice_cost, focal_cost, mask_cost
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig, matching_cost, successor_loss
from tflane_jax.matching import Assignment, match
from tflane_jax.models.segment_truth import CROSSING, LANE
from tflane_jax.scene import SegmentPrediction, stack_examples


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("laneseg_assigner*"), ids=case_id)
def test_assignment_matches_the_reference(path):
    case = load_module_case(path)
    queries, masks = len(case.inputs["cls_pred"]), case.inputs["gt_mask"]
    count = len(case.inputs["gt_lanes"])
    lines = case.inputs["lanes_pred"].reshape(queries, 3, -1, 3).swapaxes(0, 1)
    truth = case.inputs["gt_lanes"].reshape(count, 3, -1, 3).swapaxes(0, 1)
    prediction = SegmentPrediction(*lines, case.inputs["cls_pred"], mask_logits=case.inputs["mask_pred"])
    labels, config = case.inputs["gt_labels"], LaneSegNetLossConfig()
    targets = SegmentTargets(*truth, labels, labels, labels, np.zeros((count, count), bool), np.ones(count, bool))
    cost = jax.jit(lambda p, t: matching_cost(p, t, masks, config))(prediction, targets)
    np.testing.assert_allclose(cost, case.outputs["cost"], rtol=1e-4, atol=1e-4)
    logits, cells = (jnp.asarray(x.reshape(len(x), -1)) for x in (case.inputs["mask_pred"], masks))
    terms = {
        "cls_cost": config.class_weight * focal_cost(jnp.asarray(case.inputs["cls_pred"]))[:, labels],
        "mask_cost": config.mask_weight * mask_cost(logits, cells),
        "dice_cost": config.dice_weight * dice_cost(logits, cells),
    }
    for name, value in terms.items():
        np.testing.assert_allclose(value, case.outputs[name], rtol=1e-4, atol=1e-4, err_msg=name)
    assigned, own = np.zeros(queries, int), np.full(queries, -1)
    query = np.asarray(match(cost, targets.valid).query)
    assigned[query], own[query] = np.arange(count) + 1, labels
    np.testing.assert_array_equal(assigned, case.outputs["gt_inds"])
    np.testing.assert_array_equal(own, case.outputs["labels"])


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("laneseg_relationship_head*"), ids=case_id)
def test_topology_loss_matches_the_reference(path):
    case = load_module_case(path)
    images = range(len(numbered(case.inputs, r"gt_adj\.(\d+)")))
    every = [[case.inputs[f"{name}.{i}"] for name in ("gt_adj", "pos_inds", "pos_assigned_gt_inds")] for i in images]
    capacity = 1 + max(max(len(adjacency), *(targets + 1)) for adjacency, _, targets in every)
    truth, found = [], []
    for adjacency, queries, rows in every:
        count, line, label = len(adjacency), np.zeros((capacity, 2, 3)), np.zeros(capacity, np.int32)
        category = np.where(np.arange(capacity) < count, LANE, CROSSING)  # rows after the lanes
        successor, valid = np.zeros((capacity, capacity), bool), np.arange(capacity) < max(count, *(rows + 1))
        successor[:count, :count] = adjacency
        truth.append(SegmentTargets(line, line, line, category, label, label, successor, valid))
        assignment = Assignment(np.zeros(capacity, np.int32), np.zeros(capacity, bool))
        assignment.query[rows], assignment.matched[rows] = queries, True
        found.append(assignment)
    truth, found = stack_examples(truth), stack_examples(found)
    hidden = numbered(case.params, r"MLP_o1\.layers\.(\d+)\.bias")
    head = RelationshipHead(len(case.params[hidden[-1]]))

    def outputs(torch_params, inputs):
        params = {"params": relationship_params(torch_params)}
        logits = jax.vmap(lambda a, b: head.apply(params, a, b))(inputs["o1_feats"][-1], inputs["o2_feats"][-1])
        loss = successor_loss(logits, found, truth, LaneSegNetLossConfig())
        return {"rel_pred": logits[..., None], "loss_rel": loss}

    compare(case, outputs)
