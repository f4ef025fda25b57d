"""Parameters and outputs at the papers' sizes, from shapes alone (counts: docs/reference/training.md)."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from tflane_jax.config import load_config
from tflane_jax.convert.hosts import camera_shapes
from tflane_jax.models import bevformer_detr, lanesegnet, maptr, maptrv2, toponet

BACKBONE, PYRAMID, BEV = 23_508_032, 3_278_592, 7_667_648
ELEMENTS, RELATIONS = 8_381_032, 460_801
# The reference counts a constant weight for each coordinate of a lane among its parameters.
TOPONET_LANES, POINT_LANES, CURVE_LANES = 20_030_524 - 33, 5_792_816 - 33, 5_765_042 - 15
SEGMENTS, LANESEGNET = 10_497_781 - 90, 45_412_854
# Of the embeddings of four levels in MapTR's checkpoints, one is used; four numbers are constant weights.
MAPTR, MAPTR_HEAD, MAPTR_UNUSED = 36_193_568, 11_570_912, 3 * 256 + 4
# Of MapTRv2's checkpoints, position encodings, level and camera embeddings, the motion's embedding, the grid and the
# constant weights are not used.
MAPTRV2, MAPTRV2_HEAD, LIFT = 40_578_399, 15_955_743, 7_230_521 - 9
MAPTRV2_UNUSED = 300 * 128 + (4 + 6) * 256 + 35_968 + 9 + 4
MAP = jax.ShapeDtypeStruct((100, 200, 256), jnp.float32)


def count(tree):
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def test_toponet_is_as_large_as_the_reference():
    config = toponet.paper_config()
    module, example = config.build(), camera_shapes(config.encoder)
    (answer, memory), variables = jax.eval_shape(
        lambda key, e: module.init_with_output(key, e, method=module.step), jax.random.key(0), example
    )
    params = dict(variables["params"])
    encoder, elements = params.pop("encoder"), params.pop("elements")
    # Scale and bias of a frozen norm are parameters in the reference, and constants here.
    assert count(encoder["images"]["backbone"]) == BACKBONE - 2 * 26_560
    assert count(encoder["images"]["pyramid"]) == PYRAMID
    assert count(encoder["bev"]) == BEV
    assert count(elements) == ELEMENTS
    assert count(params) == TOPONET_LANES

    assert memory.bev.features.shape == MAP.shape
    assert answer.centerlines.points.shape == (6, 200, 11, 3)
    assert answer.centerlines.successor_logits.shape == (6, 200, 200)
    assert answer.elements.box.shape == (6, 100, 2, 2)
    assert answer.elements.lane_logits.shape == (6, 200, 100)


def test_lanesegnet_is_as_large_as_the_reference():
    config = lanesegnet.paper_config()
    module, example = config.build(), camera_shapes(config.encoder)
    answer, variables = jax.eval_shape(lambda key, e: module.init_with_output(key, e), jax.random.key(0), example)
    params = dict(variables["params"])
    # In the reference, scale and bias of frozen norms and 90 constant weights of coordinates count as parameters.
    assert count(params) == LANESEGNET - 2 * 26_560 - 90
    assert count(params.pop("encoder")) == BACKBONE - 2 * 26_560 + PYRAMID + BEV
    assert count(params.pop("successor")) == RELATIONS
    assert count(params) == SEGMENTS

    segments = answer.segments
    assert segments.points.shape == segments.left.shape == (6, 200, 10, 3)
    assert segments.left_type_logits.shape == (6, 200, 3)
    assert segments.successor_logits.shape == (1, 200, 200)


@pytest.mark.parametrize(
    ("attention", "expected"), [("kernel", MAPTR_HEAD), pytest.param("deformable", 11_604_836, marks=pytest.mark.slow)]
)
def test_maptr_is_as_large_as_the_reference(attention, expected):
    config = maptr.paper_config()
    bev = dataclasses.replace(config.encoder.bev, attention=attention)
    config = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, bev=bev))
    module, example = config.build(), camera_shapes(config.encoder)
    answer, variables = jax.eval_shape(lambda key, e: module.init_with_output(key, e), jax.random.key(0), example)
    params = dict(variables["params"])
    if attention == "kernel":
        assert count(params) == MAPTR - 2 * 26_560 - MAPTR_UNUSED
    images = params["encoder"].pop("images")
    assert count(images) == BACKBONE - 2 * 26_560 + 1_114_624
    assert count(params) == expected - MAPTR_UNUSED

    assert answer.lines.points.shape == (6, 50, 20, 2)
    assert answer.lines.logits.shape == (6, 50, 3)


def test_maptrv2_is_as_large_as_the_reference():
    config = maptrv2.paper_config()
    module, example = config.build(), camera_shapes(config.encoder)
    answer, variables = jax.eval_shape(lambda key, e: module.init_with_output(key, e), jax.random.key(0), example)
    params = dict(variables["params"])
    assert count(params) == MAPTRV2 - 2 * 26_560 - MAPTRV2_UNUSED
    assert count(params["encoder"]["bev"]) == LIFT
    images = params["encoder"].pop("images")
    assert count(params) == MAPTRV2_HEAD - MAPTRV2_UNUSED
    assert count(images) == MAPTRV2 - MAPTRV2_HEAD - 2 * 26_560
    assert answer.lines.points.shape[1:] == (50, 20, 2)


def test_maptrv2_for_argoverse_2_has_a_third_coordinate():
    """Of the first points, and of the changes in six layers; the lift is as large as for nuScenes."""
    path = Path(__file__).parents[2] / "configs" / "tf_lane" / "maptrv2_r50.py"
    run = load_config(f"{path}:argoverse2")
    model, data = run.task.model, run.data
    assert (model.encoder.bev.grid.rows, model.encoder.bev.grid.columns) == (100, 200)
    assert (model.range.x, model.range.y, model.range.z) == ((-30.0, 30.0), (-15.0, 15.0), (-5.0, 3.0))
    assert "depth" not in model.auxiliary
    run.task.check_settings(data)
    module, example = model.build(), camera_shapes(model.encoder)
    answer, variables = jax.eval_shape(lambda key, e: module.init_with_output(key, e), jax.random.key(0), example)
    params = variables["params"]
    assert count(params) == MAPTRV2 - 2 * 26_560 - MAPTRV2_UNUSED + (1 + 6) * 257
    assert count(params["encoder"]["bev"]) == LIFT
    assert answer.lines.points.shape[1:] == (50, 20, 3)


@pytest.mark.parametrize(("control_points", "expected"), [(None, POINT_LANES), (5, CURVE_LANES)])
def test_baseline_is_as_large_as_the_reference(control_points, expected):
    module = bevformer_detr.paper_config(control_points).build()
    answer, variables = jax.eval_shape(
        lambda key, bev: module.init_with_output(key, bev, method=module.decode), jax.random.key(0), MAP
    )
    assert count(variables["params"]) == expected + RELATIONS
    assert answer.centerlines.points.shape == (6, 100, 11, 3)
    # Topology of the last layer alone.
    assert answer.centerlines.successor_logits.shape == (1, 100, 100)


def test_lanes_may_move_at_the_papers_sizes_too():
    config = toponet.paper_config()
    config = dataclasses.replace(config, decoder=dataclasses.replace(config.decoder, refine="iterative"))
    module = config.build()
    answer, _ = jax.eval_shape(
        lambda key, bev: module.init_with_output(key, bev, method=module.decode), jax.random.key(0), MAP
    )
    assert answer.centerlines.points.shape == (6, 200, 11, 3)
