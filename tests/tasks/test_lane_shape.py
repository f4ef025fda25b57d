"""Networks of the LSTR family as tasks: padding, statistics, dropout, every encoder."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.images import HEIGHT, WIDTH, road_image, road_images, tiny_model, tiny_task
from tests.parameters import random_params
from tests.slow import with_slow
from tflane_jax.config import FrontViewData
from tflane_jax.datasets.lane_rows import LabelledImages
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.files.tusimple import RowLanes
from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.losses.lane_shape import LaneShapeLossConfig
from tflane_jax.models.graph_encoders import GcnEncoderConfig, GtnEncoderConfig, HanEncoderConfig
from tflane_jax.models.lstr import MEAN_BGR, STD_BGR, LaneShapeHeads, nearest, normalise, shrink
from tflane_jax.tasks import lane_shape
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.state import init_state, state_of
from tflane_jax.training.step import make_update_step

ENCODERS = {
    "transformer": None,
    "gtn": GtnEncoderConfig(layers=1, hidden=16),
    "gcn": GcnEncoderConfig(layers=1, hidden=16),
    "han": HanEncoderConfig(layers=1, hidden=16, semantic=8),
}


class Fitted:
    """A task with random parameters and its compiled programs: start, prediction, one update."""

    def __init__(self, task):
        optim = OptimConfig(lr=1e-2, warmup_steps=0, weight_decay=0.0)
        self.params = random_params(task.init, road_image(0))
        self.predict = jax.jit(task.predict)
        self.optimizer = make_optimizer(optim, 10)
        self.init = jax.jit(lambda key, example: init_state(task, self.optimizer, key, example))
        # The loss and its gradient take most of these tests' time: all of them read them off this one program.
        self.update = make_update_step(task, optim, 10)

    def start(self, key=0):
        """Return a fresh state with buffers of its own, because an update donates them."""
        return self.init(jax.random.key(key), road_image(0))

    def updated(self, batch, key=0):
        """Return the state and the metrics after one update of the random parameters."""
        return self.update(state_of(self.params, self.optimizer, jax.random.key(key)), batch)


@cache
def fit(name):
    return Fitted(tiny_task(ENCODERS[name]))


@pytest.fixture(params=with_slow(ENCODERS, quick=("gtn",)))
def fitted(request):
    return fit(request.param)


def padded(example, fill):
    """Mark the right third of the image as invalid; fill it and all invalid points with a value."""
    valid = example.image_valid.copy()
    valid[:, WIDTH * 2 // 3 :] = False
    there = example.lines.point_valid & example.lines.valid[:, None]
    points = np.where(there[..., None], example.lines.points, np.nan if fill else 0.0)
    image = np.where(valid[..., None], example.image, fill).astype(np.uint8)
    return example.replace(image=image, image_valid=valid, lines=example.lines.replace(points=points))


def pair(example):
    """Return a batch that holds an example twice."""
    return jax.tree.map(lambda leaf: np.stack([leaf, leaf]), example)


def numbers(tree):
    return jax.device_get(jax.tree.map(lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf, tree))


def is_key(leaf):
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def test_predicts_one_class_and_one_curve_for_each_query(fitted):
    answer = fitted.predict(fitted.params, road_image(0)).curves
    assert answer.logits.shape == (5, 2)
    assert answer.curves.shape == (5, 8)
    # k'', f'', m'' and n' belong to the image.
    assert np.ptp(answer.curves[:, 2:6], axis=0).max() < 1e-6
    assert not np.array_equal(answer.logits, fitted.predict(fitted.params, road_image(1)).curves.logits)


@pytest.mark.slow
def test_padding_content_changes_nothing(fitted):
    clean, soiled = (padded(road_image(0), fill) for fill in (0, 200))
    answer = fitted.predict(fitted.params, clean)
    jax.tree.map(np.testing.assert_array_equal, answer, fitted.predict(fitted.params, soiled))
    assert not np.array_equal(answer.curves.logits, fitted.predict(fitted.params, road_image(0)).curves.logits)

    # The optimizer's first moment is the gradient, scaled.
    (state, metrics), other = (fitted.updated(pair(example)) for example in (clean, soiled))
    assert metrics["finite"]
    jax.tree.map(np.testing.assert_array_equal, (numbers(state), metrics), (numbers(other[0]), other[1]))


def test_an_image_of_nothing_but_padding_stays_finite(fitted):
    nothing = road_image(0, lines=0).replace(image_valid=np.zeros((HEIGHT, WIDTH), bool))
    answer = fitted.predict(fitted.params, nothing)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(answer))
    state, metrics = fitted.updated(pair(nothing))
    assert metrics["finite"]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((numbers(state), metrics)))


@pytest.mark.slow
def test_training_changes_every_learned_parameter_and_the_statistics(fitted):
    batch = jax.device_put(road_images(2))
    state, losses = fitted.start(), []
    before = jax.tree.map(np.asarray, state.params)
    for _ in range(8):
        state, metrics = fitted.update(state, batch)
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


@pytest.mark.slow
def test_dropout_follows_its_key():
    batch = road_images(2)
    first, again, other = (float(fit("transformer").updated(batch, seed)[1]["loss"]) for seed in (0, 0, 1))
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


def test_anchored_heads_predict_where_the_straight_part_crosses_two_rows():
    anchors, rng = (0.4, 0.9), np.random.default_rng(0)
    queries = jnp.asarray(rng.normal(size=(2, 3, 8)).astype(np.float32))
    heads = LaneShapeHeads(8, anchors)
    variables = heads.init(jax.random.key(0), queries)
    plain = LaneShapeHeads(8).apply(variables, queries)
    anchored = heads.apply(variables, queries)
    np.testing.assert_array_equal(anchored.logits, plain.logits)
    # alpha of a typical road is 0.38, give or take 0.05.
    np.testing.assert_allclose(anchored.curves[..., 0], 0.38 + 0.05 * plain.curves[..., 0], rtol=1e-5)
    b, offset = anchored.curves[..., 6], anchored.curves[..., 7]
    for i, (row, spread) in enumerate(zip(anchors, (0.1, 1.0), strict=True)):
        np.testing.assert_allclose(b * row - offset, spread * plain.curves[..., 6 + i], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("encoder", [None, GtnEncoderConfig(layers=1, hidden=16)], ids=["none", "gtn"])
@pytest.mark.slow
def test_cells_are_learned_beside_the_curves(encoder):
    task = LaneShapeTask(tiny_model(encoder, cells=True))
    silent = dataclasses.replace(task, losses=LaneShapeLossConfig(cell_weight=0.0))
    without = LaneShapeTask(tiny_model(encoder))
    params = random_params(task.init, road_image(0))

    @jax.jit
    def run(params, example, batch, key):
        rest = {name: value for name, value in params.items() if name != "cell_head"}
        answers = task.predict(params, example), without.predict(rest, example)
        return jax.value_and_grad(task.loss, has_aux=True)(params, batch, key), silent.loss(params, batch, key), answers

    ((loss, terms), gradient), (rest, _), answers = run(params, road_image(0), road_images(2), jax.random.key(0))
    assert terms["cells"] > 0
    assert np.abs(gradient["cell_head"]["kernel"]).max() > 0
    np.testing.assert_allclose(loss - terms["cells"], rest, rtol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, *answers)


def test_shrunk_images_are_means_of_blocks_and_valid_where_all_of_a_block_is():
    image = np.random.default_rng(0).normal(size=(4, 6, 3)).astype(np.float32)
    valid = np.ones((4, 6), bool)
    valid[1, 2] = False
    small, small_valid = shrink(jnp.asarray(image), jnp.asarray(valid), 2)
    np.testing.assert_allclose(small[1, 2], image[2:4, 4:6].mean((0, 1)), rtol=1e-6)
    np.testing.assert_array_equal(small_valid, [[True, False, True], [True, True, True]])
    with pytest.raises(ValueError, match="4 x 6 does not shrink by blocks of 5 x 5"):
        shrink(jnp.asarray(image), jnp.asarray(valid), 5)


@cache
def curves_of(**options):
    """Return the curves that a network with some options predicts; parameters of one name have the same values."""
    task = LaneShapeTask(tiny_model(**options))
    return jax.jit(task.predict)(random_params(task.init, road_image(0)), road_image(0)).curves


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{"shrink": 2}, {"located": True}, {"anchors": (0.4, 1.0)}])
def test_options_change_the_prediction(changes):
    assert not np.array_equal(curves_of().curves, curves_of(**changes).curves)


def test_images_that_do_not_shrink_by_whole_blocks_are_named():
    data = FrontViewData()
    LaneShapeTask(dataclasses.replace(tiny_model(), shrink=8)).check_settings(data)
    with pytest.raises(UserError, match=r"task\.model\.shrink is 7: it must be a divisor of 360 and 640"):
        LaneShapeTask(dataclasses.replace(tiny_model(), shrink=7)).check_settings(data)


@pytest.mark.slow
def test_the_validation_loss_does_not_depend_on_the_batch_size():
    """Images with many and few lanes, and one without any, whose lanes a loss of a batch would weigh together."""
    images = road_images(5)
    valid = np.asarray(images.lines.valid).copy()
    valid[1, 1:], valid[4] = False, False
    images = images.replace(lines=images.lines.replace(valid=valid))
    task, lines = tiny_task(), images.lines
    answer = jax.vmap(task.predict, (None, 0))(fit("transformer").params, images)
    together = lane_shape._losses(task, answer.curves, lines)
    assert together.shape == (5,)
    assert np.isfinite(together).all()
    for i in range(5):
        one = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], (answer.curves, lines))
        np.testing.assert_allclose(lane_shape._losses(task, *one)[0], together[i], rtol=1e-5)


def test_groups_of_images_are_measured_like_all_images(monkeypatch):
    """An oracle of the first lane of every image: the scores of a group are those of its images alone."""
    images, task, rows = road_images(4), tiny_task(), np.arange(160.0, 720.0, 10.0)
    truth = [RowLanes(np.arange(1.0, i + 2)[:, None] * 100.0 + 0.1 * rows, rows) for i in range(4)]
    found = [RowLanes(lanes.x[:1], rows) for lanes in truth]
    by_truth = dict(zip(map(id, truth), found, strict=True))
    monkeypatch.setattr(lane_shape, "found_lanes", lambda prediction, lanes: by_truth[id(lanes)])
    params, config = fit("transformer").params, EvaluationConfig(batch_size=3)
    weather = ("rain", "clear", "clear", "rain")

    def evaluated(which, **groups):
        chosen = jax.tree.map(lambda leaf: leaf[np.array(which)], images)
        return task.evaluate(params, LabelledImages(chosen, [truth[i] for i in which]), config, **groups).groups

    every = evaluated(range(4), frame_groups=weather)
    assert list(every) == ["all", "clear", "rain"]
    for group, which in (("clear", [1, 2]), ("rain", [0, 3])):
        alone = evaluated(which)["all"]
        assert every[group] == {name: alone[name] for name in ("frames", "Accuracy", "FP", "FN")}
    assert evaluated(range(4)) == {"all": every["all"]}


def test_a_loss_of_one_image_is_refused():
    with pytest.raises(ValueError, match=r"expected a batch \(image of shape \(batch, h, w, 3\)\)"):
        tiny_task().loss({}, road_image(0), jax.random.key(0))
