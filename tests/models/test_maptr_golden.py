"""MapTR's head (BEV encoder, decoder, heads, costs, matching, losses) against the reference's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, load_module_case
from tests.golden_compare import compare
from tests.layers.batch_bugs import EXAMPLES, like_the_reference
from tests.models.golden_lanes import by_layer
from tests.models.golden_maps import (
    decoder_config,
    encoder_config,
    encoder_inputs,
    lines_by_name,
    perception_range,
    targets,
)
from tests.slow import with_slow
from tflane_jax.convert.maptr import MAPTR_HEAD
from tflane_jax.evaluation.vector_maps import detections_of_lines
from tflane_jax.losses.maptr import MapTrLossConfig, assign_lines, line_losses, matching_cost
from tflane_jax.models.bevformer import BevFormer
from tflane_jax.models.maptr import MapTr, MapTrConfig


@pytest.mark.golden
@pytest.mark.parametrize("path", with_slow(golden_modules("maptr_head_*"), quick=["maptr_head_gkt"]), ids=case_id)
def test_head_matches_the_reference(path):
    check_head(load_module_case(path))


def check_head(case):
    encoder, decoder, range_ = encoder_config(case), decoder_config(case), perception_range(case)
    module, weights = MapTr(MapTrConfig(encoder=encoder, decoder=decoder, range=range_)), MapTrLossConfig()
    truth, (views, history, shift) = targets(case), encoder_inputs(case)

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, MAPTR_HEAD)
        bev_params = params.pop("encoder")["bev"]

        def one(features, views, history, shift, motion):
            arguments = ([features], views, history, shift, motion)
            bev = BevFormer(encoder.bev).apply({"params": bev_params}, *arguments, method="encode")
            return bev, module.apply({"params": params}, bev, method=MapTr.decode).lines

        features = jnp.asarray(inputs["feat"]).transpose(0, 1, 3, 4, 2)
        with like_the_reference():
            run = jax.vmap(one, axis_name=EXAMPLES)
            bev, lines = run(features, views, history, shift, jnp.asarray(inputs["can_bus"]))
        cost = jax.vmap(jax.vmap(lambda p, t: matching_cost(p, t, range_, weights), (0, None)))(lines, truth)
        assignment = assign_lines(lines, truth, range_, weights)
        terms = line_losses(lines, assignment, truth, range_, weights)
        out = lines_by_name(lines, range_)
        out["bev_embed"] = bev.reshape(len(bev), -1, bev.shape[-1]).swapaxes(0, 1)
        # The losses of boxes have weight 0.
        nothing = jnp.zeros(decoder.layers)
        names = {"cls": terms["class"], "pts": terms["points"], "dir": terms["direction"]}
        for name, term in (names | {"bbox": nothing, "iou": nothing}).items():
            out |= by_layer(f"loss_{name}", term)
        return out, (cost, lines)

    params = {name: value for name, value in case.params.items() if name != "code_weights"}
    later = {name for name in case.outputs if name.startswith(("cost.", "decoded."))}
    cost, lines = compare(case, outputs, params=params, ignore=later)
    names = [name for name in case.outputs if name.startswith("cost.")]
    assert names
    for name in names:
        layer, image = (int(part) for part in name.split(".")[1:])
        expected = case.outputs[name]
        found = cost[image, layer, :, : expected.shape[1]]
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4, err_msg=name)
    check_decoded(case, lines)


def check_decoded(case, lines):
    """Compare the best pairs of query and class; the reference leaves out lines far outside the range."""
    for image in range(len(lines.logits)):
        if f"decoded.{image}.pts" not in case.outputs:
            continue
        scores, labels, points = (case.outputs[f"decoded.{image}.{name}"] for name in ("scores", "labels", "pts"))
        found = detections_of_lines(jax.tree.map(lambda leaf, image=image: np.asarray(leaf)[image, -1], lines))
        assert len(scores) == len(found.scores)
        np.testing.assert_allclose(found.scores, scores, rtol=1e-4)
        np.testing.assert_array_equal(found.classes, labels)
        np.testing.assert_allclose(found.points, points, rtol=1e-4, atol=1e-3)
