"""BEVFormer-DETR's lane head against the reference's numbers, and Bezier lanes."""

from functools import partial

import jax
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case
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
from tests.parameters import random_params
from tflane_jax.convert.toponet import baseline_lane_params
from tflane_jax.losses.toponet import TopoNetLossConfig, lane_losses, matching_cost
from tflane_jax.matching import match
from tflane_jax.models.bevformer_detr import BevFormerDetr, BevFormerDetrConfig


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("olv2_lc_head*"), ids=case_id)
def test_lane_head_matches_the_reference(path):
    check_head(load_module_case(path))


def check_head(case):
    decoder, weights = decoder_config(case), TopoNetLossConfig(points_weight=0.0075)
    module = BevFormerDetr(BevFormerDetrConfig(encoder=encoder_config(case), decoder=decoder))
    lanes = truth(case)
    # The fixture has no relationship heads; ours get some, which nothing else depends on.
    bev = np.zeros(bev_maps(case, case.inputs["bev_feats"]).shape[1:], np.float32)
    heads = random_params(partial(module.init, method=BevFormerDetr.decode), bev)["params"]

    def outputs(torch_params, inputs):
        params = baseline_lane_params(torch_params)
        last = f"heads_{decoder.layers - 1}"
        params[last] = params[last] | {"successor": heads[last]["successor"]}

        def one(bev):
            prediction, state = module.apply(
                {"params": params}, bev, method=BevFormerDetr.decode, mutable=["intermediates"]
            )
            return prediction.centerlines, queries_of(state)

        found, queries = jax.vmap(one)(bev_maps(case, inputs["bev_feats"]))
        cost = jax.vmap(lambda p, g: matching_cost(p, g, weights))(found, lanes)
        assignment = match(cost, lanes.valid[:, None])
        terms = lane_losses(found, assignment, lanes, weights)
        out = {"all_cls_scores": found.logits, "all_lanes_preds": found.points, "history_states": queries}
        out = layers_first(out)
        for name, term in {"lane_cls": "class", "lane_reg": "points"}.items():
            out |= by_layer(f"loss_{name}", terms[term])
        return out, (cost, assignment)

    check_matching(case, *check(case, outputs))
