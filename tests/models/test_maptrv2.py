"""MapTRv2: decoupled attention, the group that exists in training only, masks, parts that do not fit."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import (
    LIFTED_LINES,
    LINES,
    SMALL_LINES,
    make_depth_example,
    make_line_example,
)
from tests.parameters import random_params
from tflane_jax.errors import UserError
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.auxiliary import AUXILIARY, auxiliary_outputs
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.maptrv2 import DecoupledLayer, MapTrV2Config
from tflane_jax.scene import LineClass, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

DECODER = replace(SMALL_LINES.decoder, layers=2)
MODEL = MapTrV2Config(encoder=LINES.encoder, decoder=DECODER, priors=SMALL_LINES.priors, many=4, line_mask=True)
TASK = LaneGraphTask(MODEL, MapTrV2LossConfig(many_repeats=2))


@pytest.fixture(scope="module")
def params():
    return random_params(TASK.init, make_line_example())


@jax.jit
def trained(params, example):
    found, state = MODEL.build().apply({"params": params}, example, mutable=[AUXILIARY])
    return found.lines, auxiliary_outputs(state)


@pytest.mark.slow
def test_the_second_group_exists_in_training_only_and_changes_nothing_else(params):
    """With traffic, whose module gets the groups as the host's own mask."""
    example = make_line_example()
    lines, auxiliary = trained(params, example)
    assert lines.points.shape == (2, 6, 5, 2)
    assert auxiliary.one_to_many.points.shape == (2, 4, 5, 2)
    assert auxiliary.line_mask.shape == (6, 10)
    alone = jax.jit(TASK.predict)(params, example).lines
    np.testing.assert_allclose(lines.points[-1], alone.points, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(lines.logits[-1], alone.logits, rtol=1e-4, atol=1e-3)
    queries = params["queries"]
    other = queries | {"instances": queries["instances"].at[6:].add(1.0)}
    changed, moved = trained(params | {"queries": other}, example)
    np.testing.assert_array_equal(changed.points, lines.points)
    assert np.abs(moved.one_to_many.points - auxiliary.one_to_many.points).max() > 0.1


def test_attention_runs_along_lines_and_among_lines_at_the_same_place():
    rng = np.random.default_rng(0)
    queries, position = (jnp.asarray(rng.normal(size=(3, 5, 16)), jnp.float32) for _ in range(2))
    reference, bev = jnp.full((3, 5, 2), 0.5), jnp.asarray(rng.normal(size=(4, 6, 16)), jnp.float32)
    layer = DecoupledLayer(DECODER)
    params = random_params(lambda key: layer.init(key, queries, position, reference, bev)["params"])
    groups = jnp.eye(3, dtype=bool)
    run = jax.jit(lambda q, groups: layer.apply({"params": params}, q, position, reference, bev, groups))
    push = queries.at[0, 0].add(1.0)
    together, apart = (np.abs(run(push, g) - run(queries, g)).max(-1) > 1e-6 for g in (jnp.ones((3, 3), bool), groups))
    # Among all lines at place 0, then along every line: everything hears of it.
    assert together.all()
    assert apart[0].all()
    assert not apart[1:].any()


@pytest.mark.slow
def test_it_trains_and_all_its_parameters_learn(params):
    batch = stack_examples([make_line_example(), make_line_example(1, lanes=0, crossings=0)])
    run = jax.jit(jax.value_and_grad(TASK.loss, has_aux=True))
    (loss, report), gradient = run(params, batch, jax.random.key(1))
    assert np.isfinite(loss)
    assert {"class", "points", "direction", "mask", "many_class", "many_points", "many_direction"} <= set(report)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    silent = [
        f"{part}/{name}"
        for part in ("queries", "mask_head", "layer_0", "layer_1", "heads_0", "heads_1", "spatial_encoder_0")
        for name, leaf in gradient[part].items()
        if not any(np.any(x) for x in jax.tree.leaves(leaf))
    ]
    assert not silent
    assert np.abs(gradient["queries"]["instances"][6:]).max() > 0


def test_parts_that_do_not_fit_are_named():
    with pytest.raises(UserError, match=r"many is \d+: it must be 0 with denoising"):
        replace(MODEL, denoising=DenoisingConfig()).build()


def test_masks_show_only_the_classes_that_the_model_has():
    """One divider and centerlines in the data, and a model of three classes."""
    example = make_depth_example(0)
    category = np.where(np.arange(len(example.map_lines.valid)) > 0, LineClass.CENTERLINE, LineClass.DIVIDER)
    kept = example.map_lines.valid & (category != LineClass.CENTERLINE)
    given = example.replace(map_lines=example.map_lines.replace(category=category))
    without = example.replace(map_lines=given.map_lines.replace(valid=kept))
    logits = {"line_mask": jnp.zeros((1, 6, 10)), "view_line_masks": jnp.zeros((1, 2, 4, 6))}

    @partial(jax.jit, static_argnums=1)
    def losses(batch, classes):
        host = replace(MODEL, decoder=replace(DECODER, classes=classes))
        terms = [TASK.losses.auxiliary_terms(name, one, None, batch, host) for name, one in logits.items()]
        return [value[0] for term in terms for value in term.values()]

    batches = [stack_examples([one]) for one in (given, without)]
    three, alone = (losses(batch, 3) for batch in batches)
    assert three == alone
    assert losses(batches[0], 4)[0] > alone[0]


@pytest.mark.slow
def test_with_cameras_it_learns_depth_and_masks_in_the_images_too():
    task = LaneGraphTask(LIFTED_LINES, MapTrV2LossConfig(many_repeats=2))
    batch = stack_examples([make_depth_example(seed) for seed in (0, 1)])
    params = random_params(task.init, make_depth_example(0))
    run = jax.jit(jax.value_and_grad(task.loss, has_aux=True))
    (loss, report), gradient = run(params, batch, jax.random.key(1))
    assert np.isfinite(loss)
    assert {"depth", "mask", "view_mask", "many_points"} <= set(report)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    learning = gradient["encoder"]["bev"]["depth_net"], gradient["encoder"]["view_mask_head"]
    assert all(np.any(leaf) for part in learning for leaf in jax.tree.leaves(part))
    assert task.start().bev is None
    # Depth is a label: the prediction does not depend on it.
    example = make_depth_example(0)
    without = example.replace(cameras=example.cameras.replace(depth=None, depth_valid=None), map_lines=None)
    predict = jax.jit(task.predict)
    jax.tree.map(np.testing.assert_array_equal, predict(params, example), predict(params, without))
