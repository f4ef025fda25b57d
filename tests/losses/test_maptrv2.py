"""MapTRv2's masks of lines in the images: cameras that deliver nothing teach nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.models.cases import SMALL_LINES, make_camera_example, make_line_example
from tflane_jax.losses.maptr import line_targets
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig, mask_loss, one_to_many_losses
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.scene import LinePrediction, MapLines, stack_examples

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


def test_no_room_for_lines_equals_no_lines():
    """The one-to-many group of a map without lines: all queries learn that they are none."""
    rng = np.random.default_rng(2)
    points, logits = rng.uniform(-9.0, 9.0, (1, 2, 4, 5, 2)), rng.normal(size=(1, 2, 4, 3))
    found = LinePrediction(jnp.asarray(points, jnp.float32), jnp.asarray(logits, jnp.float32))
    targets = jax.vmap(lambda one: line_targets(one, 2, 3))(stack_examples([MapLines.empty(2, 5)]))
    config, range_ = MapTrV2LossConfig(many_repeats=2), HOST.bev_range
    learn = jax.jit(lambda targets: one_to_many_losses(found, targets, range_, config))
    expected, terms = learn(targets), learn(jax.tree.map(lambda leaf: leaf[:, :0], targets))
    for name, value in expected.items():
        np.testing.assert_allclose(terms[name], value, rtol=1e-6, err_msg=name)
    assert (expected["class"] > 0.0).all()
    assert not expected["points"].any()


def test_every_line_is_learned_as_often_as_it_is_repeated():
    """Three queries lie on each of two lines, which therefore cost nothing but their class."""
    along = np.linspace(-6.0, 6.0, 5)
    truth = MapLines.empty(3, 5)
    for i in (0, 1):
        truth.points[i, :, 0], truth.points[i, :, 1], truth.valid[i] = along, 4.0 * i, True
    targets = jax.vmap(lambda one: line_targets(one, 2, 3))(stack_examples([truth]))
    points = jnp.asarray(truth.points[[0, 1, 1, 0, 0, 1], :, :2])[None, None]
    config = MapTrV2LossConfig(many_repeats=3)
    run = jax.jit(lambda points: one_to_many_losses(LinePrediction(points, zeros), targets, HOST.bev_range, config))
    zeros = jnp.zeros((1, 1, 6, 3))
    terms, moved = run(points), run(points.at[0, 0, 0].add(1.0))
    np.testing.assert_allclose(terms["points"], 0.0, atol=1e-6)
    np.testing.assert_allclose(terms["direction"], 0.0, atol=1e-6)
    assert (moved["points"] > 1e-3).all()
