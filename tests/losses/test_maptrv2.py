"""MapTRv2's masks of lines in the images: cameras that deliver nothing teach nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.models.cases import SMALL_LINES, make_camera_example, make_line_example
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig, mask_loss
from tflane_jax.models.maptrv2 import MapTrV2Config

HOST = MapTrV2Config(encoder=SMALL_LINES.encoder, decoder=SMALL_LINES.decoder)


def test_the_mean_is_over_the_valid_cells():
    rng = np.random.default_rng(0)
    logits, mask = jnp.asarray(rng.normal(size=(3, 2, 4))), jnp.asarray(rng.random((3, 2, 4)) < 0.3)
    valid = np.array([True, False, True])
    expected = optax.losses.sigmoid_binary_cross_entropy(logits[valid], mask[valid].astype(float))
    expected = (jnp.where(mask[valid], 4.0, 1.0) * expected).mean()
    found = mask_loss(logits, mask, 4.0, jnp.asarray(valid)[:, None, None])
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert mask_loss(logits, mask, 4.0, jnp.zeros((3, 1, 1), bool)) == 0.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_an_absent_camera_changes_neither_loss_nor_gradient(bad):
    example = make_camera_example().replace(map_lines=make_line_example().map_lines)
    batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], example)
    views = batch.cameras
    logits = jnp.asarray(np.random.default_rng(1).normal(size=(1, len(example.cameras.valid), 4, 6)), jnp.float32)

    def learn(logits, valid):
        one = batch.replace(cameras=views.replace(valid=valid))
        terms = MapTrV2LossConfig().auxiliary_terms("view_line_masks", logits, None, one, HOST)
        return terms["view_mask"].sum()

    only = jnp.zeros_like(views.valid).at[:, 0].set(True)
    loss, gradient = jax.jit(jax.value_and_grad(learn))(logits, only)
    dirty, again = jax.jit(jax.value_and_grad(learn))(logits.at[:, 1:].set(bad), only)
    np.testing.assert_array_equal(dirty, loss)
    np.testing.assert_array_equal(again, gradient)
    assert not np.asarray(gradient[:, 1:]).any()
    assert loss > 0.1
