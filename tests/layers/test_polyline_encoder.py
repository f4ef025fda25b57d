"""The encoder of polylines: padding, and dropout. What its hosts make of it: `tests.models.test_sd_map_encoder`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.parameters import random_params
from tests.shared import random_array
from tests.slow import with_slow
from tflane_jax.layers.polyline_encoder import PolylineEncoder, PolylineEncoderConfig


def encoder(attend, dropout=0.0):
    """Return the encoder, its parameters, and three lines with labels."""
    module = PolylineEncoder(PolylineEncoderConfig(8, 2, 2, 8, dropout, 4, attend=attend))
    points, labels = jax.nn.sigmoid(random_array(0, 3, 5, 2)), random_array(1, 3, 2)
    return module, random_params(module.init, points, labels, jnp.ones(3, bool)), points, labels


@pytest.mark.parametrize("attend", with_slow(["lines", "points"], quick=["points"]))
def test_lines_that_are_not_valid_are_none_at_all_and_may_hold_anything(attend):
    module, params, points, labels = encoder(attend)

    @jax.jit
    def run(points, labels, valid):
        def total(params):
            tokens = module.apply(params, points, labels, valid)
            return jnp.square(tokens).sum(), tokens

        return jax.grad(total, has_aux=True)(params)

    gone = jnp.array([True, False, True])
    by_params, tokens = run(
        *(jnp.where(gone.reshape(3, *[1] * (x.ndim - 1)), x, jnp.nan) for x in (points, labels)), gone
    )
    expected, without = run(points[::2], labels[::2], jnp.ones(2, bool))
    np.testing.assert_allclose(tokens[::2], without, rtol=1e-5, atol=1e-6)
    assert not tokens[1].any()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), by_params, expected)


@pytest.mark.parametrize("attend", with_slow(["lines", "points"], quick=["points"]))
def test_each_line_drops_features_of_its_own(attend):
    module, params, points, labels = encoder(attend, dropout=0.5)
    equal = jnp.broadcast_to(points[:1], points.shape), jnp.broadcast_to(labels[:1], labels.shape), jnp.ones(3, bool)
    plain = module.apply(params, *equal)
    np.testing.assert_allclose(plain, np.broadcast_to(plain[:1], plain.shape), atol=1e-5)
    dropped = module.apply(params, *equal, deterministic=False, rngs={"dropout": jax.random.key(0)})
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(dropped[i] - dropped[j]).max() > 1e-2
