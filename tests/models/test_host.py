"""Hosts with and without the TFM: padding, order and absent inputs change no bit."""

import dataclasses
from functools import cache, partial

import chex
import jax
import numpy as np
import pytest

from tests.models.cases import (
    BASELINE,
    LINES,
    SEGMENTS,
    SMALL_LINES,
    SMALL_SEGMENTS,
    WITH_TRAFFIC,
    make_line_example,
)
from tests.parameters import random_params
from tests.shared import assert_same
from tests.slow import with_slow
from tflane_jax.errors import UserError
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.scene import TrafficFlow, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

MODELS = {
    "baseline": BASELINE,
    "traffic": WITH_TRAFFIC,
    "every layer": dataclasses.replace(
        WITH_TRAFFIC,
        priors=PriorsConfig(
            traffic_flow=dataclasses.replace(WITH_TRAFFIC.priors.traffic_flow, insert="every_layer"),
        ),
    ),
    "fixed": dataclasses.replace(WITH_TRAFFIC, decoder=dataclasses.replace(WITH_TRAFFIC.decoder, refine="fixed")),
    "segments": SEGMENTS,
    "segments, traffic": SMALL_SEGMENTS,
    "lines": LINES,
    "lines, traffic": SMALL_LINES,
    "lines v2, traffic": MapTrV2Config(
        encoder=LINES.encoder, decoder=SMALL_LINES.decoder, priors=SMALL_LINES.priors, many=4, line_mask=True
    ),
}
WITH_PRIOR = [name for name, config in MODELS.items() if config.priors.traffic_flow is not None]
LOSSES = {
    LaneSegNetConfig: LaneSegNetLossConfig(),
    MapTrConfig: MapTrLossConfig(),
    MapTrV2Config: MapTrV2LossConfig(many_repeats=2),
}


def make_task(config):
    return LaneGraphTask(model=config, losses=LOSSES.get(type(config), TopoNetLossConfig()))


def predicted(task, params, example):
    """Return the lanes, lane segments or map lines."""
    answer = task.predict(params, example)
    return next(part for part in (answer.centerlines, answer.segments, answer.lines) if part is not None)


# The other models differ from these in one setting of the traffic, or are these without it.
QUICK = ("traffic", "segments, traffic")


@cache
def fit(name):
    """Return the task, parameters and a jitted predictor of a model."""
    task = make_task(MODELS[name])
    params = random_params(task.init, make_line_example(), spread=0.2)
    return task, params, jax.jit(partial(predicted, task))


@pytest.mark.parametrize("name", with_slow(MODELS, ["traffic"]))
def test_shapes_and_range(name):
    _, params, predict = fit(name)
    lanes = predict(params, make_line_example())
    if name.startswith("lines"):
        chex.assert_shape(lanes.points, (6, 5, 2))
        chex.assert_shape(lanes.logits, (6, 3))
    else:
        chex.assert_shape(lanes.points, (6, 11, 3))
        chex.assert_shape(lanes.successor_logits, (6, 6))
        assert ((np.asarray(lanes.scores) > 0) & (np.asarray(lanes.scores) < 1)).all()
    assert np.abs(np.asarray(lanes.points)[..., 0]).max() <= 51.2


@pytest.mark.parametrize("name", with_slow(MODELS, QUICK))
def test_padding_may_hold_nan(name):
    _, params, predict = fit(name)
    example = make_line_example(3, instances=6)
    flow = example.traffic_flow
    dirty = flow.replace(
        position=np.where(flow.valid[..., None], flow.position, np.nan),
        yaw=np.where(flow.valid, flow.yaw, np.nan),
        size=np.where(flow.valid.any(-1)[:, None], flow.size, np.nan),
        category=np.where(flow.valid.any(-1), flow.category, 10**6).astype(np.int32),
    )
    assert_same(predict(params, example), predict(params, example.replace(traffic_flow=dirty)))


@pytest.mark.parametrize("name", with_slow(WITH_PRIOR, quick=("traffic",)))
def test_an_empty_scene_equals_no_traffic_flow(name):
    _, params, predict = fit(name)
    example = make_line_example(4)
    absent = predict(params, example.replace(traffic_flow=None))
    assert_same(absent, predict(params, example.replace(traffic_flow=TrafficFlow.empty(16, 20))))
    # The parameters of the temporal encoder must have no effect in an empty scene.
    other = {**params, "temporal_encoder": jax.tree.map(lambda x: x + 1.0, params["temporal_encoder"])}
    assert_same(absent, predict(other, example.replace(traffic_flow=None)))
    assert not np.array_equal(absent.points, predict(params, example).points)


@pytest.mark.parametrize("name", with_slow(["baseline", "segments", "lines"], quick=["segments"]))
def test_baseline_does_not_depend_on_traffic(name):
    _, params, predict = fit(name)
    assert_same(predict(params, make_line_example(5)), predict(params, make_line_example(5).replace(traffic_flow=None)))


@pytest.mark.parametrize("name", with_slow(WITH_PRIOR, ["traffic"]))
def test_lanes_do_not_depend_on_the_order_of_instances(name):
    _, params, predict = fit(name)
    example = make_line_example(6)
    order = np.random.default_rng(0).permutation(16)
    shuffled = example.replace(traffic_flow=jax.tree.map(lambda x: x[order], example.traffic_flow))
    assert_same(predict(params, example), predict(params, shuffled))


@pytest.mark.parametrize("name", with_slow(MODELS, quick=("traffic",)))
def test_batch_is_a_vmap(name):
    task, params, predict = fit(name)
    examples = [make_line_example(s, instances=s) for s in (0, 3, 9)]
    batch = jax.tree.map(lambda *x: np.stack(x), *examples)
    together = jax.jit(jax.vmap(partial(predicted, task), in_axes=(None, 0)))(params, batch)
    for i, example in enumerate(examples):
        alone = predict(params, example)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a, b[i], rtol=2e-4, atol=2e-4), alone, together)


@pytest.mark.parametrize("name", with_slow(MODELS, quick=("traffic",)))
def test_loss_is_traced_once_and_its_gradient_is_finite(name):
    task, params, _ = fit(name)
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def step(params, batch):
        return jax.value_and_grad(lambda p: task.loss(p, batch, jax.random.key(0))[0])(params)

    for instances, lanes in ((9, 4), (0, 0), (1, 1)):
        batch = jax.tree.map(lambda x: np.stack([x, x]), make_line_example(1, instances, lanes, min(lanes, 1)))
        loss, gradient = step(params, batch)
        assert np.isfinite(loss)
        assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
    if "temporal_encoder" in params:
        batch = jax.tree.map(lambda x: np.stack([x, x]), make_line_example(1, instances=0))
        silent = step(params, batch)[1]["temporal_encoder"]
        assert all(not np.asarray(g).any() for g in jax.tree.leaves(silent))


@pytest.mark.parametrize("name", with_slow(QUICK, quick=["traffic"]))
def test_same_key_same_parameters(name):
    # Each task is traced anew. Equal programs give equal numbers: nothing needs to be compiled.
    inits = (jax.jit(make_task(MODELS[name]).init) for _ in range(2))
    first, again = (init.lower(jax.random.key(7), make_line_example()) for init in inits)
    assert first.as_text() == again.as_text()
    names = {"/".join(str(k.key) for k in path) for path, _ in jax.tree_util.tree_leaves_with_path(first.out_info)}
    assert not [n for n in names if "Dense_" in n or "Conv_" in n or "Norm_" in n]


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_initial_parameters_are_finite(name):
    params = jax.jit(make_task(MODELS[name]).init)(jax.random.key(7), make_line_example())
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))


def test_no_bev_is_an_error():
    task, params, _ = fit("baseline")
    with pytest.raises(UserError, match="bev is None"):
        task.predict(params, make_line_example().replace(bev=None))


def test_what_is_for_one_example_and_what_for_a_batch_is_said():
    task, params, _ = fit("baseline")
    example = make_line_example()
    batch = stack_examples([example, example])
    with pytest.raises(ValueError, match=r"expected one example .*of shape \(2, 4, 4\); jax\.vmap adds batches"):
        task.predict(params, batch)
    clips = LaneGraphTask(BASELINE, clip=3)
    for one, tried, shape in ((task, example, r"\(batch, 4, 4\)"), (clips, batch, r"\(batch, 3, 4, 4\)")):
        with pytest.raises(ValueError, match=rf"expected a batch \(previous_from_ego of shape {shape}\)"):
            one.loss(params, tried, jax.random.key(0))
