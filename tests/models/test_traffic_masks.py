"""Variants of the TFM's masks: what is out of sight has no influence, whatever it holds."""

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.parameters import random_params
from tests.slow import with_slow
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.models.prior import HostQueries, HostSpec
from tflane_jax.models.traffic_flow_module import (
    ALL_FUSIONS,
    LANE_FUSIONS,
    EncodedTrafficFlow,
    SpatialEncoder,
    TemporalLayer,
    TrafficFlowConfig,
    TrafficFlowModuleConfig,
)
from tflane_jax.models.traffic_masks import TrafficMaskConfig, spatial_mask, temporal_mask
from tflane_jax.priors.traffic_flow import SelectedTracks

DIM, RANGE = 8, PerceptionRange((-50.0, 50.0), (-25.0, 25.0), (-3.0, 3.0))
LOCAL = {
    "window": TrafficMaskConfig(window=6.0),
    "nearest": TrafficMaskConfig(nearest=1),
    "heads": TrafficMaskConfig(head_windows=(6.0, 4.0)),
}
VARIANTS = {"paper": TrafficMaskConfig(), "joint": TrafficMaskConfig(softmax="joint"), **LOCAL}
VARIANTS["all of them"] = TrafficMaskConfig("joint", 30.0, 2, (6.0, 90.0), "causal")

# Lanes along x at y = 10 and y = -10; a vehicle on each, and one that is not valid.
LANES = np.stack([np.stack([np.linspace(-20, 20, 5), np.full(5, y)], -1) for y in (10.0, -10.0)])
TRACKS = np.stack([np.stack([np.linspace(0, 12, 3), np.full(3, y)], -1) for y in (10.0, -10.0, 10.0)])


def tracks():
    position = np.concatenate([TRACKS, np.zeros((3, 3, 1))], -1)
    valid = np.array([True, True, False])
    frame_valid = np.broadcast_to(valid[:, None], (3, 3)).copy()
    frame_valid[0, 0] = False
    return SelectedTracks(
        position=jnp.asarray(np.where(frame_valid[..., None], position, 0.0)),
        heading=jnp.asarray(np.where(frame_valid[..., None], [1.0, 0.0], 0.0)),
        size=jnp.ones((3, 3)),
        category=jnp.zeros(3, int),
        frame_valid=jnp.asarray(frame_valid),
        valid=jnp.asarray(valid),
        weight=jnp.asarray(valid, float),
        index=jnp.zeros(3, int),
    )


def queries(seed=0):
    rng = np.random.default_rng(seed)
    features, position = (jnp.asarray(rng.normal(size=(2, DIM)), jnp.float32) for _ in range(2))
    reference = RANGE.normalise(np.concatenate([LANES, np.zeros((2, 5, 1))], -1))
    return HostQueries(features, position, jnp.asarray(reference))


def mask_of(config):
    return spatial_mask(config, queries(), tracks(), RANGE)


@pytest.mark.parametrize("name", LOCAL)
def test_lanes_see_the_vehicles_on_them(name):
    mask = mask_of(LOCAL[name])
    assert np.asarray(mask.lane_traffic).reshape(-1, 2, 3)[0].tolist() == [[True, False, False], [False, True, False]]
    assert np.asarray(mask.traffic_lane).reshape(-1, 3, 2)[0].tolist() == [[True, False], [False, True], [False, False]]
    narrow = mask_of(replace(LOCAL[name], window=0.01))  # the vehicles drive on the lines themselves
    np.testing.assert_array_equal(narrow.lane_traffic, mask.lane_traffic)


def test_without_restrictions_it_is_the_papers_mask():
    mask = mask_of(TrafficMaskConfig())
    assert mask.lane_traffic.tolist() == [[True, True, False]]
    assert mask.lane_lane is None


def encoder(name, fusions):
    masking = VARIANTS[name]
    module = SpatialEncoder(TrafficFlowModuleConfig(fusions, heads=2, masking=masking), DIM)
    traffic = jnp.asarray(np.random.default_rng(3).normal(size=(3, DIM)), jnp.float32)
    asked = queries()
    arguments = (asked.features, asked.position, traffic, mask_of(masking))
    return jax.jit(module.apply), random_params(module.init, *arguments), arguments


@pytest.mark.parametrize("fusions", [pytest.param(LANE_FUSIONS, marks=pytest.mark.slow), ALL_FUSIONS])
@pytest.mark.parametrize("name", with_slow(VARIANTS, quick=["paper", "all of them"]))
def test_padding_changes_nothing_and_gradients_are_finite(name, fusions):
    apply, params, (features, position, traffic, mask) = encoder(name, fusions)
    clean, holes = apply(params, features, position, traffic, mask), traffic.at[2].set(jnp.nan)
    np.testing.assert_array_equal(apply(params, features, position, holes, mask), clean)
    gradient = jax.jit(jax.grad(lambda t: (apply(params, features, position, t, mask) ** 2).sum()))(holes)
    assert jnp.isfinite(gradient).all()
    assert (gradient[2] == 0).all()
    assert (gradient[:2] != 0).any()


@pytest.mark.parametrize("name", ["paper", "joint", *LOCAL])
def test_a_lane_hears_only_what_its_mask_allows(name):
    """Without attention between lanes, the vehicle on the other lane is heard only under masks without distances."""
    apply, params, (features, position, traffic, mask) = encoder(name, LANE_FUSIONS)
    alone = mask.replace(lane_lane=jnp.eye(2, dtype=bool))
    clean = apply(params, features, position, traffic, alone)
    moved = apply(params, features, position, traffic.at[0].add(jnp.arange(DIM)), alone)
    changed = (np.asarray(clean) != np.asarray(moved)).any(1)
    assert changed.tolist() == [True, name not in LOCAL]


@pytest.mark.parametrize("name", with_slow(VARIANTS, quick=["paper", "all of them"]))
def test_no_traffic_equals_an_absent_prior(name):
    apply, params, (features, position, traffic, _) = encoder(name, LANE_FUSIONS)
    nobody = tracks().replace(valid=jnp.zeros(3, bool), frame_valid=jnp.zeros((3, 3), bool))
    mask = spatial_mask(VARIANTS[name], queries(), nobody, RANGE)
    found = apply(params, features, position, traffic, mask)
    np.testing.assert_array_equal(apply(params, features, position, traffic * jnp.nan, mask), found)
    absent = spatial_mask(VARIANTS[name], queries(), jax.tree.map(lambda leaf: leaf[:0], nobody), RANGE)
    without = apply(params, features, position, traffic[:0], absent)
    # One softmax adds up lanes and tokens, in an order that depends on their number.
    tolerance = 1e-6 if VARIANTS[name].softmax == "joint" else 0.0
    np.testing.assert_allclose(found, without, rtol=0.0, atol=tolerance)


def test_heads_have_windows_of_their_own():
    mask = mask_of(TrafficMaskConfig(head_windows=(6.0, 90.0)))
    assert mask.lane_traffic.shape == (2, 2, 3)
    assert mask.lane_traffic.sum((1, 2)).tolist() == [2, 4]


class Fusion(nn.Module):
    """The hook of the traffic-flow prior alone, on tokens that stay the same."""

    config: TrafficFlowConfig

    @nn.compact
    def __call__(self, asked):
        tokens = EncodedTrafficFlow(jnp.linspace(-1.0, 1.0, 3 * DIM).reshape(3, DIM), tracks())
        return self.config.build(HostSpec(DIM, RANGE, RANGE, "point")).into_queries(tokens, 0, asked)


# In one softmax for all, tokens read lanes in the first layer and are read in the second.
@pytest.mark.slow
@pytest.mark.parametrize(("name", "depth"), [("paper", 1), ("joint", 2)])
def test_groups_of_queries_hear_nothing_of_each_other(name, depth):
    """MapTRv2's one-to-many group, by way of the road users as well: tokens read lanes, and lanes read tokens."""
    module = TrafficFlowModuleConfig(heads=2, fusions=ALL_FUSIONS, spatial_depth=depth, masking=VARIANTS[name])
    fusion = Fusion(TrafficFlowConfig(module=module))
    # Two queries of the first group, then three of the second.
    many, rows = np.arange(5) >= 2, np.arange(5) % 2
    both = HostQueries(*(leaf[rows] for leaf in queries()[:3]), jnp.asarray(many[:, None] == many[None]), (2, 3))
    both = both._replace(features=both.features + jnp.arange(5.0)[:, None])
    alone = HostQueries(*(leaf[:2] for leaf in both[:3]))
    params = random_params(fusion.init, alone)
    pushed = [both.features.at[group].add(jnp.arange(float(DIM))[None]) for group in (slice(2, None), slice(2))]

    def fused(asked, *changed):
        return [fusion.apply(params, asked._replace(features=x)) for x in (asked.features, *changed)]

    run = jax.jit(lambda: (fused(both, *pushed), fused(alone), fused(both._replace(groups=()), pushed[0])))
    (before, second, first), (single,), leaking = run()
    np.testing.assert_array_equal(before[:2], second[:2])
    np.testing.assert_array_equal(before[2:], first[2:])
    assert np.abs(before[2:] - second[2:]).max() > 0.1
    # As if the first group were alone, which it is in evaluation.
    np.testing.assert_allclose(before[:2], single, atol=1e-5)
    # The host's mask alone does not keep them apart.
    assert np.abs(leaking[0] - leaking[1])[:2].max() > 1e-3


def test_one_softmax_takes_modules_in_any_order_and_all_or_none_of_the_traffics():
    found = []
    for fusions in (LANE_FUSIONS, LANE_FUSIONS[::-1]):
        config = TrafficFlowModuleConfig(fusions, heads=2, spatial_depth=2, masking=VARIANTS["joint"])
        module, asked = SpatialEncoder(config, DIM), queries()
        arguments = asked.features, asked.position, jnp.ones((3, DIM)), mask_of(VARIANTS["joint"])
        found.append(module.apply(random_params(module.init, *arguments), *arguments))
    np.testing.assert_array_equal(*found)
    # Tokens that read lanes without the module T->L would pass groups of queries on to each other.
    config = TrafficFlowModuleConfig(("T->T", "L->T", "L->L"), masking=VARIANTS["joint"])
    with pytest.raises(UserError, match=r"fusions is .*: it must be L->T and L->L, or all four"):
        TrafficFlowConfig(module=config).build(HostSpec(DIM, RANGE, RANGE))


@pytest.mark.parametrize("temporal", ["all", "causal"])
def test_a_frame_hears_later_ones_only_if_it_may(temporal):
    layer = TemporalLayer(8, 2)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3, 8)), jnp.float32)
    mask = temporal_mask(TrafficMaskConfig(temporal=temporal), tracks().frame_valid)
    params, apply = random_params(layer.init, x, mask), jax.jit(layer.apply)
    found, moved = (apply(params, y, mask) for y in (x, x.at[1, 2].add(jnp.arange(8))))
    changed = (np.asarray(found) != np.asarray(moved)).any((0, 2))
    assert changed.tolist() == ([True] * 3 if temporal == "all" else [False, False, True])


@pytest.mark.parametrize(
    ("masking", "message"),
    [
        (
            TrafficMaskConfig(head_windows=(1.0,)),
            r"head_windows is \(1\.0,\): .*each of the 4 heads",
        ),
        (TrafficMaskConfig(head_windows=(1.0, 2.0, 0.0, 3.0)), r"masking\.head_windows is .*above 0"),
        (TrafficMaskConfig(window=-1.0), r"masking\.window is -1\.0"),
        (TrafficMaskConfig(nearest=0), r"masking\.nearest is 0"),
    ],
)
def test_masks_that_fit_nothing_are_refused(masking, message):
    host = HostSpec(DIM, RANGE, RANGE)
    with pytest.raises(UserError, match=message):
        TrafficFlowConfig(module=TrafficFlowModuleConfig(masking=masking)).build(host)
