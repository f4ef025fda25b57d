"""1x1 convolutions as products against XLA's convolution, forward and backward."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.parameters import random_params
from tflane_jax.layers.pointwise import convolve

LAYOUT = ("NHWC", "HWIO", "NHWC")


@pytest.mark.parametrize("size", [(6, 8), (7, 5), (1, 1)])
@pytest.mark.parametrize("strides", [(1, 1), (2, 2), (1, 3)])
def test_product_equals_the_convolution(size, strides):
    rng = np.random.default_rng(0)
    x, kernel = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((2, *size, 5), (1, 1, 5, 4)))

    def run(function):
        return jax.vjp(lambda *a: function(*a, strides, [(0, 0), (0, 0)], dimension_numbers=LAYOUT), x, kernel)

    (ours, ours_back), (wanted, wanted_back) = run(convolve), run(lax.conv_general_dilated)
    assert ours.shape == wanted.shape
    cotangent = jnp.asarray(rng.normal(size=wanted.shape), jnp.float32)
    for a, b in zip((ours, *ours_back(cotangent)), (wanted, *wanted_back(cotangent)), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-5)


@pytest.mark.parametrize(
    ("size", "options"),
    [
        (1, {}),
        (1, {"strides": (2, 2)}),
        (1, {"padding": [(1, 0), (0, 2)]}),
        (1, {"feature_group_count": 2}),
        (1, {"input_dilation": 2}),
        (3, {"strides": (2, 2), "padding": [(1, 1), (1, 1)]}),
    ],
)
def test_linen_convolutions_keep_parameters_and_numbers(size, options):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(2, 7, 6, 4)), jnp.float32)
    padding = options.pop("padding", [(0, 0), (0, 0)])
    plain, ours = (
        nn.Conv(6, (size, size), padding=padding, conv_general_dilated=function, **options)
        for function in (None, convolve)
    )
    params = random_params(plain.init, x)
    assert jax.tree.map(jnp.shape, params) == jax.tree.map(jnp.shape, ours.init(jax.random.key(0), x))
    np.testing.assert_allclose(ours.apply(params, x), plain.apply(params, x), rtol=2e-6, atol=2e-6)


def test_only_unpadded_1x1_kernels_are_products():
    def operations(size, pad):
        x, kernel = jnp.ones((1, 4, 4, 2)), jnp.ones((size, size, 2, 2))
        traced = jax.make_jaxpr(lambda *a: convolve(*a, (1, 1), [(pad, pad)] * 2, dimension_numbers=LAYOUT))(x, kernel)
        return {equation.primitive.name for equation in traced.eqns}

    assert "dot_general" in operations(1, 0)
    assert "conv_general_dilated" not in operations(1, 0)
    assert "conv_general_dilated" in operations(1, 1)
    assert "conv_general_dilated" in operations(3, 0)
