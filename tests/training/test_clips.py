"""Training on clips and evaluating streams: memory goes from frame to frame and changes the prediction."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import BASELINE, CAMERA_TOPONET, make_camera_example
from tests.models.test_marker_fusion import CONFIG, observed, seeing
from tests.parameters import random_params
from tflane_jax.datasets.clips import as_clips
from tflane_jax.errors import UserError
from tflane_jax.evaluation.lane_graph import Sightings, evaluate_lanes
from tflane_jax.evaluation.predict import predict_examples, predictions
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.scene import shapes_of, stack_examples
from tflane_jax.summary import parameter_counts, shapes_of_params, training_program
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop_convolutions import with_fast_convolutions
from tflane_jax.training.schedule import OptimConfig

ALONE = LaneGraphTask(replace(BASELINE, priors=replace(BASELINE.priors, markers=CONFIG)))
CLIPS = replace(ALONE, clip=3)


def scenes(count=2, length=3, sight=(True, False, False)):
    """Return frames of some scenes in order, some of them with visible markers."""
    return stack_examples(
        [
            seeing(observed(seed=s, valid=sight[i % len(sight)]), 10 * s + i, has_previous=np.asarray(i > 0))
            for s in range(count)
            for i in range(length)
        ]
    )


@pytest.fixture(scope="module")
def params():
    return random_params(ALONE.init, seeing(observed()))


def test_clips_keep_the_order_and_stay_within_scenes():
    frames = scenes()
    cut = as_clips(frames, 3)
    assert cut.lanes.points.shape == (2, 3, *frames.lanes.points.shape[1:])
    np.testing.assert_array_equal(cut.bev[1, 2], frames.bev[5])
    for length in (2, 4):
        with pytest.raises(UserError, match="do not split into clips"):
            as_clips(frames, length)
    as_clips(scenes(length=4), 2)


@pytest.mark.slow
def test_the_loss_of_clips_equals_that_of_their_frames_with_memory(params):
    key = jax.random.key(0)
    unseen = jax.tree.map(jnp.asarray, scenes(sight=(False,)))
    of_clips, of_frames = jax.jit(CLIPS.loss), jax.jit(ALONE.loss)
    # Without a marker the memory stays empty.
    together, terms = of_clips(params, as_clips(unseen, 3), key)
    apart, each = of_frames(params, unseen, key)
    np.testing.assert_allclose(together, apart, rtol=1e-5)
    assert terms.keys() == each.keys()
    seen = jax.tree.map(jnp.asarray, scenes())
    assert abs(float(of_clips(params, as_clips(seen, 3), key)[0] - of_frames(params, seen, key)[0])) > 1e-4


@pytest.mark.slow
def test_gradients_reach_the_encoder_through_memory(params):
    # Nothing but the memory shows the last two frames a marker; the first frame's loss is taken away.
    examples = scenes(count=1)
    examples.lanes.valid[0] = False
    batch = jax.tree.map(jnp.asarray, as_clips(examples, 3))
    gradient = jax.jit(jax.grad(lambda p: CLIPS.loss(p, batch, jax.random.key(0))[0]))(params)
    assert np.abs(gradient["marker_tokens"]["lines"]["out"]["kernel"]).max() > 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
@pytest.mark.parametrize("batch_size", [1, 4])
def test_evaluation_streams_through_scenes(params, batch_size):
    frames = scenes()
    step, memory, expected = jax.jit(ALONE.step), ALONE.start(), []
    for i in range(6):
        memory, answer = step(params, memory, jax.tree.map(lambda leaf, i=i: leaf[i], frames))
        expected.append(answer.centerlines.points)
    found = [answer.centerlines.points for _, answer in predictions(CLIPS, params, frames, batch_size)]
    np.testing.assert_array_equal(np.concatenate(found), np.stack(expected))
    alone = [answer.centerlines.points for _, answer in predictions(ALONE, params, frames, batch_size)]
    differs = [not np.allclose(a, b, atol=1e-3) for a, b in zip(np.concatenate(alone), expected, strict=True)]
    assert differs == [False, True, True] * 2


@pytest.mark.slow
@pytest.mark.parametrize("batch_size", [None, 4])
def test_single_frames_of_a_stream_are_drawn_with_memory(params, batch_size):
    frames = scenes()
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], frames) for i in range(6)]
    (found,) = [answer.centerlines.points for _, answer in predictions(CLIPS, params, frames, 6)]
    dataset, parts = SimpleNamespace(example=each.__getitem__), CLIPS.parts if batch_size else ()
    examples, answer = predict_examples(CLIPS, params, dataset, [5, 1, 3], batch_size=batch_size, parts=parts)
    np.testing.assert_array_equal(answer.centerlines.points, found[[5, 1, 3]])
    np.testing.assert_array_equal(examples.bev, frames.bev[[5, 1, 3]])
    assert answer.elements is None


def test_a_summary_of_clips_needs_one_frame(params):
    counts = parameter_counts(shapes_of_params(CLIPS, shapes_of(seeing(observed()))))
    assert sum(counts.values()) == sum(leaf.size for leaf in jax.tree.leaves(params))


def test_a_clip_initialises_as_a_frame(params):
    clip = jax.tree.map(lambda leaf: leaf[0], as_clips(scenes(), 3))
    shapes = jax.eval_shape(CLIPS.init, jax.random.key(0), clip)
    assert jax.tree.map(lambda leaf: leaf.shape, shapes) == jax.tree.map(lambda leaf: leaf.shape, params)


@pytest.mark.slow
def test_the_summary_of_a_task_of_clips_counts_whole_clips():
    shapes = shapes_of(seeing(observed()))
    alone, together = (training_program(task, shapes, 2, OptimConfig(), compiled=False) for task in (ALONE, CLIPS))
    # A loop's body may be counted once.
    assert together.gflop > 0.9 * alone.gflop


@pytest.mark.slow
def test_cameras_are_trained_on_clips_too():
    """Batch statistics and the BEV memory go from frame to frame; shapes alone show that they fit."""
    task = LaneGraphTask(CAMERA_TOPONET, clip=2)
    clip = stack_examples([make_camera_example(i).replace(has_previous=np.asarray(i > 0)) for i in range(2)])
    params = jax.eval_shape(task.init, jax.random.key(0), clip)
    batch = jax.tree.map(jnp.asarray, stack_examples([clip] * 3))
    loss, terms = jax.eval_shape(task.loss, params, batch, jax.random.key(0))
    assert loss.shape == ()
    same = jax.tree.map(lambda a, b: a.shape == b.shape, terms["batch_stats"], params["batch_stats"])
    assert all(jax.tree.leaves(same))


CAMERA_CLIPS = LaneGraphTask(CAMERA_TOPONET, clip=3)


@pytest.mark.slow
def test_a_scan_over_time_gives_the_losses_and_gradients_of_the_unrolled_form():
    clip = stack_examples([make_camera_example(i).replace(has_previous=np.asarray(i > 0)) for i in range(3)])
    batch, params = stack_examples([clip]), random_params(CAMERA_CLIPS.init, clip, spread=0.1)
    results = []
    for task in (CAMERA_CLIPS, replace(CAMERA_CLIPS, time="scan")):
        of = with_fast_convolutions(jax.value_and_grad(task.loss, has_aux=True))
        results.append(jax.jit(of)(params, batch, jax.random.key(0)))
    ((loss, terms), gradient), ((scanned, same), again) = results
    np.testing.assert_allclose(scanned, loss, rtol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-6), terms, same)
    size = np.sqrt(sum(np.square(leaf).sum() for leaf in jax.tree.leaves(gradient)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-3, atol=1e-5 * size), gradient, again)


@pytest.mark.slow
def test_operations_of_a_scan_are_those_of_all_frames():
    example, optim = shapes_of(make_camera_example(0)), OptimConfig(warmup_steps=2000)
    tasks = replace(CAMERA_CLIPS, clip=2), replace(CAMERA_CLIPS, clip=2, time="scan")
    unrolled, scan = (training_program(task, example, 1, optim, compiled=False).gflop for task in tasks)
    assert scan == pytest.approx(unrolled, rel=1e-6)


def test_single_frames_do_not_loop_over_time():
    assert replace(CAMERA_CLIPS, time="scan").loops
    assert not CAMERA_CLIPS.loops
    assert not replace(CAMERA_CLIPS, clip=1, time="scan").loops


def test_a_scan_without_bev_memory_gives_the_losses_of_all_frames_at_once(params):
    batch = as_clips(scenes(), 3)
    results = [
        jax.jit(jax.value_and_grad(task.loss, has_aux=True))(params, batch, jax.random.key(0))
        for task in (CLIPS, replace(CLIPS, time="scan"))
    ]
    ((loss, terms), gradient), ((scanned, same), again) = results
    np.testing.assert_allclose(scanned, loss, rtol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-6), terms, same)
    size = np.sqrt(sum(np.square(leaf).sum() for leaf in jax.tree.leaves(gradient)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-3, atol=1e-5 * size), gradient, again)


@pytest.mark.slow
def test_frames_are_grouped_by_marker_visibility(params):
    sightings = Sightings()
    frames = [(False, False), (True, True), (False, True), (True, True), (False, True), (False, False), (True, False)]
    told = [sightings.next(seen, has_previous) for seen, has_previous in frames]
    assert told == ["before", "seen", "gap", "seen", "gap", "before", "seen"]
    metrics = evaluate_lanes(CLIPS, params, scenes(), EvaluationConfig(batch_size=4)).compute()
    assert [metrics[group]["frames"] for group in ("all", "seen", "gap", "before")] == [6, 2, 4, 0]
    lanes = [metrics[group]["lanes"] for group in ("seen", "gap", "before")]
    assert sum(lanes) == metrics["all"]["lanes"]
    without = scenes().replace(markers=None)
    assert "seen" not in evaluate_lanes(CLIPS, params, without, EvaluationConfig(batch_size=4)).compute()
