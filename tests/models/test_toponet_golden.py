"""TopoNet's lane head (decoder, scene graph, heads, matching, losses) against the reference's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, load_module_case, options
from tests.golden_compare import assert_outputs_close
from tests.models.golden_lanes import (
    bev_maps,
    by_layer,
    check,
    check_matching,
    decoder_config,
    encoder_config,
    layers_first,
    queries_of,
    truth,
)
from tflane_jax.convert.toponet import TOPONET_LANES
from tflane_jax.losses.toponet import TopoNetLossConfig, element_lane_loss, lane_losses, matching_cost
from tflane_jax.matching import Assignment, match
from tflane_jax.models.element_decoder import ElementOutput
from tflane_jax.models.toponet import TopoNet, TopoNetConfig
from tflane_jax.scene import TrafficElements, stack_examples


def element_truth(case, lanes):
    """Return the fixture's lane-element relations, and the assignment of elements that it was made with."""
    layers, images = case.inputs["te_feats"].shape[:2]
    capacity = 1 + max(case.inputs[f"gt_lcte.{image}"].shape[1] for image in range(images))
    elements, query = [], np.zeros((images, layers, capacity), np.int32)
    for image in range(images):
        relation, one = case.inputs[f"gt_lcte.{image}"], TrafficElements.empty(capacity, lanes)
        one.lane[: len(relation), : relation.shape[1]], one.valid[: relation.shape[1]] = relation, True
        elements.append(one)
        for layer in range(layers):
            gts = case.inputs[f"te_pos_assigned_gt_inds.{layer}.{image}"]
            query[image, layer, gts] = case.inputs[f"te_pos_inds.{layer}.{image}"]
    elements = stack_examples(elements)
    return elements, Assignment(query, np.broadcast_to(elements.valid[:, None], query.shape))


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("toponet_head*"), ids=case_id)
def test_lane_head_matches_the_reference(path):
    check_head(load_module_case(path))


def check_head(case):
    decoder, weights = decoder_config(case), TopoNetLossConfig()
    edge_weight = options(case, edge_weight=0.6).edge_weight
    module = TopoNet(TopoNetConfig(encoder=encoder_config(case), decoder=decoder, edge_weight=edge_weight))
    lanes = truth(case)
    elements, found = element_truth(case, lanes.valid.shape[1])

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, TOPONET_LANES)

        def one(bev, queries, logits):
            # Boxes play no part here.
            seen = ElementOutput(queries, jnp.zeros((*queries.shape[:2], 2, 2)), logits)
            prediction, state = module.apply(
                {"params": params}, bev, seen, method=TopoNet.decode, mutable=["intermediates"]
            )
            return prediction, queries_of(state)

        logits = case.inputs["te_cls_scores"]
        prediction, queries = jax.vmap(one, in_axes=(0, 1, 1))(
            bev_maps(case, inputs["bev_feats"]), inputs["te_feats"], logits
        )
        cost = jax.vmap(lambda p, g: matching_cost(p, g, weights))(prediction.centerlines, lanes)
        assignment = match(cost, lanes.valid[:, None])
        terms = lane_losses(prediction.centerlines, assignment, lanes, weights)
        terms["lcte"] = element_lane_loss(prediction.elements, assignment, found, lanes, elements, weights)
        out = layers_first(
            {
                "all_cls_scores": prediction.centerlines.logits,
                "all_lanes_preds": prediction.centerlines.points,
                "all_lclc_preds": prediction.centerlines.successor_logits[..., None],
                "all_lcte_preds": prediction.elements.lane_logits[..., None],
                "history_states": queries,
            }
        )
        names = {"lane_cls": "class", "lane_reg": "points", "lclc_rel": "successor", "lcte_rel": "lcte"}
        for name, term in names.items():
            out |= by_layer(f"loss_{name}", terms[term])
        return out, (cost, assignment, prediction)

    cost, assignment, prediction = check(case, outputs)
    check_matching(case, cost, assignment)
    for image in range(len(lanes.valid)):
        answer = jax.tree.map(lambda leaf, i=image: leaf[i, -1], prediction)
        decoded = {
            "lanes": answer.centerlines.points.reshape(decoder.queries, -1),
            "scores": answer.centerlines.scores,
            "lclc": jax.nn.sigmoid(answer.centerlines.successor_logits),
            "lcte": jax.nn.sigmoid(answer.elements.lane_logits),
        }
        expected = {name: case.outputs[f"decoded.{image}.{name}"] for name in decoded}
        assert_outputs_close(decoded, expected, tolerance=5e-5)
