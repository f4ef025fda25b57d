"""MapTRv2's head (decoupled decoder, one-to-many group, masks, costs, losses) against the reference's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, implemented, load_module_case, numbered, options
from tests.golden_compare import compare
from tests.models.golden_lanes import by_layer
from tests.models.golden_maps import decoder_config, lines_by_name, perception_range, targets
from tests.slow import with_slow
from tflane_jax.convert.maptr import MAPTRV2_HEAD
from tflane_jax.losses.maptr import assign_lines, line_losses, matching_cost
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig, mask_loss, one_to_many_losses
from tflane_jax.models.auxiliary import AUXILIARY, LineMaskHead, auxiliary_outputs
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.maptrv2 import MapTrV2, MapTrV2Config


@pytest.mark.golden
@pytest.mark.parametrize("path", with_slow(golden_modules("maptrv2_head_*"), quick=["maptrv2_head_train"]), ids=case_id)
def test_head_matches_the_reference(path):
    check_head(load_module_case(path))


def check_head(case):
    implemented(case, mode=["train", "eval"])
    training, range_ = case.config["mode"] == "train", perception_range(case)
    sizes, encoder = options(case, "one2many", "k", "lambda_one2many", "bev"), EvidenceEncoderConfig(range=range_)
    config = MapTrV2Config(encoder=encoder, decoder=decoder_config(case), many=sizes.one2many, line_mask=True)
    weights = MapTrV2LossConfig(many_repeats=sizes.k, many_weight=sizes.lambda_one2many)
    module, truth = MapTrV2(config), targets(case)

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, MAPTRV2_HEAD)
        view_head = {"params": params.pop("encoder")["view_mask_head"]}

        def one(bev):
            mutable = [AUXILIARY] if training else []
            found, state = module.apply({"params": params}, bev, method=MapTrV2.decode, mutable=mutable)
            return found.lines, auxiliary_outputs(state)

        bev = jnp.asarray(inputs["bev"]).transpose(0, 2, 3, 1)
        lines, auxiliary = jax.vmap(one)(bev)
        mask = LineMaskHead().apply({"params": params["mask_head"]}, bev)
        views = LineMaskHead().apply(view_head, jnp.asarray(inputs["feat"]).transpose(0, 1, 3, 4, 2))
        out = lines_by_name(lines, range_) | {"seg": mask[:, None], "pv_seg": views[:, :, None]}
        if not training:
            return out, None
        np.testing.assert_array_equal(auxiliary.line_mask.shape, mask.shape)
        assert auxiliary.one_to_many is not None
        many = auxiliary.one_to_many
        out |= {f"o2m.{name}": value for name, value in lines_by_name(many, range_).items()}
        assignment = assign_lines(lines, truth, range_, weights)
        out |= losses_by_name(line_losses(lines, assignment, truth, range_, weights), "")
        repeated = one_to_many_losses(many, truth, range_, weights)
        out |= losses_by_name({name: weights.many_weight * term for name, term in repeated.items()}, "_one2many")
        drawn, seen = (stacked(inputs, name) for name in ("gt_seg", "gt_pv_seg"))
        out["loss.loss_seg"] = weights.mask_weight * mask_loss(auxiliary.line_mask, drawn[:, 0], weights.mask_positive)
        out["loss.loss_pv_seg"] = weights.view_mask_weight * mask_loss(views, seen[:, :, 0], weights.view_mask_positive)
        cost = jax.vmap(jax.vmap(lambda p, t: matching_cost(p, t, range_, weights), (0, None)))
        return out, (cost(lines, truth), cost(many, truth))

    constant = ("code_weights", "pos_weight")
    params = {name: value for name, value in case.params.items() if not name.endswith(constant)}
    later = {name for name in case.outputs if ".cost." in f".{name}"}
    found = compare(case, outputs, params=params, ignore=later)
    assert bool(later) == training
    for name in later:
        prefix, _, place = name.rpartition("cost.")
        layer, image = (int(part) for part in place.split("."))
        expected, cost = case.outputs[name], found[1 if prefix else 0][image, layer]
        repeats = sizes.k if prefix else 1
        count = expected.shape[1] // repeats
        ours = np.concatenate([cost[:, :count]] * repeats, 1)
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-4, err_msg=name)


def losses_by_name(terms, suffix):
    """Return the losses of every layer by the reference's names; those of boxes have weight 0."""
    nothing = jnp.zeros_like(terms["class"])
    names = {"cls": terms["class"], "pts": terms["points"], "dir": terms["direction"], "bbox": nothing, "iou": nothing}
    every = [by_layer(f"loss_{name}{suffix}", term) for name, term in names.items()]
    return {key: value for part in every for key, value in part.items()}


def stacked(inputs, name):
    return jnp.stack([jnp.asarray(inputs[key]) for key in numbered(inputs, rf"{name}\.(\d+)")])
