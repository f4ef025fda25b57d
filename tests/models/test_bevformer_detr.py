"""BEVFormer-DETR's lane head against the reference's numbers, and Bezier lanes."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, load_module_case
from tests.models.cases import BASELINE, make_example
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
from tflane_jax.convert.toponet import BASELINE_LANES
from tflane_jax.errors import UserError
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.losses.toponet import TopoNetLossConfig, lane_losses, matching_cost
from tflane_jax.matching import match
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.bevformer_detr import BevFormerDetr, BevFormerDetrConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lane_queries import LaneProposalConfig
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask


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
        params = converted_params(torch_params, BASELINE_LANES)
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


DETR = BevFormerDetrConfig(
    encoder=BASELINE.encoder, elements=None, decoder=replace(BASELINE.decoder, refine="fixed"), control_points=5
)


def test_true_lanes_are_noised_as_control_points():
    """A straight lane of 11 points has five control points, equally spaced; other lanes are padding, NaN here."""
    example = make_example(lanes=2)
    lanes = example.lanes
    lanes.points[2:] = np.nan
    taken, _ = DETR.build().apply({}, example, method="true_lanes", mutable=[AUXILIARY])
    expected = np.linspace(lanes.points[:2, 0], lanes.points[:2, -1], 5, axis=1)
    np.testing.assert_allclose(taken.points[:2], expected, atol=1e-4)
    np.testing.assert_array_equal(taken.valid, lanes.valid)


def test_curves_learn_from_noised_lanes():
    task = LaneGraphTask(replace(DETR, denoising=DenoisingConfig(copies=2)), BevFormerDetrLossConfig())
    example = make_example()
    params = jax.eval_shape(task.init, jax.random.key(0), example)
    batch = stack_examples([example, make_example(1)])
    _, terms = jax.eval_shape(task.loss, params, batch, jax.random.key(1))
    assert {"points", "denoised_points"} <= terms.keys()


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"control_points": 12}, r"control_points is 12: it must be at most decoder\.points \(11\)"),
        (
            {"decoder": replace(DETR.decoder, proposals=LaneProposalConfig(count=2))},
            "decoder.proposals is LaneProposalConfig: it must be None with control_points",
        ),
    ],
)
def test_curves_that_cannot_be_are_named(changes, setting):
    with pytest.raises(UserError, match=setting):
        replace(DETR, **changes).build()
