"""What holds for every variant of marker fusion: no markers, padding, order of lanes, motion of the vehicle."""

from dataclasses import replace
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.models.cases import BASELINE
from tests.models.test_marker_fusion import CONFIG, observed, seeing
from tests.parameters import random_params
from tests.shared import assert_same
from tests.slow import with_slow
from tflane_jax.geometry import BevGrid, relative_pose, yaw_pose
from tflane_jax.models.marker_fusion import (
    MarkerFusionConfig,
    MarkerPrior,
    as_fused,
    as_written,
    uniform_fusion,
)
from tflane_jax.models.prior import BevCells
from tflane_jax.models.raster_fusion import MarkerRasterConfig
from tflane_jax.priors.marker_memory import MarkerGuidance

VARIANTS = {
    "gated": CONFIG,
    "as written": as_written(CONFIG),
    "query": replace(CONFIG, norm="query", width=16),
    "radius": replace(CONFIG, norm="query", radius=10.0),
    "uniform": uniform_fusion(CONFIG),
    "ungated": replace(CONFIG, fusion="uniform"),
    "hard": replace(CONFIG, fusion="hard"),
    "no memory": replace(CONFIG, memory=None),
    "connectivity": replace(CONFIG, connectivity=True),
    "transformer": replace(CONFIG, encoding="transformer"),
    "MLP": replace(CONFIG, encoding="mlp"),
    "cells": replace(CONFIG, norm="query", bev=MarkerRasterConfig(hidden=8)),
    "cells of all layers, no memory": replace(CONFIG, memory=None, bev=MarkerRasterConfig("all", hidden=8)),
}
RNG = np.random.default_rng(0)
BEV, POSITION = (jnp.asarray(RNG.normal(size=(12, 8)), jnp.float32) for _ in range(2))
CENTERS = jnp.asarray(RNG.uniform(-20, 20, (12, 2)), jnp.float32)
HOST = BASELINE.spec


class OneLayer(nn.Module):
    """Tokens of lanes, fused into the BEV features of one layer."""

    config: MarkerFusionConfig

    @nn.compact
    def __call__(self, lanes: MarkerGuidance):
        prior = MarkerPrior(self.config, HOST)
        cells = BevCells(BEV, POSITION, CENTERS, BevGrid(HOST.bev_range, 3, 4))
        return prior.into_bev(prior.encode(lanes, deterministic=True), 0, cells)


def lanes_of(config, markers):
    prior = MarkerPrior(config, HOST)
    return prior.observe(seeing(markers), prior.start())[0]


QUICK = ("gated", "as written", "radius", "hard", "connectivity", "MLP", "cells")


@pytest.fixture(params=with_slow(VARIANTS, QUICK), scope="module")
def variant(request):
    """Return a variant, with random parameters, and its function from lanes to BEV features."""
    config = VARIANTS[request.param]
    module = OneLayer(config)
    variables = random_params(module.init, lanes_of(config, observed()))
    return config, variables["params"], jax.jit(lambda lanes: module.apply(variables, lanes))


def test_without_markers_features_stay(variant):
    """They do not depend on the lanes in the padding either; Eq. (3) as written normalises them."""
    config, params, fuse = variant
    for markers in (None, observed(valid=False, garbage=np.nan), observed(lanes=0)):
        lanes = lanes_of(config, markers)
        expected = BEV
        if config.norm == "written":
            expected = nn.LayerNorm(epsilon=1e-5).apply({"params": params["markers_0"]["norm"]}, BEV)
            np.testing.assert_allclose(fuse(lanes), expected, atol=1e-6)
        else:
            assert_same(fuse(lanes), expected)
    assert np.abs(fuse(lanes_of(config, observed())) - expected).max() > 1e-3


def test_padding_of_lanes_may_hold_nan(variant):
    config, _, fuse = variant
    lanes = lanes_of(config, observed())
    gone = ~lanes.valid
    assert gone.any()
    dirty = lanes.replace(
        points=jnp.where(gone[:, None, None], jnp.nan, lanes.points),
        confidence=jnp.where(gone, jnp.nan, lanes.confidence),
        successor=lanes.successor | (gone[:, None] & gone[None, :]),
    )
    assert_same(fuse(dirty), fuse(lanes))


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_lanes_does_not_matter(variant, seed):
    config, _, fuse = variant
    lanes = lanes_of(config, observed(lanes=3))
    order = np.random.default_rng(seed).permutation(len(lanes.valid))
    by_lane = {name: getattr(lanes, name)[order] for name in ("points", "weight", "confidence", "valid")}
    shuffled = lanes.replace(**by_lane, successor=lanes.successor[order][:, order])
    np.testing.assert_allclose(fuse(shuffled), fuse(lanes), atol=1e-5)


MOTION = st.tuples(st.floats(-8, 8), st.floats(-3, 3), st.floats(-0.6, 0.6))


@given(st.lists(MOTION, min_size=1, max_size=2), MOTION)
@settings(max_examples=15)
def test_remembered_lanes_stay_on_the_ground_on_any_drive(steps, turn):
    """The bank moves its lanes with each pose; here the poses of the whole drive are known at once."""
    prior = MarkerPrior(CONFIG, HOST)
    observe = jax.jit(prior.observe)
    start = yaw_pose(*np.array(turn)[:, None])[0]
    first, memory = observe(seeing(observed(), has_previous=np.asarray(False)), prior.start())
    before = start
    for step in steps:
        now = before @ yaw_pose(*np.array(step)[:, None])[0]
        pose = relative_pose(before, now).astype(np.float32)
        frame = seeing(None, has_previous=np.asarray(True)).replace(previous_from_ego=pose)
        lanes, memory = observe(frame, memory)
        before = now
    valid = np.asarray(first.valid[: CONFIG.prior.lanes])
    points = np.asarray(first.points[: CONFIG.prior.lanes], np.float64)[valid]
    moved = relative_pose(before, start)
    expected = points @ moved[:2, :2].T + moved[:2, 3]
    np.testing.assert_allclose(np.asarray(lanes.points)[np.asarray(lanes.valid)], expected, atol=1e-3)
    np.testing.assert_allclose(lanes.gate, first.gate * 0.5 ** len(steps), rtol=1e-5)


def test_a_marker_at_the_threshold_is_used():
    """Hard fusion ignores markers below the threshold."""
    lanes = lanes_of(CONFIG, observed())
    hard = replace(CONFIG, fusion="hard", hard_threshold=0.5)
    for trust, used in ((0.5, lanes.valid), (0.49, jnp.zeros_like(lanes.valid))):
        equal = lanes.replace(confidence=jnp.where(lanes.valid, trust, 0.0))
        np.testing.assert_array_equal(as_fused(equal, hard).valid, used)


@pytest.mark.parametrize("attend", ["points", "lines"])
def test_lanes_of_an_ignored_marker_change_nothing(attend):
    """Regression: with attention between lines, they changed the tokens of the others."""
    config = replace(CONFIG, fusion="hard", lines=replace(CONFIG.lines, attend=attend))
    module, lanes = OneLayer(config), lanes_of(config, observed())
    fuse = jax.jit(partial(module.apply, random_params(module.init, lanes)))
    doubtful = lanes.replace(confidence=lanes.confidence.at[1].set(0.1))
    moved = doubtful.replace(points=doubtful.points.at[1].add(30.0))
    assert_same(fuse(moved), fuse(doubtful))
    assert not np.array_equal(fuse(lanes.replace(points=moved.points)), fuse(lanes))


@pytest.mark.parametrize("name", ["gated", "ungated", "hard"])
def test_without_a_lane_to_attend_to_the_gate_is_closed(name):
    lanes = lanes_of(VARIANTS[name], observed(valid=False))
    assert as_fused(lanes, VARIANTS[name]).gate == 0.0
    sure = lanes_of(VARIANTS[name], observed()).replace(confidence=jnp.ones(len(lanes.valid)))
    assert as_fused(sure, VARIANTS[name]).gate > 0.0


def test_cells_of_lanes_have_the_gate_of_the_variant():
    """With c = 1 in Eq. (3), the frame's confidence does not reach the cells either."""
    config = replace(CONFIG, fusion="uniform", norm="query", bev=MarkerRasterConfig(hidden=8))
    module, lanes = OneLayer(config), lanes_of(config, observed())
    fuse = jax.jit(partial(module.apply, random_params(module.init, lanes)))
    doubtful, sure = (fuse(lanes.replace(gate=jnp.float32(gate))) for gate in (0.1, 0.9))
    assert_same(doubtful, sure)
