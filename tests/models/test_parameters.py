"""Initial values of whole hosts: a published form of every kind of host can be initialised for training."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import (
    CAMERA_DETR,
    CAMERA_TOPONET,
    ELEMENTS,
    LINES,
    SEGMENTS,
    make_bucket_example,
    make_camera_example,
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


def test_matrices_of_classes_start_as_in_pytorch():
    """torch.nn.init.xavier_uniform_ of (K, in, out): fan in is in x out, fan out is K x out."""
    zeros = {"layer_0": {"scene_graph": {"lane_element": {"kernel": jnp.zeros((13, 24, 40))}}}}
    drawn = with_xavier_layers({"params": zeros}, jax.random.key(0))["params"]
    kernel = np.asarray(drawn["layer_0"]["scene_graph"]["lane_element"]["kernel"])
    bound = np.sqrt(6.0 / (24 * 40 + 13 * 40))
    assert 0.99 * bound < np.abs(kernel).max() <= bound
