"""LaneSegNet's head (decoder, heads, costs, matching, losses) against the reference's numbers."""

import jax
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, implemented, load_module_case
from tests.golden_compare import compare
from tests.models.golden_lanes import bev_maps, by_layer, encoder_config, queries_of
from tests.models.golden_segments import decoder_config, segments_by_name, targets
from tests.slow import with_slow
from tflane_jax.convert.lanesegnet import LANESEGNET_HEAD
from tflane_jax.layers.graph import RelationshipHead
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig, assign_segments, matching_cost, segment_losses
from tflane_jax.models.lanesegnet import LaneSegNet, LaneSegNetConfig

LOSSES = {
    "lane_cls": "class",
    "lane_reg": "points",
    "seg_dice": "dice",
    "seg_mask": "mask",
    "lane_type": "line_type",
}


@pytest.mark.golden
@pytest.mark.parametrize("path", with_slow(golden_modules("laneseg_head_*"), quick=["laneseg_head_train"]), ids=case_id)
def test_head_matches_the_reference(path):
    check_head(load_module_case(path))


def check_head(case):
    implemented(case, mode=["train", "eval"])
    training = case.config["mode"] == "train"
    decoder, weights = decoder_config(case), LaneSegNetLossConfig()
    module = LaneSegNet(LaneSegNetConfig(encoder=encoder_config(case), decoder=decoder, last_step="twice"))
    truth, masks = targets(case)
    # The topology head is a module of its own in the reference.
    dummy = np.zeros((decoder.queries, decoder.dim), np.float32)
    relations = jax.tree.map(
        lambda leaf: np.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(RelationshipHead(decoder.relation).init, jax.random.key(0), dummy, dummy)["params"],
    )

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, LANESEGNET_HEAD) | {"successor": relations}

        def one(bev):
            prediction, state = module.apply(
                {"params": params},
                bev,
                deterministic=not training,
                method=LaneSegNet.decode,
                mutable=["intermediates"],
            )
            return prediction.segments, queries_of(state)

        segments, queries = jax.vmap(one)(bev_maps(case, inputs["bev_feats"]))
        if not training:
            last = jax.tree.map(lambda leaf: leaf[:, -1:], segments)
            return segments_by_name(last, queries), None
        layers = segments.replace(successor_logits=None)
        cost = jax.vmap(jax.vmap(lambda p, t, m: matching_cost(p, t, m, weights), (0, None, None)))(
            layers, truth, masks
        )
        assignment = assign_segments(segments, truth, masks, weights)
        terms = segment_losses(segments, assignment, truth, masks, weights)
        out = segments_by_name(segments, queries)
        for name, term in LOSSES.items():
            out |= by_layer(f"loss_{name}", terms[term])
        return out, (cost, assignment)

    params = {name: value for name, value in case.params.items() if name != "code_weights"}
    later = {name for name in case.outputs if name.startswith(("cost.", "pos_"))}
    found = compare(case, outputs, params=params, ignore=later, tolerances={"all_lanes_preds": 5e-5})
    if training:
        check_matching(case, *found)


def check_matching(case, cost, assignment):
    names = [name for name in case.outputs if name.startswith("cost.")]
    assert names
    for name in names:
        layer, image = (int(part) for part in name.split(".")[1:])
        expected = case.outputs[name]
        count = expected.shape[1]
        np.testing.assert_allclose(cost[image, layer, :, :count], expected, rtol=1e-4, atol=1e-4, err_msg=name)
        rows, columns = (case.outputs[f"pos_{side}.{layer}.{image}"] for side in ("inds", "assigned_gt_inds"))
        query = np.asarray(assignment.query[image, layer])
        np.testing.assert_array_equal(query[columns], rows, err_msg=name)
        np.testing.assert_array_equal(np.asarray(assignment.matched[image, layer]), np.arange(query.size) < count)
