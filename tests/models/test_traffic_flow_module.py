"""The traffic-flow module alone, on lane queries."""

import dataclasses
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.parameters import random_params
from tests.priors.test_traffic_flow import make_flow
from tests.shared import ROOT
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.layers.masks import SpatialMask
from tflane_jax.models.prior import HostQueries, HostSpec
from tflane_jax.models.traffic_flow_module import (
    ALL_FUSIONS,
    LANE_FUSIONS,
    EncodedTrafficFlow,
    SpatialEncoder,
    TemporalEncoder,
    TrafficFlowConfig,
    TrafficFlowModuleConfig,
)
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig, select_traffic_flow

CONFIG = TrafficFlowModuleConfig(width=8, heads=2, bands=3)
PRIOR = TrafficFlowPriorConfig(max_instances=5)
DIM, LANES = 12, 7
BEV = BevGrid().range


@partial(jax.jit, static_argnums=0)
def apply(module, params, *arguments):
    return module.apply(params, *arguments)


def tokens(seed=0, instances=4, **prior):
    flow = make_flow(seed, instances=instances)
    return jax.tree.map(jnp.asarray, select_traffic_flow(flow, dataclasses.replace(PRIOR, **prior), PerceptionRange()))


def spatial(config, seed=0, valid=None, lane_mask=None):
    """Build a spatial encoder with random inputs; return module, parameters and arguments."""
    rng = np.random.default_rng(seed)
    lanes, position, traffic = (jnp.asarray(rng.normal(size=(n, DIM)).astype(np.float32)) for n in (LANES, LANES, 5))
    valid = jnp.arange(5) < 3 if valid is None else valid
    module = SpatialEncoder(config, DIM)
    arguments = (lanes, position, traffic, SpatialMask.from_validity(LANES, valid, lane_mask))
    return module, random_params(module.init, *arguments), arguments


@pytest.mark.parametrize("depth", [0, 1, 3])
def test_token_depends_on_valid_frames_only(depth):
    module = TemporalEncoder(dataclasses.replace(CONFIG, depth=depth), DIM, BEV)
    clean = tokens(1)
    params = random_params(module.init, clean)
    hole = ~clean.frame_valid[..., None]
    dirty = clean.replace(position=jnp.where(hole, 99.0, clean.position), heading=jnp.where(hole, -7.0, clean.heading))
    a, b = (np.asarray(apply(module, params, t))[np.asarray(clean.valid)] for t in (clean, dirty))
    np.testing.assert_array_equal(a, b)
    assert len(a) > 0


def test_token_sees_the_order_of_frames():
    module = TemporalEncoder(CONFIG, DIM, BEV)
    forward = tokens(2, occluded_frames="keep")
    params = random_params(module.init, forward)
    whole = forward.replace(frame_valid=jnp.ones_like(forward.frame_valid))
    back = whole.replace(position=whole.position[:, ::-1], heading=whole.heading[:, ::-1])
    assert not np.allclose(apply(module, params, whole), apply(module, params, back))


@pytest.mark.parametrize(("token", "ordered"), [("mean", False), ("mean_and_ends", True)])
def test_only_the_ends_tell_the_order_of_frames_without_ages(token, ordered):
    module = TemporalEncoder(dataclasses.replace(CONFIG, token=token), DIM, BEV)
    forward = tokens(2, occluded_frames="keep")
    params = random_params(module.init, forward)
    params["params"]["age"] = jnp.zeros_like(params["params"]["age"])
    whole = forward.replace(frame_valid=jnp.ones_like(forward.frame_valid))
    back = whole.replace(position=whole.position[:, ::-1], heading=whole.heading[:, ::-1])
    a, b = (apply(module, params, t) for t in (whole, back))
    assert np.allclose(a, b, atol=1e-5) is not ordered


@pytest.mark.parametrize("token", ["mean", "mean_and_ends"])
def test_frames_missing_at_the_end_are_none_at_all(token):
    """The mean is over the valid frames, and the last valid one is the end."""
    module = TemporalEncoder(dataclasses.replace(CONFIG, token=token), DIM, BEV)
    track = tokens(2, occluded_frames="keep")
    seen = jnp.broadcast_to(jnp.arange(track.frame_valid.shape[1])[None] < 7, track.frame_valid.shape)
    params = random_params(module.init, track)
    found = apply(module, params, track.replace(frame_valid=seen))
    short = track.replace(position=track.position[:, :7], heading=track.heading[:, :7], frame_valid=seen[:, :7])
    params["params"]["age"] = params["params"]["age"][:7]
    np.testing.assert_allclose(found, apply(module, params, short), rtol=1e-4, atol=1e-5)


def test_normalised_coordinates_span_the_bev():
    """Without sines, they are what an encoder of metres computes from fractions of the box; 0 in missing frames."""
    config, track = dataclasses.replace(CONFIG, position_encoding="linear"), tokens(2)
    unit = (np.asarray(track.position, float) - BEV.low()) / BEV.size()
    fractions = track.replace(position=jnp.asarray(np.where(track.frame_valid[..., None], unit, 0.0), jnp.float32))
    normalised, metres = (TemporalEncoder(config, DIM, BEV, each) for each in ("normalised", "metres"))
    params = random_params(normalised.init, track)
    np.testing.assert_allclose(apply(normalised, params, track), apply(metres, params, fractions), atol=1e-5)


def test_sines_of_coordinates_in_metres():
    """Wavelengths are 200, 100 and 50 m in both directions, whatever the host's range."""
    wide = HostSpec(DIM, PerceptionRange((-90, 90)), PerceptionRange((-90, 90)))
    prior = TrafficFlowConfig(TrafficFlowPriorConfig(coordinates="metres"), CONFIG).build(wide)
    position = np.random.default_rng(0).uniform(-50, 50, (4, 20, 3)).astype(np.float32)
    heading = np.zeros((4, 20, 2), np.float32)
    encoded = prior.temporal_encoder.apply({}, position, heading, method="_encode_places")
    angle = 2 * np.pi * position[..., :2, None] / [200.0, 100.0, 50.0]
    waves = [np.sin(angle).reshape(4, 20, 6), np.cos(angle).reshape(4, 20, 6)]
    np.testing.assert_allclose(encoded, np.concatenate([*waves, position, heading], -1), atol=1e-5)


@pytest.mark.parametrize("fusions", [ALL_FUSIONS, LANE_FUSIONS, ("L->T",), ("L->L",), ()])
def test_only_the_chosen_modules_exist(fusions):
    _, params, _ = spatial(dataclasses.replace(CONFIG, fusions=fusions))
    expected = {name.replace("->", "_to_") for name in fusions}
    assert {n for n in params["params"] if "_to_" in n and "norm" not in n} == expected


@pytest.mark.parametrize("fusions", [ALL_FUSIONS, LANE_FUSIONS])
def test_invalid_instances_are_not_seen(fusions):
    module, params, (lanes, position, traffic, mask) = spatial(dataclasses.replace(CONFIG, fusions=fusions))
    dirty = traffic.at[3:].set(jnp.nan)
    clean_out = apply(module, params, lanes, position, traffic, mask)
    np.testing.assert_array_equal(clean_out, apply(module, params, lanes, position, dirty, mask))

    def total(t):
        return (apply(module, params, lanes, position, t, mask) ** 2).sum()

    gradient = jax.grad(total)(dirty)
    assert np.isfinite(gradient).all()
    assert not np.asarray(gradient)[3:].any()
    assert np.asarray(gradient)[:3].any()


def test_valid_instances_are_seen():
    module, params, (lanes, position, traffic, mask) = spatial(CONFIG)
    moved = apply(module, params, lanes, position, traffic.at[1].add(1.0), mask)
    assert not np.allclose(moved, apply(module, params, lanes, position, traffic, mask))


def test_point_queries_keep_the_original():
    """Eq. (3): I(Q_type) is 1 for point queries and 0 for instance queries."""
    module, params, arguments = spatial(CONFIG)
    point = SpatialEncoder(CONFIG, DIM, "point")
    difference = apply(point, params, *arguments) - apply(module, params, *arguments)
    np.testing.assert_allclose(difference, arguments[0], atol=1e-6)


def test_lane_mask_of_the_host_is_used():
    lonely = jnp.eye(LANES, dtype=bool)
    module, params, (lanes, position, traffic, mask) = spatial(CONFIG, lane_mask=lonely)
    out = apply(module, params, lanes, position, traffic, mask)
    moved = apply(module, params, lanes.at[0].add(1.0), position, traffic, mask)
    np.testing.assert_array_equal(out[1:], moved[1:])
    assert not np.allclose(out[0], moved[0])


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_each_spatial_layer_passes_on_what_lanes_tell_their_neighbours(depth):
    """Under a mask from each lane to the one before it, the first lane reaches as many lanes as there are layers."""
    chain = jnp.eye(LANES, dtype=bool) | jnp.eye(LANES, k=-1, dtype=bool)
    config = dataclasses.replace(CONFIG, spatial_depth=depth)
    module, params, (lanes, position, traffic, mask) = spatial(config, lane_mask=chain)
    out = apply(module, params, lanes, position, traffic, mask)
    moved = apply(module, params, lanes.at[0].add(1.0), position, traffic, mask)
    changed = (np.asarray(out) != np.asarray(moved)).any(1)
    np.testing.assert_array_equal(changed, np.arange(LANES) <= depth)


def test_a_fusion_without_residual_forgets_its_input():
    """All lanes read the only instance: without residual they become equal. With no instance they keep their own."""
    one = jnp.arange(5) < 1
    config = dataclasses.replace(CONFIG, fusions=("L->T",))
    module, params, arguments = spatial(dataclasses.replace(config, residual="none"), valid=one)
    out = apply(module, params, *arguments)
    np.testing.assert_allclose(out, jnp.broadcast_to(out[:1], out.shape), atol=1e-6)
    kept = apply(SpatialEncoder(config, DIM), params, *arguments)
    assert not np.allclose(kept[0], kept[1], atol=1e-2)

    nobody = (*arguments[:3], SpatialMask.from_validity(LANES, jnp.zeros(5, bool)))
    transform_only = SpatialEncoder(dataclasses.replace(config, fusions=()), DIM)
    np.testing.assert_array_equal(apply(module, params, *nobody), apply(transform_only, params, *nobody))


def test_point_queries_keep_the_original_once():
    """Eq. (3) adds L_Feat after the last spatial layer, not in each."""
    module, params, arguments = spatial(dataclasses.replace(CONFIG, spatial_depth=2, residual="none"))
    point = SpatialEncoder(module.config, DIM, "point")
    difference = apply(point, params, *arguments) - apply(module, params, *arguments)
    np.testing.assert_allclose(difference, arguments[0], atol=1e-6)


@pytest.mark.parametrize("fusions", [ALL_FUSIONS, LANE_FUSIONS])
def test_lane_queries_are_equivariant(fusions):
    module, params, (lanes, position, traffic, mask) = spatial(dataclasses.replace(CONFIG, fusions=fusions))
    order = np.random.default_rng(0).permutation(LANES)
    out = apply(module, params, lanes, position, traffic, mask)
    permuted = apply(module, params, lanes[order], position[order], traffic, mask)
    np.testing.assert_allclose(out[order], permuted, rtol=2e-5, atol=2e-5)


def test_gradient_against_finite_differences():
    module, params, (lanes, position, traffic, mask) = spatial(dataclasses.replace(CONFIG, fusions=ALL_FUSIONS))

    @jax.jit
    def total(t):
        return jnp.sin(apply(module, params, lanes, position, t, mask)).sum()

    direction = jnp.asarray(np.random.default_rng(1).normal(size=traffic.shape).astype(np.float32))
    slope = (total(traffic + 1e-2 * direction) - total(traffic - 1e-2 * direction)) / 2e-2
    assert float(slope) == pytest.approx(float((jax.grad(total)(traffic) * direction).sum()), rel=1e-2, abs=1e-2)


def test_the_example_of_a_model_of_ones_own_reads_traffic():
    page = (ROOT / "docs/your_data.md").read_text("utf-8")
    (code,) = [part for part in re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.M) if "WithTraffic" in part]
    names: dict = {}
    exec(compile(code, "your_data.md", "exec"), names)
    rng = np.random.default_rng(0)
    queries = jnp.asarray(rng.normal(size=(LANES, 64)).astype(np.float32))
    lines = jnp.asarray(rng.uniform(size=(LANES, 11, 2)).astype(np.float32))
    model = names["WithTraffic"](HostSpec(64, PerceptionRange(), BevGrid().range))
    some, other = (jax.tree.map(jnp.asarray, make_flow(seed, instances=4)) for seed in (1, 2))
    params = random_params(model.init, some, queries, queries, lines)
    assert set(params["params"]) == {"temporal_encoder", "spatial_encoder_0"}  # as in a host, whose parameters fit
    outputs = [np.asarray(apply(model, params, flow, queries, queries, lines)) for flow in (some, other)]
    assert outputs[0].shape == (LANES, 64)
    assert np.abs(outputs[0] - outputs[1]).max() > 1e-3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"position": jnp.zeros((1, DIM))}, "position of the queries has shape"),
        (
            {"reference": jnp.zeros((1, 11, 2))},
            rf"reference .* shape \(1, 11, 2\), expected \(Q, P, 2 or 3\) with Q = {LANES}",
        ),
        ({"reference": jnp.zeros((LANES, 2))}, "reference of the queries has shape"),
        ({"reference": jnp.zeros((LANES, 11, 4))}, "reference of the queries has shape"),
        ({"mask": jnp.ones((1, LANES), bool)}, "mask of the queries has shape"),
    ],
)
def test_queries_that_do_not_fit_together_are_named(change, said):
    """Regression: broadcasting hid that all queries had one place."""
    spec = HostSpec(DIM, PerceptionRange(), BevGrid().range)
    right = HostQueries(jnp.zeros((LANES, DIM)), jnp.zeros((LANES, DIM)), jnp.zeros((LANES, 11, 2)))
    right.check(spec)
    with pytest.raises(ValueError, match=said):
        right._replace(**change).check(spec)


@pytest.mark.parametrize("wrong", ["features", "position"])
def test_queries_of_other_channels_than_the_host_says_are_named(wrong):
    spec = HostSpec(DIM, PerceptionRange(), BevGrid().range)
    prior = TrafficFlowConfig(prior=PRIOR, module=CONFIG).build(spec)
    sizes = {"features": DIM, "position": DIM} | {wrong: DIM + 4}
    queries = HostQueries(*(jnp.zeros((LANES, size)) for size in sizes.values()), jnp.zeros((LANES, 11, 2)))
    tokens = EncodedTrafficFlow(jnp.zeros((5, CONFIG.width)), prior.select(make_flow(0, instances=4)))
    found = re.escape(
        f"{wrong} of the queries have shape ({LANES}, {DIM + 4}), expected (Q, HostSpec.dim) = (Q, {DIM})"
    )
    with pytest.raises(ValueError, match=found):
        prior.into_queries(tokens, 0, queries)
