"""SMERF's map encoder, its fusion and its BEV constructer against the reference's numbers."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, implemented, load_module_case, numbered, options
from tests.golden_compare import compare
from tests.layers.batch_bugs import EXAMPLES, like_the_reference
from tests.models.golden_bev import aligned, bev_config, golden_views, level_names, without_unused
from tests.models.test_bevformer_golden import check_alignment
from tests.models.test_sd_map_encoder import fused_with
from tflane_jax.convert.renaming import check_fits, convert
from tflane_jax.convert.sd_map import CROSS_ATTENTION, SD_MAP_ENCODER, SMERF_CONSTRUCTER
from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.polyline_encoder import PolylineEncoderConfig, temperature_encoding
from tflane_jax.models.bevformer import BevFormer, see_pillars
from tflane_jax.models.sd_map_encoder import SdMapEncoder, SdMapFusion, SdMapModuleConfig
from tflane_jax.priors.sd_map import SdMapPriorConfig
from tflane_jax.scene import SdMap

pytestmark = pytest.mark.golden

# OpenLane-V2's range, of SMERF's published configurations.
LOW, SIZE = (-51.2, -25.6), (102.4, 51.2)


def unit_range(case):
    """Return the offset and the size by which the reference normalises points; 2 pi of them are one unit of ours."""
    found = options(case, normalize=True, offset=LOW, range=SIZE, scale=2 * np.pi)
    if not found.normalize:
        return np.zeros(1, np.float32), np.full(1, 2 * np.pi, np.float32)
    size = np.atleast_1d(np.array(found.range, np.float32)) * np.float32(2 * np.pi / found.scale)
    return np.atleast_1d(np.array(found.offset, np.float32)), size


@pytest.mark.parametrize("path", golden_modules("smerf_sine_continuous_pe*"), ids=case_id)
def test_encoding_of_points_matches_the_reference(path):
    check_encoding(load_module_case(path))


def check_encoding(case):
    found = options(case, "num_feats", temperature=10000)
    low, size = unit_range(case)

    def outputs(_, inputs):
        unit = (inputs["x"] - low.reshape(1, 1, -1)) / size.reshape(1, 1, -1)
        return {"output": temperature_encoding(unit, found.num_feats, temperature=found.temperature)}

    compare(case, outputs)


def padded(rows, capacity, filler=np.nan):
    """Return an array with rows of garbage behind its own."""
    return jnp.concatenate([rows, jnp.full((capacity - len(rows), *rows.shape[1:]), filler, rows.dtype)])


def encoder_config(case):
    found = options(
        case, "dim", "layers", "heads", "hidden", num_feats=0, temperature=1000, input_dim=None, categories=None
    )
    implemented(case, batch_first=[False, True], activation=["relu"], norm_first=[False])
    categories = case.inputs["onehot.0"].shape[-1] if "onehot.0" in case.inputs else 0
    low, size = unit_range(case)
    if not found.num_feats:
        # Without an encoding the reference takes coordinates in metres.
        low, size = np.zeros(2), np.ones(2)
    limits = PerceptionRange(*((float(a), float(a + b)) for a, b in zip(*np.broadcast_arrays(low, size), strict=True)))
    lines = PolylineEncoderConfig(
        found.dim, found.layers, found.heads, found.hidden, 0.0, found.num_feats or 0, float(found.temperature)
    )
    return SdMapModuleConfig(prior=SdMapPriorConfig(categories=categories), lines=lines), limits


@pytest.mark.parametrize("path", golden_modules("smerf_map_graph_transformer*"), ids=case_id)
def test_map_encoder_matches_the_reference(path):
    check_map_encoder(load_module_case(path), path)


def check_map_encoder(case, path):
    (config, limits), names = encoder_config(case), numbered(case.inputs, r"poly(\d+)")
    encoder, capacity = SdMapEncoder(config, limits), 2 + max(len(case.inputs[name]) for name in names)

    def outputs(torch_params, inputs):
        variables, out = {"params": converted_params(torch_params, SD_MAP_ENCODER)}, {}
        for name in names:
            i, lines = name.removeprefix("poly"), inputs[name]
            one_hot = case.inputs.get(f"onehot.{i}", np.zeros((len(lines), 0)))
            category = one_hot.argmax(-1) if one_hot.size else np.zeros(len(lines))
            sd_map = SdMap(
                padded(lines, capacity),
                jnp.asarray(np.resize(category, capacity), jnp.int32),
                jnp.arange(capacity) < len(lines),
            )
            tokens, valid = encoder.apply(variables, sd_map)
            out[f"feat{i}"] = tokens[: len(lines)]
            np.testing.assert_array_equal(valid.shape, (capacity,))
        return out

    compare(case, outputs)

    converted = convert(case.params, SD_MAP_ENCODER, "SMERF's map encoder")
    assert [row["tensor"] for row in converted.table] == list(case.params)
    points = case.inputs[names[0]].shape[1]
    fresh = jax.eval_shape(encoder.init, jax.random.key(0), jax.tree.map(jnp.asarray, SdMap.empty(1, points)))
    check_fits(converted.variables["params"], fresh["params"], path)


@pytest.mark.parametrize("path", golden_modules("smerf_masked_cross_attention*"), ids=case_id)
def test_attention_to_the_map_matches_the_reference(path):
    check_cross_attention(load_module_case(path))


def check_cross_attention(case):
    heads, lines = options(case, "heads").heads, case.inputs["spatial_shapes"]
    # Where an example has no line, the reference adds the bias of the attention's output.
    fusion = SdMapFusion(SdMapModuleConfig(heads=heads, absent="reference"))

    def outputs(torch_params, inputs):
        channels = inputs["query"].shape[-1]
        norm = {"scale": jnp.ones(channels), "bias": jnp.zeros(channels)}
        variables = {"params": converted_params(torch_params, CROSS_ATTENTION) | {"norm": norm}}

        def one(query, position, value, count):
            valid = jnp.arange(len(value)) < count
            tokens = jnp.where(valid[:, None], value, jnp.nan)

            # The case ends before the norm.
            def no_norm(run, args, kwargs, context):
                return args[0] if context.module.name == "norm" else run(*args, **kwargs)

            with nn.intercept_methods(no_norm):
                return fusion.apply(variables, query, position, tokens, valid)

        position = inputs.get("query_pos", jnp.zeros_like(inputs["query"]))
        return {"output": jax.vmap(one)(inputs["query"], position, inputs["value"], lines)}

    compare(case, outputs)


@pytest.mark.parametrize("path", golden_modules("smerf_bev_constructer*"), ids=case_id)
def test_constructer_matches_the_reference(path):
    check_constructer(load_module_case(path))


def check_constructer(case):
    config, views = bev_config(case), golden_views(case.inputs)
    found = options(case, "heads", map_heads=None)
    module = SdMapModuleConfig(heads=found.map_heads or found.heads, absent="reference")
    model, motion, levels = BevFormer(config), jnp.asarray(case.inputs["can_bus"]), level_names(case)
    names = numbered(case.inputs, r"map_feat(\d+)")
    capacity = 1 + max(len(case.inputs[name]) for name in names)
    valid = np.stack([np.arange(capacity) < len(case.inputs[name]) for name in names])
    history, shift = aligned(case, config)
    check_alignment(case, history, shift)

    def outputs(torch_params, inputs):
        params = without_unused(case, converted_params(torch_params, SMERF_CONSTRUCTER))

        def one(features, views, history, shift, motion, maps, valid):
            arguments, fuse = (features, views, history, shift, motion), fused_with(module, maps, valid)
            bev = model.apply({"params": params}, *arguments, fuse=fuse, method="encode")
            return bev.reshape(-1, config.dim)

        features = [jnp.asarray(inputs[name]).transpose(0, 1, 3, 4, 2) for name in levels]
        maps = jnp.stack([padded(inputs[name], capacity) for name in names])
        with like_the_reference(mixed_history=False):
            every = (features, views, history, shift, motion, maps, jnp.asarray(valid))
            return {"output": jax.vmap(one, axis_name=EXAMPLES)(*every)}

    compare(case, outputs, ignore=[name for name in case.outputs if name.startswith("inner.")])
    converted = convert(case.params, SMERF_CONSTRUCTER, "SMERF's BEVFormer")
    assert [row["tensor"] for row in converted.table] == list(case.params)


def test_elements_of_the_public_batch_see_different_queries():
    """Otherwise the golden case would not exercise the batch bug of spatial attention."""
    for path in golden_modules("smerf_bev_constructer*"):
        case = load_module_case(path)
        config, views = bev_config(case), golden_views(case.inputs)
        masks = [
            see_pillars(config, jax.tree.map(lambda leaf, i=i: leaf[i], views))[1] for i in range(len(views.valid))
        ]
        assert len(masks) == 1 or any((masks[0] != mask).any() for mask in masks[1:])
