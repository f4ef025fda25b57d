"""Traffic flow written into the BEV features of every host."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import (
    BASELINE,
    CAMERA_TOPONET,
    LIFTED_LINES,
    WITH_TRAFFIC,
    make_camera_example,
    make_example,
)
from tests.parameters import random_params
from tests.shared import assert_same
from tflane_jax.errors import UserError
from tflane_jax.models.priors import PriorsConfig, bev_hook
from tflane_jax.models.raster_fusion import RasterFusion, TrafficRasterConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.priors.traffic_raster import CHANNELS, TrafficRaster
from tflane_jax.scene import TrafficFlow, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

RASTER = TrafficRasterConfig(hidden=8)
INTO_BEV = dataclasses.replace(WITH_TRAFFIC.priors.traffic_flow, insert="nowhere", bev=RASTER)
BOTH = dataclasses.replace(INTO_BEV, insert="before_decoder")


def with_flow(host, flow):
    return dataclasses.replace(host, priors=PriorsConfig(traffic_flow=flow))


def without_flow(example):
    return example.replace(traffic_flow=TrafficFlow.empty(16, 20))


def restricted(params, shapes):
    """Return the entries of `params` that `shapes` has."""
    return {k: restricted(params[k], v) if isinstance(v, dict) else params[k] for k, v in shapes.items()}


@pytest.mark.parametrize(
    ("host", "make"),
    [
        (BASELINE, make_example),
        pytest.param(CAMERA_TOPONET, make_camera_example, marks=pytest.mark.slow),
        pytest.param(LIFTED_LINES, make_camera_example, marks=pytest.mark.slow),
    ],
    ids=["evidence", "cameras", "lift"],
)
def test_absent_traffic_gives_the_host_without_the_prior(host, make):
    task, example = LaneGraphTask(with_flow(host, INTO_BEV)), make(0)
    params = random_params(task.init, example, spread=0.2)
    predict = jax.jit(task.predict)
    absent, present = predict(params, without_flow(example)), predict(params, example)
    points = [(answer.lines or answer.centerlines).points for answer in (absent, present)]
    assert not np.array_equal(*points)
    flow = example.traffic_flow
    garbage = flow.replace(position=np.full_like(flow.position, np.nan), valid=np.zeros_like(flow.valid))
    assert_same(absent, predict(params, example.replace(traffic_flow=garbage)))

    plain = LaneGraphTask(dataclasses.replace(host, priors=PriorsConfig()))
    rest = restricted(params, jax.eval_shape(plain.init, jax.random.key(0), example))
    assert_same(absent, jax.jit(plain.predict)(rest, example))


def test_a_new_fusion_changes_nothing():
    """The output layer starts at zero."""
    bev, raster = cells(0)
    fusion = RasterFusion(RASTER.hidden)
    fused, params = fusion.init_with_output(jax.random.key(0), bev, raster.features, raster.touched)
    np.testing.assert_array_equal(fused, bev)
    assert not np.asarray(params["params"]["output"]["kernel"]).any()


def test_only_cells_with_traffic_change():
    bev, raster = cells(1)
    fusion = RasterFusion(RASTER.hidden)
    arguments = bev, raster.features, raster.touched
    fused = fusion.apply(random_params(fusion.init, *arguments), *arguments)
    changed = (np.asarray(fused) != np.asarray(bev)).any(-1)
    np.testing.assert_array_equal(changed, raster.touched)


def cells(seed):
    """Return random features of cells and a raster that touches some."""
    rng = np.random.default_rng(seed)
    bev = jnp.asarray(rng.normal(size=(12, 6)), jnp.float32)
    touched = jnp.arange(12) % 3 == 0
    features = jnp.where(touched[:, None], jnp.asarray(rng.random((12, CHANNELS)), jnp.float32), 0.0)
    return bev, TrafficRaster(features, touched)


@pytest.mark.slow
def test_both_hooks_read_the_traffic():
    """Without the projection the host is that of the TFM alone, and with it, it is not."""
    task, example = LaneGraphTask(with_flow(BASELINE, BOTH)), make_example(1)
    params = random_params(task.init, example, spread=0.2)
    zero = jax.tree.map(jnp.zeros_like, params["encoder"]["traffic_flow_0"]["output"])
    inner = {**params["encoder"]["traffic_flow_0"], "output": zero}
    silent = {**params, "encoder": {**params["encoder"], "traffic_flow_0": inner}}
    plain = LaneGraphTask(WITH_TRAFFIC)
    rest = restricted(params, jax.eval_shape(plain.init, jax.random.key(0), example))
    predict = jax.jit(task.predict)
    without = predict(silent, example)
    assert_same(without, jax.jit(plain.predict)(rest, example))
    assert not np.array_equal(without.centerlines.points, predict(params, example).centerlines.points)


@pytest.mark.parametrize(("layers", "count"), [("first", 1), ("all", 2)])
def test_layers(layers, count):
    encoder = dataclasses.replace(BASELINE.encoder, dilations=(1, 1))
    flow = dataclasses.replace(INTO_BEV, bev=dataclasses.replace(RASTER, layers=layers))
    task = LaneGraphTask(with_flow(dataclasses.replace(BASELINE, encoder=encoder), flow))
    params = jax.eval_shape(task.init, jax.random.key(0), make_example(0))
    assert sum(name.startswith("traffic_flow_") for name in params["encoder"]) == count
    assert "temporal_encoder" not in params
    assert not any(name.startswith("spatial_encoder") for name in params)


@pytest.mark.slow
def test_training_reaches_the_parameters():
    task = LaneGraphTask(with_flow(BASELINE, BOTH))
    examples = [make_example(0), without_flow(make_example(1))]
    batch = jax.tree.map(jnp.asarray, stack_examples(examples))
    params = random_params(task.init, examples[0], spread=0.2)
    gradient = jax.jit(jax.grad(lambda p: task.loss(p, batch, jax.random.key(0))[0]))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    for name in ("hidden", "output"):
        assert np.abs(gradient["encoder"]["traffic_flow_0"][name]["kernel"]).max() > 0


def test_without_the_setting_there_is_no_hook():
    for flow, hooked in ((WITH_TRAFFIC.priors.traffic_flow, False), (INTO_BEV, True)):
        priors = with_flow(BASELINE, flow).build_priors()
        assert priors["traffic_flow"].fuses_into_bev() is hooked
        assert (bev_hook(priors, {}, BASELINE.spec) is not None) is hooked


def test_traffic_that_enters_nowhere_is_refused():
    with pytest.raises(UserError, match=r"^insert is 'nowhere'.*enters nowhere"):
        TrafficFlowConfig(insert="nowhere").build(BASELINE.spec)
