"""TopoNet and BEVFormer-DETR on cameras: padding, memory, dropout, losses."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.models.cases import CAMERA_DETR, CAMERA_TOPONET, make_camera_example, make_example
from tests.parameters import random_params
from tests.shared import assert_same
from tests.slow import with_slow
from tflane_jax.config import RunConfig, WorldData
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.errors import UserError
from tflane_jax.losses.bevformer_detr import BevFormerDetrLossConfig
from tflane_jax.models.parameters import split_statistics
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.scene import TrafficFlow, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.cameras.ring import CameraRigConfig

TASKS = {
    "toponet": LaneGraphTask(CAMERA_TOPONET),
    "detr": LaneGraphTask(CAMERA_DETR, BevFormerDetrLossConfig()),
}


class Fitted:
    """A task, random parameters, and its compiled prediction step and training step."""

    def __init__(self, task):
        self.task = task
        self.params = random_params(task.init, make_camera_example())
        self.step = jax.jit(task.step)

        @jax.jit
        def train(params, batch, key):
            learned, statistics = split_statistics(params)
            return jax.value_and_grad(lambda p: task.loss(p | statistics, batch, key), has_aux=True)(learned)

        self.train = train

    def predict(self, example):
        return self.step(self.params, self.task.start(), example)[1]


@functools.cache
def fit(name):
    return Fitted(TASKS[name])


@pytest.fixture(params=with_slow(TASKS, quick=["toponet"]))
def fitted(request):
    return fit(request.param)


@pytest.fixture
def toponet():
    """What both hosts share is compiled for training once: that takes most of these tests' time."""
    return fit("toponet")


def batch_of(*examples):
    return jax.tree.map(jnp.asarray, stack_examples(list(examples)))


def test_predicts_lanes_elements_and_both_topologies(fitted):
    answer = fitted.predict(make_camera_example())
    chex.assert_shape(answer.centerlines.points, (6, 11, 3))
    chex.assert_shape(answer.centerlines.successor_logits, (6, 6))
    chex.assert_shape(answer.elements.box, (5, 2, 2))
    chex.assert_shape(answer.elements.lane_logits, (6, 5))
    assert np.abs(np.asarray(answer.centerlines.points)[..., 0]).max() <= 51.2
    center = np.asarray(answer.elements.box).mean(1)
    assert ((center >= 0) & (center <= [96, 64])).all()
    other = fitted.predict(make_camera_example(1))
    for before, after in zip(jax.tree.leaves(answer), jax.tree.leaves(other), strict=True):
        assert not np.array_equal(before, after)


def soiled(example):
    """Fill invalid pixels, elements and lanes with garbage."""
    elements, lanes, image = example.traffic_elements, example.lanes, example.cameras.image.copy()
    image[1, 48:], image[1, :, 80:] = 255, 255
    box = np.where(elements.valid[:, None, None], elements.box, np.nan)
    attribute = np.where(elements.valid, elements.attribute, 10**6).astype(np.int32)
    relation = elements.lane | ~elements.valid | ~lanes.valid[:, None]
    points = np.where(lanes.valid[:, None, None], lanes.points, np.nan)
    return example.replace(
        cameras=example.cameras.replace(image=image),
        lanes=lanes.replace(points=points),
        traffic_elements=elements.replace(box=box, attribute=attribute, lane=relation),
    )


def test_padding_content_changes_no_output(fitted):
    assert_same(fitted.predict(make_camera_example(2)), fitted.predict(soiled(make_camera_example(2))))


@pytest.mark.slow
def test_padding_content_changes_no_gradient(toponet):
    key, clean, dirty = jax.random.key(0), make_camera_example(2), soiled(make_camera_example(2))
    results = [toponet.train(toponet.params, batch_of(e, make_camera_example(3)), key) for e in (clean, dirty)]
    assert_same(*results)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(results[0]))


def test_an_invalid_camera_changes_nothing(fitted):
    example = make_camera_example(4)
    for camera in (0, 1):
        valid = np.arange(2) != camera
        intrinsics = np.where(valid[:, None, None], example.cameras.intrinsics, np.nan)
        image = np.where(valid[:, None, None, None], example.cameras.image, 77).astype(np.uint8)
        silent = example.replace(cameras=example.cameras.replace(valid=valid))
        broken = example.replace(cameras=example.cameras.replace(valid=valid, intrinsics=intrinsics, image=image))
        answer = fitted.predict(silent)
        assert_same(answer, fitted.predict(broken))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(answer))


TERMS = {
    "class",
    "points",
    "successor",
    "element_class",
    "element_box",
    "element_iou",
    "element_lane",
    "cells",
    "matching/lanes",
    "matching/elements",
}


@pytest.mark.slow
def test_both_hosts_have_one_loss(fitted):
    batch = batch_of(make_camera_example(5), make_camera_example(6))
    (loss, report), gradient = jax.eval_shape(fitted.train, fitted.params, batch, jax.random.key(0))
    learned, statistics = split_statistics(fitted.params)
    assert loss.shape == ()
    assert set(split_statistics(report)[0]) == TERMS
    assert jax.tree.structure(split_statistics(report)[1]) == jax.tree.structure(statistics)
    assert jax.tree.map(jnp.shape, gradient) == jax.tree.map(jnp.shape, learned)


@pytest.mark.slow
def test_loss_reports_every_term_for_any_number_of_targets(toponet):
    for lanes, elements in ((4, 2), (0, 0), (1, 1)):
        batch = batch_of(*[make_camera_example(5, lanes=lanes, elements=elements)] * 2)
        (loss, report), gradient = toponet.train(toponet.params, batch, jax.random.key(0))
        learned, _ = split_statistics(report)
        assert set(learned) == TERMS
        assert float(learned["matching/elements"]) == elements
        assert np.isfinite(loss)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        assert float(learned["element_box"] > 0) == float(elements > 0)
    assert toponet.train._cache_size() == 1


@pytest.mark.slow
def test_every_parameter_of_a_part_learns(toponet):
    batch = batch_of(make_camera_example(6), make_camera_example(7))
    gradient = toponet.train(toponet.params, batch, jax.random.key(0))[1]
    silent = {
        jax.tree_util.keystr(path, simple=True, separator="/")
        for path, leaf in jax.tree.leaves_with_path(gradient)
        if not np.asarray(leaf).any()
    }
    # A frame on its own has no motion, and the first layer knows of no edges.
    graph = ("lane_lane/forward", "lane_lane/backward", "lane_element")
    expected = {"encoder/bev/motion/hidden/kernel"} | {f"layer_0/scene_graph/{name}/kernel" for name in graph}
    # Softmax is invariant to a constant added to all logits, up to rounding.
    assert {name for name in silent if not name.endswith("/key/bias")} == expected


@pytest.mark.slow
def test_dropout_follows_the_key(toponet):
    batch = batch_of(make_camera_example(8), make_camera_example(9))
    losses = [float(toponet.train(toponet.params, batch, jax.random.key(k))[0][0]) for k in (0, 0, 1)]
    assert losses[0] == losses[1] != losses[2]


@pytest.mark.slow
def test_a_stream_equals_the_scan_over_its_sequence(toponet):
    task, params = toponet.task, toponet.params
    frames = [make_camera_example(s).replace(has_previous=np.asarray(s not in (0, 2))) for s in range(4)]
    move = np.eye(4, dtype=np.float32)
    move[:2, 3] = 3.0, 0.4
    frames = [frame.replace(previous_from_ego=move) for frame in frames]
    memory, answers = task.start(), []
    for frame in frames:
        memory, answer = toponet.step(params, memory, frame)
        answers.append(answer)
    scan = jax.jit(lambda p, m, f: lax.scan(functools.partial(task.step, p), m, f))
    scanned = scan(params, task.start(), batch_of(*frames))
    assert_same(scanned, (memory, jax.tree.map(lambda *leaves: jnp.stack(leaves), *answers)))
    # The third frame begins a scene, so it forgets; the fourth remembers.
    assert_same(answers[2], toponet.predict(frames[2]))
    assert not np.array_equal(answers[3].centerlines.points, toponet.predict(frames[3]).centerlines.points)


def test_an_empty_scene_equals_no_traffic_flow(toponet):
    example = make_camera_example(10)
    absent = example.replace(traffic_flow=TrafficFlow.empty(*example.traffic_flow.valid.shape))
    answer = toponet.predict(absent)
    assert not np.array_equal(answer.centerlines.points, toponet.predict(example).centerlines.points)
    # Parameters of the temporal encoder have no effect.
    other = {**toponet.params, "temporal_encoder": jax.tree.map(lambda x: x + 1.0, toponet.params["temporal_encoder"])}
    assert_same(answer, toponet.step(other, toponet.task.start(), absent)[1])


@pytest.mark.slow
def test_mismatched_parts_are_errors():
    task, key = TASKS["toponet"], jax.random.key(0)
    with pytest.raises(UserError, match="choose data with cameras"):
        jax.eval_shape(task.init, key, make_example())
    with pytest.raises(UserError, match="None without an encoder of cameras"):
        TopoNetConfig(elements=CAMERA_TOPONET.elements).build()
    with pytest.raises(UserError, match=r"elements\.layers is 3: it must be decoder\.layers \(2\)"):
        dataclasses.replace(CAMERA_TOPONET, elements=dataclasses.replace(CAMERA_TOPONET.elements, layers=3)).build()
    with pytest.raises(UserError, match=r"decoder\.refine is 'iterative': it must be fixed"):
        dataclasses.replace(CAMERA_DETR, decoder=dataclasses.replace(CAMERA_DETR.decoder, refine="iterative")).build()
    unlabelled = batch_of(make_camera_example().replace(traffic_elements=None))
    with pytest.raises(UserError, match=r"set task\.model\.elements to None"):
        jax.eval_shape(task.loss, fit("toponet").params, unlabelled, key)


def test_a_camera_that_sees_too_many_cells_is_named_before_training():
    examples = stack_examples([make_camera_example()])
    config = RunConfig(task=TASKS["toponet"], data=WorldData(example=ExampleConfig(cameras=CameraRigConfig())))
    encoder = CAMERA_TOPONET.encoder
    tight = dataclasses.replace(encoder, bev=dataclasses.replace(encoder.bev, capacity=1))
    task = dataclasses.replace(config.task, model=dataclasses.replace(CAMERA_TOPONET, encoder=tight))
    config.task.check(config.data, examples)
    with pytest.raises(UserError, match="`capacity` of BevFormerConfig is 1"):
        task.check(config.data, examples)


def without_memory():
    encoder = CAMERA_TOPONET.encoder
    off = dataclasses.replace(encoder, bev=dataclasses.replace(encoder.bev, memory="off"))
    return LaneGraphTask(dataclasses.replace(CAMERA_TOPONET, encoder=off))


@pytest.mark.slow
def test_bev_memory_can_be_switched_off():
    """No frame leaves BEV features to the next, and the parameters are those of the host with memory."""
    task, example = without_memory(), make_camera_example()
    assert task.start().bev is None
    assert TASKS["toponet"].start().bev is not None
    params = jax.eval_shape(TASKS["toponet"].init, jax.random.key(0), example)
    following, _ = jax.eval_shape(task.step, params, task.start(), example)
    assert following.bev is None


@pytest.mark.slow
def test_without_bev_memory_every_frame_stands_alone(toponet):
    step = jax.jit(without_memory().step)
    first, second = (make_camera_example(seed) for seed in (0, 1))
    second = second.replace(has_previous=np.asarray(True))
    memory, _ = step(toponet.params, without_memory().start(), first)
    _, later = step(toponet.params, memory, second)
    alone = toponet.predict(second)
    np.testing.assert_allclose(later.centerlines.points, alone.centerlines.points, atol=1e-4)
