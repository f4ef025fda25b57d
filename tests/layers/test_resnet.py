"""ResNet with its norms against PyTorch's numbers, in training and in inference."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, implemented, load_module_case, options
from tests.golden_compare import compare
from tests.slow import with_slow
from tflane_jax.convert.lstr import RESNET
from tflane_jax.convert.renaming import convert
from tflane_jax.layers.batch_norm import BATCH_AXIS
from tflane_jax.layers.resnet import ResNet, ResNetConfig, StemConvolution, max_pool

BLOCKS = {
    18: ("basic", (2, 2, 2, 2)),
    34: ("basic", (3, 4, 6, 3)),
    50: ("bottleneck", (3, 4, 6, 3)),
    101: ("bottleneck", (3, 4, 23, 3)),
    152: ("bottleneck", (3, 8, 36, 3)),
}


@pytest.mark.golden
@pytest.mark.parametrize("path", with_slow(golden_modules("resnet*"), quick=["resnet18_train"]), ids=case_id)
def test_matches_pytorch(path):
    check(load_module_case(path))


def check(case):
    found = options(case, "base_channels", "depth", stem_channels=None, out_indices=(0, 1, 2, 3), mode="eval")
    implemented(case, mode=["eval", "train"], style=["pytorch"], deep_stem=[False], avg_down=[False])
    block, blocks = BLOCKS[found.depth]
    channels = tuple(found.base_channels * 2**i for i in range(4))
    stem = found.stem_channels or found.base_channels
    model = ResNet(ResNetConfig(blocks, channels, (1, 2, 2, 2), stem, block))
    train = found.mode == "train"

    def outputs(torch_params, inputs):
        variables = convert(torch_params, RESNET, "ResNet").variables

        def one(x):
            return model.apply(variables, x[None], train=train, mutable=["batch_stats"])

        images = jnp.asarray(inputs["x"]).transpose(0, 2, 3, 1)
        stages, statistics = jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, None))(images)
        return {f"c{i + 2}": stages[i][:, 0].transpose(0, 3, 1, 2) for i in found.out_indices}, statistics

    after = {name.removeprefix("bn_after/"): v for name, v in case.outputs.items() if name.startswith("bn_after/")}
    # The reference's own distance to double precision, which is 3e-3 where ResNet-50's features reach 7,000.
    noise = case.meta.get("max_abs_diff_vs_float64", {})
    features = {f"c{i + 2}" for i in found.out_indices}
    beside = {"grad_scalar", *(f"bn_after/{name}" for name in after)}
    statistics = compare(case, outputs, ignore=beside, absolute={name: noise.get(name, 0.0) for name in features})
    assert bool(after) <= train
    wanted = convert(after, RESNET, "ResNet").variables["batch_stats"]
    for place, value in jax.tree.leaves_with_path(statistics["batch_stats"]) if after else []:
        expected = wanted
        for key in place:
            expected = expected[key.key]
        np.testing.assert_allclose(value, expected, rtol=2e-5, atol=2e-5, err_msg=str(place))


def test_norms_of_frozen_parts_keep_their_statistics():
    """Regression: a training moved them, and normalised by those of its batch, where `frozen_norms` was not set."""
    model = ResNet(ResNetConfig((1, 1), (4, 4), (1, 2), 4), frozen_stages=2)
    images = jnp.asarray(np.random.default_rng(0).normal(3.0, 2.0, (2, 16, 16, 3)), jnp.float32)
    variables = model.init(jax.random.key(0), images, train=False)
    outputs, changed = model.apply(variables, images, train=True, mutable=["batch_stats"])
    before, after = variables["batch_stats"], changed["batch_stats"]
    for frozen in ("bn1", "layer1_0"):
        jax.tree.map(np.testing.assert_array_equal, after[frozen], before[frozen])
    assert not np.array_equal(after["layer2_0"]["bn1"]["mean"], before["layer2_0"]["bn1"]["mean"])
    np.testing.assert_array_equal(outputs[0], model.apply(variables, images, train=False)[0])


@pytest.mark.parametrize("size", [(6, 8), (7, 9), (6, 9), (2, 2), (1, 1)])
def test_stem_is_a_convolution_of_stride_two_at_any_size(size):
    stem = StemConvolution(4)
    x = jnp.asarray(np.random.default_rng(2).normal(size=(2, *size, 3)).astype(np.float32))
    variables = stem.init(jax.random.key(0), x)
    plain = nn.Conv(4, (7, 7), (2, 2), [(3, 3), (3, 3)], use_bias=False)
    np.testing.assert_allclose(stem.apply(variables, x), plain.apply(variables, x), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("size", [(6, 8), (7, 9), (6, 9), (1, 1)])
def test_pooling_takes_the_largest_of_three_by_three(size):
    x = jnp.asarray(np.random.default_rng(3).normal(size=(2, *size, 3)).astype(np.float32))
    weights = np.random.default_rng(4).normal(size=jax.eval_shape(max_pool, x).shape).astype(np.float32)
    by_window = lambda x: nn.max_pool(x, (3, 3), (2, 2), [(1, 1), (1, 1)])  # noqa: E731

    @partial(jax.jit, static_argnums=0)
    def pulled(pool, x, weights):
        out, pull = jax.vjp(pool, x)
        return out, pull(weights)[0]

    (ours, gradient), (out, expected) = (pulled(pool, x, weights) for pool in (max_pool, by_window))
    np.testing.assert_array_equal(ours, out)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
