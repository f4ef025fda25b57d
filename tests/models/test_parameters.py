"""Initial values of whole hosts: a published form of every kind of host can be initialised for training."""

import dataclasses
import functools

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
from tflane_jax.models import host
from tflane_jax.models.area_decoder import AreaDecoderConfig
from tflane_jax.models.parameters import with_torch_biases, with_torch_heads, with_xavier_layers
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


@functools.cache
def started(name: str, draw=with_torch_heads) -> dict[str, np.ndarray]:
    """Return the published start of a part of a host, by default its heads, over parameters that are 1 everywhere."""
    config, make = HOSTS[name]
    shapes = jax.eval_shape(LaneGraphTask(config).init, jax.random.key(0), make())
    ones = jax.tree.map(lambda leaf: np.ones(leaf.shape, np.float32), dict(shapes))
    drawn = draw({"params": ones}, jax.random.key(1))["params"]
    return {path: np.asarray(leaf) for path, leaf in flatten_dict(drawn, sep="/").items()}


FEED_FORWARD = {
    "toponet": [
        *(f"layer_{i}/scene_graph/{name}" for i in range(2) for name in ("expand", "contract", "downsample")),
        *(f"elements/decoder_{i}/feed_forward/{name}" for i in range(2) for name in ("expand", "contract")),
        *(f"elements/encoder_0/feed_forward/{name}" for name in ("expand", "contract")),
        *(f"encoder/bev/encoder/layer_0/{name}" for name in ("expand", "contract")),
        *(f"encoder/bev/motion/{name}" for name in ("hidden", "out")),
    ],
    "maptr": [f"layer_{i}/feed_forward/{name}" for i in range(2) for name in ("expand", "contract")],
}


@pytest.mark.parametrize("name", with_slow(FEED_FORWARD, quick=["toponet"]))
def test_published_feed_forward_biases_start_as_in_torch(name):
    """torch.nn.Linear: within 1 / sqrt(inputs). Biases of attention are set to 0 by the published code, and stay."""
    params = started(name, with_torch_biases)
    assert {path for path, leaf in params.items() if np.any(leaf != 1.0)} == {f"{x}/bias" for x in FEED_FORWARD[name]}
    for module in FEED_FORWARD[name]:
        bound = len(params[f"{module}/kernel"]) ** -0.5
        assert 0.5 * bound < np.abs(params[f"{module}/bias"]).max() <= bound, module


def test_biases_of_the_depth_network_start_as_in_torch():
    part = "encoder/lift/depth_net"
    given = {
        f"{part}/reduce/kernel": np.zeros((3, 3, 20, 400), np.float32),
        f"{part}/reduce/bias": np.zeros(400, np.float32),
        f"{part}/reduce_norm/scale": np.zeros(400, np.float32),
        f"{part}/reduce_norm/bias": np.zeros(400, np.float32),
        f"{part}/depth_mlp/linear_0/kernel": np.zeros((22, 400), np.float32),
        f"{part}/depth_mlp/linear_0/bias": np.zeros(400, np.float32),
    }
    drawn = with_torch_biases({"params": unflatten_dict(given, sep="/")}, jax.random.key(0))
    largest = {name: np.abs(leaf).max() for name, leaf in flatten_dict(drawn["params"], sep="/").items()}
    bounds = {f"{part}/reduce/bias": 180**-0.5, f"{part}/depth_mlp/linear_0/bias": 22**-0.5}
    assert {name for name, found in largest.items() if found} == set(bounds)
    for name, bound in bounds.items():
        assert 0.97 * bound < largest[name] <= bound


RELATION = [
    *(f"{side}/linear_{i}" for side in ("mlp_first", "mlp_second") for i in range(3)),
    *("pair_first", "pair_second", "pair_hidden", "pair_out"),
]
ELEMENT_HEADS = [
    f"elements/{name}" for i in range(2) for name in (f"class_{i}", *(f"box_{i}/hidden/linear_{k}" for k in range(2)))
]
LANE_HEADS = ["class_0", "class_1", "class_out", "points/linear_0", "points/linear_1", "points/linear_2"]
DRAWN = {
    "toponet": [
        *(f"heads_{i}/{name}" for i in range(2) for name in LANE_HEADS),
        *(f"heads_{i}/{edge}/{name}" for i in range(2) for edge in ("successor", "element_lane") for name in RELATION),
        *(f"element_embedding_{i}/{name}" for i in range(2) for name in ("expand", "contract")),
        *ELEMENT_HEADS,
    ],
    "bevformer_detr": [
        *(f"heads_{i}/{name}" for i in range(2) for name in LANE_HEADS),
        *(f"heads_1/{edge}/{name}" for edge in ("successor", "element_lane") for name in RELATION),
        *ELEMENT_HEADS,
    ],
    "lanesegnet": [*(f"{edge}/{name}" for edge in ("successor", "element_lane") for name in RELATION), *ELEMENT_HEADS],
    "maptr": [],
}


@pytest.mark.parametrize("name", with_slow(DRAWN, quick=["toponet"]))
def test_published_heads_start_as_in_torch(name):
    """torch.nn.Linear: kernel and bias within 1 / sqrt(inputs); the focal class biases and the boxes' last layer stay.

    The heads of LaneSegNet and MapTR draw such values themselves.
    """
    params = started(name)
    biases = ("heads_0/class_out", "heads_1/class_out", "elements/class_0", "elements/class_1")
    wanted = {f"{module}/kernel" for module in DRAWN[name]}
    wanted |= {f"{module}/bias" for module in DRAWN[name] if module not in biases and "pair_second" not in module}
    assert {path for path, leaf in params.items() if np.any(leaf != 1.0)} == wanted
    for path in wanted:
        inputs = len(params[path.rpartition("/")[0] + "/kernel"]) * (
            2 if "/pair_" in path and "hidden" not in path else 1
        )
        if "pair_out" in path:
            inputs //= 2
        bound = inputs**-0.5
        assert np.abs(params[path]).max() <= bound, path
        if params[path].size > 30:
            assert np.abs(params[path]).max() > 0.85 * bound, path


@pytest.mark.parametrize("name", ["toponet", "bevformer_detr"])
def test_published_heads_are_equal_in_all_layers_and_differ_from_one_another(name):
    params = started(name)
    layers = {
        path: path.replace("_0/", "_1/", 1) for path in params if path.startswith(("heads_0", "element_embedding_0"))
    }
    layers |= {
        path: path.replace("_0/", "_1/", 1)
        for path in params
        if path.startswith(("elements/class_0", "elements/box_0"))
    }
    for first, second in layers.items():
        np.testing.assert_array_equal(params[first], params[second])
    heads = params["heads_1/successor/mlp_first/linear_0/kernel"], params["heads_1/successor/mlp_first/linear_1/kernel"]
    assert not np.array_equal(*heads)
    assert not np.array_equal(heads[0], params["heads_1/element_lane/mlp_first/linear_0/kernel"])


def test_a_host_draws_its_heads_where_the_configuration_says_so(monkeypatch):
    monkeypatch.setattr(host, "with_torch_heads", lambda variables, key: {**variables, "drawn": key})
    for initial in ("lecun", "xavier"):
        module = dataclasses.replace(CAMERA_TOPONET, initial=initial).build()
        shapes = jax.eval_shape(module.init, jax.random.key(0), make_camera_example())
        assert ("drawn" in shapes) == (initial == "xavier")
