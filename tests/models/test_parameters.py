"""Initial values of whole hosts: a published form of every kind of host can be initialised for training."""

import dataclasses

import jax
import numpy as np
import pytest
from flax.traverse_util import flatten_dict, unflatten_dict

from tests.models.cases import (
    CAMERA_DETR,
    CAMERA_TOPONET,
    ELEMENTS,
    LINES,
    SEGMENTS,
    SMALL_LINES,
    WITH_TRAFFIC,
    make_bucket_example,
    make_camera_example,
    make_example,
    make_line_example,
)
from tests.slow import with_slow
from tflane_jax.models.area_decoder import AreaDecoderConfig
from tflane_jax.models.parameters import with_xavier_layers
from tflane_jax.tasks.lane_graph import LaneGraphTask

BUCKET = dataclasses.replace(
    SEGMENTS,
    encoder=CAMERA_TOPONET.encoder,
    elements=ELEMENTS,
    decoder=dataclasses.replace(SEGMENTS.decoder, classes=1),
    areas=AreaDecoderConfig(dim=16, heads=2, layers=2, queries=5, points=22, hidden=16),
)
HOSTS = {
    "toponet": (CAMERA_TOPONET, make_camera_example),
    "bevformer_detr": (CAMERA_DETR, make_camera_example),
    "lanesegnet": (BUCKET, make_bucket_example),
    "maptr": (LINES, make_line_example),
}


@pytest.mark.parametrize("name", with_slow(HOSTS, quick=["toponet"]))
def test_every_host_starts_as_published(name):
    config, make = HOSTS[name]
    variables = [
        jax.eval_shape(LaneGraphTask(dataclasses.replace(config, initial=initial)).init, jax.random.key(0), make())
        for initial in ("lecun", "xavier")
    ]
    jax.tree.map(lambda a, b: np.testing.assert_equal((a.shape, a.dtype), (b.shape, b.dtype)), *variables)


@pytest.mark.parametrize("name", with_slow([*HOSTS, "traffic", "spread lines"], quick=["toponet", "traffic"]))
def test_parameters_and_statistics_are_float32_in_64_bit_mode_too(name):
    """Regression: cameras could not be initialised there, and own parameters of modules had 64 bits."""
    others = {"traffic": (WITH_TRAFFIC, make_example), "spread lines": (SMALL_LINES, make_line_example)}
    config, make = (HOSTS | others)[name]
    with jax.enable_x64(True):
        found = jax.eval_shape(LaneGraphTask(config).init, jax.random.key(0), make())
    wide = [path for path, leaf in jax.tree_util.tree_leaves_with_path(found) if leaf.dtype != np.float32]
    assert not wide, list(map(jax.tree_util.keystr, wide))


@pytest.mark.parametrize(
    ("path", "shape", "bound"),
    [
        ("layer_0/scene_graph/lane_lane/own/kernel", (40, 60), np.sqrt(6 / (40 + 60))),
        ("layer_1/scene_graph/lane_element/kernel", (13, 40, 60), np.sqrt(6 / (40 * 60 + 13 * 60))),
    ],
)
def test_the_scene_graph_starts_within_torchs_bounds(path, shape, bound):
    """torch.nn.init.xavier_uniform_: inputs are size(1), outputs size(0), each times the product of the axes behind.

    A matrix of TopoNet's graph is (inputs, outputs): for two axes the bound is the same either way.
    """
    params = with_xavier_layers(
        {"params": unflatten_dict({path: np.zeros(shape, np.float32)}, sep="/")}, jax.random.key(0)
    )
    drawn = np.asarray(flatten_dict(params["params"], sep="/")[path])
    assert 0.99 * bound < np.abs(drawn).max() <= bound
    assert abs(drawn.mean()) < 0.05 * bound
