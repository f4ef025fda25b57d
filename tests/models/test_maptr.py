"""MapTR: initial values, points that move, groups of queries, sizes that do not fit, denoising, cameras."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import CAMERA, ELEMENTS, LINES, SMALL_LINES, make_camera_example, make_line_example
from tests.parameters import random_params, zero_params
from tests.slow import with_slow
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.masks import SpatialMask
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.map_lines import LineHeads
from tflane_jax.models.maptr import MapTr
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.traffic_flow_module import SpatialEncoder
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

BEV = jax.random.normal(jax.random.key(0), (4, 6, 16))


@pytest.fixture(scope="module")
def params():
    module = LINES.build()
    return random_params(lambda key: module.init(key, BEV, method=MapTr.decode)["params"])


def decode(params, *, config=LINES, bev=BEV):
    module = config.build()
    return jax.jit(lambda p, b: module.apply({"params": p}, b, method=MapTr.decode).lines)(params, bev)


def test_a_line_is_a_group_of_points_and_the_lines_may_change_places(params):
    found = decode(params)
    assert found.points.shape == (2, 6, 5, 2)
    assert found.logits.shape == (2, 6, 3)
    order = np.array([4, 2, 0, 5, 1, 3])
    queries = params["queries"] | {"instances": params["queries"]["instances"][order]}
    moved = decode(params | {"queries": queries})
    np.testing.assert_allclose(moved.points, found.points[:, order], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(moved.logits, found.logits[:, order], rtol=1e-4, atol=1e-4)


def test_every_layer_moves_the_points_of_the_layer_before(params):
    """With heads that change nothing, the points stay where the first layer's reference was."""
    still = {name: jax.tree.map(jnp.zeros_like, params[name]["points"]) for name in ("heads_0", "heads_1")}
    found = decode(params | {name: params[name] | {"points": value} for name, value in still.items()})
    queries = jax.tree.map(np.asarray, params["queries"])
    place = (queries["instances"][:, None] + queries["points"])[..., :16]
    logits = place @ queries["reference"]["kernel"] + queries["reference"]["bias"]
    unit = 1.0 / (1.0 + np.exp(-logits))
    expected = LINES.encoder.bev_range.denormalise(unit)
    for layer in (0, 1):
        np.testing.assert_allclose(found.points[layer], expected, rtol=1e-4, atol=1e-3)
    # One unit more in the first layer's logit of x moves the points of both layers.
    bias = still["heads_0"]["linear_2"] | {"bias": jnp.array([1.0, 0.0])}
    pushed = {"heads_0": params["heads_0"] | {"points": still["heads_0"] | {"linear_2": bias}}}
    pushed |= {"heads_1": params["heads_1"] | {"points": still["heads_1"]}}
    moved = LINES.encoder.bev_range.normalise(decode(params | pushed).points)
    unit[..., 0] = 1.0 / (1.0 + np.exp(-logits[..., 0] - 1.0))
    np.testing.assert_allclose(moved, np.stack([unit, unit]), atol=1e-4)


@pytest.mark.slow
def test_heads_start_as_copies_of_one_another_and_classes_are_rare():
    module = replace(LINES, decoder=replace(LINES.decoder, layers=3)).build()
    params = jax.jit(lambda key: module.init(key, BEV, method=MapTr.decode))(jax.random.key(1))["params"]
    for i in (1, 2):
        jax.tree.map(np.testing.assert_array_equal, params["heads_0"], params[f"heads_{i}"])
    np.testing.assert_allclose(jax.nn.sigmoid(params["heads_0"]["class"]["linear_2"]["bias"]), 0.01, rtol=1e-5)
    assert 0.9 < np.std(params["queries"]["instances"]) < 1.1


@pytest.mark.slow
def test_lines_of_the_small_form_start_in_the_range_and_end_at_its_border():
    config = replace(SMALL_LINES, range=PerceptionRange((-30.0, 30.0), (-15.0, 15.0)), priors=PriorsConfig())
    module = config.build()
    fresh = jax.jit(lambda key: module.init(key, BEV, method=MapTr.decode))(jax.random.key(0))["params"]
    start = config.encoder.bev_range.denormalise(jax.nn.sigmoid(fresh["queries"]["anchors"]))
    np.testing.assert_allclose(np.linalg.norm(start[:, -1] - start[:, 0], axis=-1), 24.0, rtol=0.3)
    heads = LineHeads(config.decoder, config.encoder.bev_range, config.range)
    queries, reference = jnp.zeros((2, 5, 16)), jnp.full((2, 5, 2), 0.5)
    params = zero_params(heads.init, queries, reference)
    params["params"]["points"]["linear_2"]["bias"] = jnp.array([1.0, -100.0])
    found = heads.apply(params, queries, reference)
    np.testing.assert_allclose(found.points, np.broadcast_to([5.0, -15.0], (2, 5, 2)), atol=1e-4)


def test_three_coordinates():
    config = replace(SMALL_LINES, decoder=replace(SMALL_LINES.decoder, coordinates=3), priors=PriorsConfig())
    module = config.build()
    params = random_params(lambda key: module.init(key, BEV, method=MapTr.decode)["params"])
    assert decode(params, config=config).points.shape == (2, 6, 5, 3)


def test_traffic_respects_the_hosts_own_groups_of_queries():
    """Fig. 5 with a mask of the host: no message from one group to the other through the traffic-flow module."""
    rng = np.random.default_rng(0)
    lanes, traffic = (jnp.asarray(rng.normal(size=(n, 16)), jnp.float32) for n in (6, 4))
    group = np.arange(6) < 4
    mask = SpatialMask.from_validity(6, jnp.ones(4, bool), jnp.asarray(group[:, None] == group[None]))
    encoder = SpatialEncoder(SMALL_LINES.priors.traffic_flow.module, 16, "point")
    position = jnp.zeros_like(lanes)
    params = random_params(lambda key: encoder.init(key, lanes, position, traffic, mask)["params"])
    run = jax.jit(lambda lanes: encoder.apply({"params": params}, lanes, position, traffic, mask))
    changed = run(lanes.at[4:].add(1.0))
    np.testing.assert_array_equal(changed[:4], run(lanes)[:4])
    assert np.abs(changed[4:] - run(lanes)[4:]).max() > 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"denoising": DenoisingConfig()}, "decoder.anchors spread"),
        ({"encoder": replace(LINES.encoder, cells=True)}, "cells learn directed lanes"),
        ({"encoder": replace(CAMERA, cells=False), "elements": ELEMENTS}, "no traffic elements"),
    ],
)
def test_parts_that_do_not_fit_are_named(change, message):
    with pytest.raises(UserError, match=message):
        replace(LINES, **change).build()


@pytest.mark.slow  # tests/models/test_maptrv2.py trains with more parts
def test_it_trains_with_denoising_and_all_its_parameters_learn():
    model = replace(SMALL_LINES, denoising=DenoisingConfig(copies=1))
    task = LaneGraphTask(model, MapTrLossConfig(class_target="quality", rings="both"))
    example = make_line_example()
    params = random_params(task.init, example)
    batch = stack_examples([example, make_line_example(1, lanes=0, crossings=0)])
    (_, report), gradient = jax.jit(jax.value_and_grad(task.loss, has_aux=True))(params, batch, jax.random.key(1))
    assert {"class", "points", "direction", "denoised_class", "denoised_points", "matching/lines"} <= set(report)
    assert float(report["matching/lines"]) == 2.5  # four lines and a ring, and nothing
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    silent = [
        f"{part}/{name}"
        for part in ("queries", "noised", "heads_0", "heads_1", "point_position_0", "temporal_encoder")
        for name, leaf in gradient[part].items()
        if not any(np.any(x) for x in jax.tree.leaves(leaf))
    ]
    assert not silent


def test_lines_of_classes_that_the_model_lacks_are_not_denoised():
    """Regression: queries were put on them, and learned that there is nothing."""
    example = make_line_example(3)
    foreign = example.map_lines.replace(category=np.where(np.arange(len(example.map_lines.valid)) == 0, 3, 0))
    gone = foreign.replace(valid=foreign.valid & (np.arange(len(foreign.valid)) > 0))
    assert foreign.valid[0]
    module = replace(LINES, decoder=replace(LINES.decoder, anchors="spread"), denoising=DenoisingConfig()).build()

    def denoised(lines):
        _, seen = module.init_with_output(
            {"params": jax.random.key(0), "dropout": jax.random.key(1)},
            *(BEV, None, lines),
            deterministic=False,
            method=MapTr.decode,
            mutable=["params", AUXILIARY],
        )
        return seen[AUXILIARY]["denoised"]

    jax.tree.map(np.testing.assert_array_equal, denoised(foreign), denoised(gone))
    four = denoised(foreign.replace(category=np.zeros_like(foreign.category)))
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(four), jax.tree.leaves(denoised(gone)), strict=True))


@pytest.mark.parametrize("attention", with_slow(["kernel", "deformable"], quick=["kernel"]))
def test_cameras_may_change_places_but_for_their_embeddings(attention):
    encoder = replace(
        CAMERA,
        cells=False,
        images=replace(CAMERA.images, stages=(3,), pyramid=replace(CAMERA.images.pyramid, levels=1)),
        bev=replace(CAMERA.bev, levels=1, attention=attention, dropout=0.0),
    )
    config = replace(LINES, encoder=encoder)
    task, example = LaneGraphTask(config, MapTrLossConfig()), make_camera_example()
    params = random_params(task.init, example, spread=0.2)
    params["encoder"]["bev"]["cameras"] = jnp.zeros_like(params["encoder"]["bev"]["cameras"])
    predict = jax.jit(partial(task.predict, params))
    found = predict(example).lines
    swapped = predict(example.replace(cameras=jax.tree.map(lambda leaf: leaf[::-1], example.cameras))).lines
    np.testing.assert_allclose(swapped.points, found.points, rtol=1e-3, atol=1e-3)
    other = predict(example.replace(cameras=example.cameras.replace(image=255 - example.cameras.image))).lines
    assert np.abs(other.points - found.points).max() > 1e-2
