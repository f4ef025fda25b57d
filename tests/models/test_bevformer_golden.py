"""BEVFormer's encoder and BEV constructers against the reference's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, load_module_case
from tests.golden_compare import assert_outputs_close, compare
from tests.layers.batch_bugs import EXAMPLES, like_the_reference
from tests.models.golden_bev import aligned, bev_config, golden_views, is_baseline, level_names, without_unused
from tests.slow import with_slow
from tflane_jax.convert.bevformer import BEV_CONSTRUCTER, ENCODER
from tflane_jax.convert.renaming import check_fits, convert
from tflane_jax.errors import UserError
from tflane_jax.models.bev_encoder import BevEncoder
from tflane_jax.models.bevformer import BevFormer, BevMemory, see_pillars

pytestmark = pytest.mark.golden


@pytest.mark.parametrize(
    "path", with_slow(golden_modules("bevformer_encoder*"), quick=["bevformer_encoder_1layer_prev"]), ids=case_id
)
def test_encoder_matches_the_reference(path):
    check_encoder(load_module_case(path))


def check_encoder(case):
    config, views = bev_config(case), golden_views(case.inputs)
    shapes = tuple(tuple(int(n) for n in row) for row in case.inputs["spatial_shapes"])
    reference, visible = jax.vmap(lambda one: see_pillars(config, one))(views)

    def outputs(torch_params, arrays):
        params, has_past = converted_params(torch_params, ENCODER), "prev_bev" in arrays

        def one(queries, position, tokens, past, shift, reference, visible):
            history = BevMemory(past, jnp.asarray(has_past))
            arguments = (queries, position, tokens, shapes, reference, visible, history, shift, True)
            return BevEncoder(config).apply({"params": params}, *arguments)

        queries = jnp.asarray(arrays["bev_query"]).swapaxes(0, 1)
        past = jnp.asarray(arrays["prev_bev"]).swapaxes(0, 1) if has_past else jnp.full_like(queries, jnp.nan)
        position = jnp.asarray(arrays["bev_pos"]).swapaxes(0, 1)
        tokens = jnp.asarray(arrays["feats"]).transpose(2, 0, 1, 3)
        with like_the_reference(mixed_history=not is_baseline(case)):
            every = (queries, position, tokens, past, arrays["shift"], reference, visible)
            return {"output": jax.vmap(one, axis_name=EXAMPLES)(*every)}

    compare(case, outputs)


@pytest.mark.parametrize(
    "path", with_slow(golden_modules("bev_constructer_*"), quick=["bev_constructer_toponet_prev"]), ids=case_id
)
def test_constructer_matches_the_reference(path):
    check_constructer(load_module_case(path))


def check_constructer(case):
    config, views = bev_config(case), golden_views(case.inputs)
    model, motion, levels = BevFormer(config), jnp.asarray(case.inputs["can_bus"]), level_names(case)
    history, shift = aligned(case, config)
    check_alignment(case, history, shift)

    def outputs(torch_params, arrays):
        params = without_unused(case, converted_params(torch_params, BEV_CONSTRUCTER))

        def one(features, views, history, shift, motion):
            arguments = (features, views, history, shift, motion)
            return model.apply({"params": params}, *arguments, method="encode").reshape(-1, config.dim)

        features = [jnp.asarray(arrays[name]).transpose(0, 1, 3, 4, 2) for name in levels]
        with like_the_reference(mixed_history=not is_baseline(case)):
            return {"output": jax.vmap(one, axis_name=EXAMPLES)(features, views, history, shift, motion)}

    compare(case, outputs, ignore=[name for name in case.outputs if name.startswith("inner.")])


def check_alignment(case, history, shift):
    """Compare what the reference's constructer hands to its encoder."""
    if "inner.shift" in case.outputs:
        assert_outputs_close({"inner.shift": shift}, {"inner.shift": case.outputs["inner.shift"]})
    if "inner.prev" in case.outputs:
        ours = np.asarray(history.features).reshape(len(shift), -1, history.features.shape[-1]).swapaxes(0, 1)
        np.testing.assert_array_equal(ours, case.outputs["inner.prev"])


@pytest.mark.parametrize("path", golden_modules("bev_constructer_*"), ids=case_id)
def test_every_tensor_of_the_reference_is_accounted_for(path):
    case = load_module_case(path)
    config = bev_config(case)
    converted = convert(case.params, BEV_CONSTRUCTER, "BEVFormer")
    assert [row["tensor"] for row in converted.table] == list(case.params)
    views = jax.tree.map(lambda leaf: leaf[0], golden_views(case.inputs))
    levels = [case.inputs[name][0].transpose(0, 2, 3, 1) for name in level_names(case)]
    fresh = jax.eval_shape(BevFormer(config).init, jax.random.key(0), levels, views, None, jnp.eye(4))
    check_fits(converted.variables["params"], fresh["params"], path)
    layer = f"encoder.layers.{config.layers - 1}.norms.3.weight"
    with pytest.raises(UserError, match="no tensor of BEVFormer"):
        convert(case.params | {layer: case.params["level_embeds"]}, BEV_CONSTRUCTER, "BEVFormer")
