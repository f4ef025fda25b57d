"""The encoder of BEV evidence: shapes, context of the U-Net, and when priors are fused in."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.models.evidence_encoder import EvidenceEncoder, EvidenceEncoderConfig


def features(config, bev, fuse=None):
    encoder = EvidenceEncoder(config)
    params = jax.jit(lambda key: encoder.init(key, bev, fuse))(jax.random.key(0))
    return jax.jit(lambda p, x: encoder.apply(p, x, fuse))(params, bev), params, encoder


@pytest.mark.parametrize("shape", [(4, 4), pytest.param((20, 28), marks=pytest.mark.slow), (24, 40)])
def test_levels_keep_the_shape_of_the_features(shape):
    config = EvidenceEncoderConfig(dim=8, levels=(16, 24), dilations=(), coordinates=True)
    x, params, _ = features(config, jnp.zeros((*shape, 4), jnp.uint8))
    assert x.shape == (shape[0] // 4, shape[1] // 4, 8)
    assert np.isfinite(x).all()
    assert set(params["params"]) == {"stem", "stem_norm", "context"}


@pytest.mark.parametrize(("levels", "far"), [pytest.param((), False, marks=pytest.mark.slow), ((16, 16), True)])
def test_levels_give_context_from_the_whole_box(levels, far):
    config = EvidenceEncoderConfig(dim=8, levels=levels, dilations=(1,))
    bev = jax.random.randint(jax.random.key(1), (32, 64, 4), 0, 255).astype(jnp.uint8)
    before, params, encoder = features(config, bev)
    # Group norms connect all cells, so compare through the gradient with their statistics held fixed: a change of the
    # one far corner against the same change next to the cell.
    reach = jax.jacrev(lambda x: _without_norm(encoder, params, x)[0, 0, 0])(bev.astype(jnp.float32))
    assert bool(jnp.abs(reach[:, 40:]).max() > 0) == far
    assert before.shape == (8, 16, 8)


def _without_norm(encoder, params, bev):
    def identity(next_method, args, kwargs, context):
        if isinstance(context.module, nn.GroupNorm):
            return args[0]
        return next_method(*args, **kwargs)

    with nn.intercept_methods(identity):
        return encoder.apply(params, bev)


def test_a_feature_cell_reads_the_raster_around_its_own_block():
    """Two convolutions of 3 x 3 features, of 4 x 4 raster cells each, see two blocks to every side."""
    config = EvidenceEncoderConfig(dim=8, dilations=(1,))
    bev = jax.random.randint(jax.random.key(1), (24, 40, 4), 0, 255).astype(jnp.uint8)
    _, params, encoder = features(config, bev)
    slope = jax.jacrev(lambda x: _without_norm(encoder, params, x)[2, 6].sum())(bev.astype(jnp.float32))
    rows, columns = np.mgrid[:24, :40] // 4
    expected = (abs(rows - 2) <= 2) & (abs(columns - 6) <= 2)
    np.testing.assert_array_equal(np.asarray(slope != 0).any(-1), expected)


def test_priors_are_fused_before_the_levels_and_after_every_block():
    layers = []

    def fuse(layer, shape, x, position):
        layers.append((layer, x.shape))
        assert shape == (2, 4)
        assert position.shape == x.shape
        return x

    config = EvidenceEncoderConfig(dim=8, levels=(16,), dilations=(1, 2))
    features(config, jnp.zeros((8, 16, 4), jnp.uint8), fuse)
    assert set(layers) == {(i, (8, 8)) for i in range(3)}
    assert {layer for layer, _ in layers} == {0, 1, 2}


def test_a_raster_that_does_not_fold_is_refused():
    with pytest.raises(ValueError, match="does not fold into blocks of 4 x 4"):
        features(EvidenceEncoderConfig(), jnp.zeros((10, 16, 4), jnp.uint8))
