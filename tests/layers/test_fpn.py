"""The feature pyramid against the reference's numbers, and its levels."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, implemented, load_module_case, numbered, options
from tests.golden_compare import compare
from tflane_jax.convert.bevformer import FEATURE_PYRAMID
from tflane_jax.layers.fpn import FeaturePyramid, FeaturePyramidConfig, enlarge


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("fpn_*"), ids=case_id)
def test_matches_the_reference(path):
    check(load_module_case(path))


def check(case):
    sizes = options(case, "out_channels", "num_outs", start_level=0, end_level=-1, relu_before_extra_convs=False)
    names = numbered(case.inputs, r"c(\d+)")[sizes.start_level :]
    if sizes.end_level != -1:
        pytest.fail(f"{case.meta['name']}: option end_level = {sizes.end_level} is not implemented")
    if sizes.num_outs > len(names):
        implemented(case, add_extra_convs=["on_output"])
    if sizes.num_outs > len(names) + 1:
        implemented(case, relu_before_extra_convs=[True])
    implemented(case, norm_cfg=[None], act_cfg=[None], upsample_cfg=[None, {"mode": "nearest"}])
    pyramid = FeaturePyramid(FeaturePyramidConfig(sizes.out_channels, sizes.num_outs))

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, FEATURE_PYRAMID)
        features = [jnp.asarray(inputs[name]).transpose(0, 2, 3, 1) for name in names]
        levels = pyramid.apply({"params": params}, features)
        return {f"p{i}": level.transpose(0, 3, 1, 2) for i, level in enumerate(levels)}

    compare(case, outputs)


def test_only_further_extra_levels_are_rectified():
    """Two levels beyond the given one: the first reads it as it is, the second what is positive of the first."""
    pyramid = FeaturePyramid(FeaturePyramidConfig(1, 3))
    identity = {"kernel": jnp.zeros((3, 3, 1, 1)).at[1, 1].set(1.0), "bias": jnp.zeros(1)}
    params = {f"output_{i}": identity for i in range(3)}
    params["lateral_0"] = {"kernel": jnp.ones((1, 1, 1, 1)), "bias": jnp.zeros(1)}
    levels = pyramid.apply({"params": params}, [-jnp.ones((1, 4, 4, 1))])
    assert isinstance(levels, list)
    assert [level.shape[1:3] for level in levels] == [(4, 4), (2, 2), (1, 1)]
    assert [float(level.mean()) for level in levels] == [-1.0, -1.0, 0.0]
    with pytest.raises(ValueError, match="cannot hold"):
        FeaturePyramid(FeaturePyramidConfig(1, 1)).apply({"params": params}, [jnp.ones((1, 2, 2, 1))] * 2)


@pytest.mark.parametrize("size", [(3, 5), (6, 10), (7, 11), (5, 9)])
def test_enlarging_takes_the_nearest_cell(size):
    x = np.random.default_rng(0).normal(size=(2, 3, 5, 2)).astype(np.float32)
    rows, columns = (np.arange(n) * m // n for n, m in zip(size, (3, 5), strict=True))
    np.testing.assert_array_equal(enlarge(jnp.asarray(x), *size), x[:, rows][:, :, columns])
