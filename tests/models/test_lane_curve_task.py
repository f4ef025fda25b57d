"""Networks of the LSTR family as tasks: padding, statistics, dropout, every encoder."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.images import HEIGHT, WIDTH, road_image, road_images, tiny_model, tiny_task
from tflane_jax.losses.lane_curve import LaneCurveLossConfig
from tflane_jax.models.graph_encoders import GcnEncoderConfig, GtnEncoderConfig, HanEncoderConfig
from tflane_jax.models.lstr import MEAN_BGR, STD_BGR, LaneCurveHeads, nearest, normalise, shrink
from tflane_jax.training.lane_curve import LaneCurveTask
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.state import init_state
from tflane_jax.training.step import make_update_step
from tflane_jax.training.task import STATISTICS

ENCODERS = {
    "transformer": None,
    "gtn": GtnEncoderConfig(layers=1, hidden=16),
    "gcn": GcnEncoderConfig(layers=1, hidden=16),
    "han": HanEncoderConfig(layers=1, hidden=16, semantic=8),
}


@pytest.fixture(scope="module", params=ENCODERS)
def fitted(request):
    """Return a task, its parameters moved off their initial values, and its compiled prediction."""
    task = tiny_task(ENCODERS[request.param])
    params = jax.jit(task.init)(jax.random.key(0), road_image(0))
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    leaves = [leaf + 0.05 * jnp.abs(jax.random.normal(key, leaf.shape)) for key, leaf in zip(keys, leaves, strict=True)]
    return task, jax.tree.unflatten(tree, leaves), jax.jit(task.predict)


def padded(example, fill):
    """Hide the right third of the image and fill it, and every point that is not there, with something."""
    valid = example.image_valid.copy()
    valid[:, WIDTH * 2 // 3 :] = False
    there = example.lines.point_valid & example.lines.valid[:, None]
    points = np.where(there[..., None], example.lines.points, np.nan if fill else 0.0)
    image = np.where(valid[..., None], example.image, fill).astype(np.uint8)
    return example.replace(image=image, image_valid=valid, lines=example.lines.replace(points=points))


def test_predicts_one_class_and_one_curve_for_each_query(fitted):
    _, params, predict = fitted
    answer = predict(params, road_image(0))
    assert answer.logits.shape == (5, 2)
    assert answer.curves.shape == (5, 8)
    # k'', f'', m'' and n' belong to the image.
    assert np.ptp(answer.curves[:, 2:6], axis=0).max() < 1e-6
    assert not np.array_equal(answer.logits, predict(params, road_image(1)).logits)


def test_what_stands_in_padding_changes_nothing(fitted):
    task, params, predict = fitted
    clean, soiled = (padded(road_image(0), fill) for fill in (0, 200))
    jax.tree.map(np.testing.assert_array_equal, predict(params, clean), predict(params, soiled))
    assert not np.array_equal(predict(params, clean).logits, predict(params, road_image(0)).logits)

    @jax.jit
    def step(batch):
        return jax.value_and_grad(lambda p: task.loss(p, batch, jax.random.key(2))[0])(params)

    both = (step(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), example)) for example in (clean, soiled))
    jax.tree.map(np.testing.assert_array_equal, *both)


def test_an_image_of_nothing_but_padding_stays_finite(fitted):
    task, params, predict = fitted
    nothing = road_image(0, lines=0).replace(image_valid=np.zeros((HEIGHT, WIDTH), bool))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(predict(params, nothing)))
    batch = jax.tree.map(lambda leaf: leaf[None], nothing)
    loss, gradient = jax.jit(jax.value_and_grad(lambda p: task.loss(p, batch, jax.random.key(2))[0]))(params)
    assert np.isfinite(loss)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_training_moves_everything_that_learns_and_the_statistics(fitted):
    task, _, _ = fitted
    optim = OptimConfig(lr=1e-2, warmup_steps=0, weight_decay=0.0)
    batch = jax.device_put(road_images(3))
    state = init_state(task, make_optimizer(optim, 10), jax.random.key(0), road_image(0))
    before = jax.tree.map(np.asarray, state.params)
    step, losses = make_update_step(task, optim, 10), []
    for _ in range(8):
        state, metrics = step(state, batch)
        losses.append(float(metrics["loss"]))
        assert STATISTICS not in "".join(metrics)
    assert losses[-1] < losses[0]
    still = [
        jax.tree_util.keystr(place, simple=True, separator="/")
        for (place, old), new in zip(jax.tree.leaves_with_path(before), jax.tree.leaves(state.params), strict=True)
        if np.array_equal(old, new)
    ]
    # The first decoder layer's queries are zeros, which have no values to attend to; so it is in LSTR.
    assert still == ["decoder_0/self_attention/value/kernel"]


def test_dropout_follows_its_key():
    task, batch = tiny_task(), road_images(2)
    params = jax.jit(task.init)(jax.random.key(0), road_image(0))
    loss = jax.jit(lambda key: task.loss(params, batch, key)[0])
    first, again, other = (float(loss(jax.random.key(seed))) for seed in (0, 0, 1))
    assert first == again
    assert first != other


def test_normalisation_reads_blue_first():
    image = np.zeros((1, 1, 3), np.uint8)
    image[..., 2] = 255
    out = np.asarray(normalise(image, np.ones((1, 1), bool)))[0, 0]
    expected = (np.array([1.0, 0.0, 0.0]) - MEAN_BGR) / STD_BGR
    np.testing.assert_allclose(out, expected, rtol=1e-6)


def test_padding_is_sampled_at_the_first_pixel_of_a_cell():
    mask = jnp.asarray(np.random.default_rng(0).random((360, 640)) < 0.5)
    np.testing.assert_array_equal(nearest(mask, 12, 20), mask[::30, ::32])
    assert nearest(mask[:1, :1], 1, 1).shape == (1, 1)


def test_anchored_heads_say_where_the_straight_part_crosses_two_rows():
    anchors, rng = (0.4, 0.9), np.random.default_rng(0)
    queries = jnp.asarray(rng.normal(size=(2, 3, 8)).astype(np.float32))
    heads = LaneCurveHeads(8, anchors)
    variables = heads.init(jax.random.key(0), queries)
    plain = LaneCurveHeads(8).apply(variables, queries)
    anchored = heads.apply(variables, queries)
    np.testing.assert_array_equal(anchored.logits, plain.logits)
    # alpha of a typical road is 0.38, give or take 0.05.
    np.testing.assert_allclose(anchored.curves[..., 0], 0.38 + 0.05 * plain.curves[..., 0], rtol=1e-5)
    b, offset = anchored.curves[..., 6], anchored.curves[..., 7]
    for i, (row, spread) in enumerate(zip(anchors, (0.1, 1.0), strict=True)):
        np.testing.assert_allclose(b * row - offset, spread * plain.curves[..., 6 + i], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("encoder", [None, GtnEncoderConfig(layers=1, hidden=16)])
def test_cells_are_learned_beside_the_curves(encoder):
    task = LaneCurveTask(tiny_model(encoder, cells=True))
    params = jax.jit(task.init)(jax.random.key(0), road_image(0))
    batch = road_images(2)
    (loss, terms), gradient = jax.jit(jax.value_and_grad(task.loss, has_aux=True))(params, batch, jax.random.key(0))
    assert terms["cells"] > 0
    assert np.abs(gradient["cell_head"]["kernel"]).max() > 0
    silent = dataclasses.replace(task, losses=LaneCurveLossConfig(cell_weight=0.0))
    rest, _ = jax.jit(silent.loss)(params, batch, jax.random.key(0))
    np.testing.assert_allclose(loss - terms["cells"], rest, rtol=1e-5)
    without = {name: value for name, value in params.items() if name != "cell_head"}
    answer, same = (jax.jit(LaneCurveTask(tiny_model(encoder, cells=flag)).predict)(p, road_image(0))
                    for flag, p in ((True, params), (False, without)))  # fmt: skip
    jax.tree.map(np.testing.assert_array_equal, answer, same)


def test_shrunk_images_are_means_of_blocks_and_valid_where_all_of_a_block_is():
    image = np.random.default_rng(0).normal(size=(4, 6, 3)).astype(np.float32)
    valid = np.ones((4, 6), bool)
    valid[1, 2] = False
    small, small_valid = shrink(jnp.asarray(image), jnp.asarray(valid), 2)
    np.testing.assert_allclose(small[1, 2], image[2:4, 4:6].mean((0, 1)), rtol=1e-6)
    np.testing.assert_array_equal(small_valid, [[True, False, True], [True, True, True]])
    with pytest.raises(ValueError, match="4 x 6 does not shrink by blocks of 5 x 5"):
        shrink(jnp.asarray(image), jnp.asarray(valid), 5)


@pytest.mark.parametrize("changes", [{"shrink": 2}, {"located": True}, {"anchors": (0.4, 1.0)}])
def test_options_predict_something_else(changes):
    answers = []
    for options in ({}, changes):
        task = LaneCurveTask(tiny_model(**options))
        params = jax.jit(task.init)(jax.random.key(0), road_image(0))
        answers.append(jax.jit(task.predict)(params, road_image(0)))
    assert not np.array_equal(answers[0].curves, answers[1].curves)
