"""Priors plug into any host: a toy prior in one file and one line of the list; absent priors change no bit."""

from dataclasses import dataclass, replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.models.cases import (
    BASELINE,
    CAMERA,
    CAMERA_DETR,
    CAMERA_TOPONET,
    SEGMENTS,
    make_camera_example,
    make_example,
)
from tests.models.toy_prior import CrossingsConfig, with_crossings
from tests.parameters import random_params
from tests.shared import assert_same
from tflane_jax.errors import UserError
from tflane_jax.limits import Rules, SettingError, splits
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.prior import HostQueries, HostSpec, Prior, fuse_priors
from tflane_jax.models.priors import PriorsConfig, bev_hook, encode, fuse_into_queries, observe, observe_clip
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig, TrafficFlowModuleConfig
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask


@dataclass(frozen=True)
class WithToy(PriorsConfig):
    """The list of priors with one more line."""

    crossings: CrossingsConfig | None = None


@dataclass(frozen=True)
class Demanding(CrossingsConfig):
    """A prior with rules for its host."""

    def host_limits(self, host: HostSpec) -> Rules:
        yield splits("width", self.width, "the channels of a query", host.dim)
        yield "width", self.width == host.bev_dim, f"{host.bev_dim}, the channels of BEV features"


FLOW = TrafficFlowConfig(
    prior=TrafficFlowPriorConfig(max_instances=5), module=TrafficFlowModuleConfig(width=8, heads=2, bands=3)
)
HOSTS = {
    "toponet": (BASELINE, make_example),
    "detr": (
        BevFormerDetrConfig(encoder=BASELINE.encoder, decoder=replace(BASELINE.decoder, refine="fixed"), elements=None),
        make_example,
    ),
    "camera toponet": (CAMERA_TOPONET, make_camera_example),
    "camera detr": (CAMERA_DETR, make_camera_example),
    "lanesegnet": (SEGMENTS, make_example),
    "camera lanesegnet": (replace(SEGMENTS, encoder=CAMERA), make_camera_example),
}


@pytest.mark.parametrize("name", HOSTS)
@pytest.mark.parametrize(("width", "rule"), [(3, "a divisor of the channels of a query"), (1, "[0-9]+, the channels")])
def test_what_a_new_prior_demands_is_checked_by_every_host(name, width, rule):
    """Regression: the hosts themselves named the priors for which they had rules."""
    host = replace(HOSTS[name][0], priors=WithToy(crossings=Demanding(width=width)))
    with pytest.raises(SettingError, match=rf"priors\.crossings\.width is {width}: it must be {rule}"):
        host.build()


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTS)
def test_a_new_prior_plugs_into_every_host_by_both_hooks(name):
    host, make = HOSTS[name]
    task = LaneGraphTask(replace(host, priors=WithToy(traffic_flow=FLOW, crossings=CrossingsConfig())))
    example = make(0)
    params = random_params(task.init, with_crossings(example, 2), spread=0.2)
    into_queries = {path for path in params if path.startswith("crossings_to_queries")}
    assert len(into_queries) == host.decoder.layers
    assert "crossings_0" in str(jax.tree.structure(params["encoder"]))
    predict = jax.jit(task.predict)
    absent = predict(params, with_crossings(example, 0))
    assert_same(absent, predict(params, with_crossings(example, 0, filler=np.nan)))
    one, two = (predict(params, with_crossings(example, count)) for count in (1, 2))
    assert_same(one, predict(params, with_crossings(example, 1, filler=np.nan)))
    for a, b in ((absent, one), (one, two)):
        assert not np.array_equal(jax.tree.leaves(a)[0], jax.tree.leaves(b)[0])  # points

    # Without crossings, the host computes what it computes without the prior.
    plain = LaneGraphTask(replace(host, priors=PriorsConfig(traffic_flow=FLOW)))
    shapes = jax.eval_shape(plain.init, jax.random.key(0), example)
    rest = jax.tree_util.tree_map_with_path(lambda path, _: _at(params, path), shapes)
    without = jax.jit(plain.predict)(rest, example)
    assert_same(without, absent)


def _at(tree, path):
    for key in path:
        tree = tree[key.key]
    return tree


@pytest.mark.slow
def test_training_reaches_the_parameters_of_a_new_prior():
    task = LaneGraphTask(replace(BASELINE, priors=WithToy(crossings=CrossingsConfig())))
    batch = jax.tree.map(jnp.asarray, stack_examples([with_crossings(make_example(i), 2, i) for i in range(2)]))
    params = random_params(task.init, with_crossings(make_example(0), 2), spread=0.2)
    gradient, terms = jax.jit(jax.grad(task.loss, has_aux=True))(params, batch, jax.random.key(0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((gradient, terms)))
    assert np.abs(gradient["crossing_tokens"]["kernel"]).max() > 0
    assert "areas" in task.parts  # what a prior reads is loaded


@pytest.mark.slow
def test_memories_go_from_frame_to_frame_of_a_clip_and_of_a_stream():
    spec = BASELINE.spec
    priors = WithToy(traffic_flow=FLOW, crossings=CrossingsConfig()).build(spec)
    frames = [with_crossings(make_example(i), count) for i, count in enumerate((1, 0, 2))]
    frames = [frame.replace(has_previous=np.array(i > 0)) for i, frame in enumerate(frames)]
    clip = jax.tree.map(jnp.asarray, stack_examples(frames))
    together = observe_clip(priors, clip)
    np.testing.assert_array_equal(together["crossings"][0][:, 0, -1], [0.0, 1.0, 1.0])
    task = LaneGraphTask(replace(BASELINE, priors=WithToy(crossings=CrossingsConfig())), clip=3)
    memories = task.start().priors
    for i, frame in enumerate(frames):
        found, memories = observe(task.model.build_priors(), frame, memories)
        assert_same(found["crossings"], jax.tree.map(lambda leaf, i=i: leaf[i], together["crossings"]))
    params = random_params(task.init, clip, spread=0.2)
    _, answers = jax.jit(lambda p, c: lax.scan(lambda m, e: task.step(p, m, e), task.start(), c))(params, clip)
    alone = jax.jit(task.predict)(params, frames[2])
    assert not np.array_equal(answers.centerlines.points[2], alone.centerlines.points)


def test_cells_are_those_of_the_features_row_by_row():
    """Regression: the number of rows and columns was guessed from coordinates that the encoder gave."""
    spec, seen = BASELINE.spec, []

    class Reading(Prior):
        def into_bev(self, tokens, layer, cells):
            seen.append((layer, cells))
            return 2.0 * cells.features

    bev = jnp.arange(24.0).reshape(2, 4, 3)
    fuse = bev_hook({"mine": Reading()}, {"mine": None}, spec)
    np.testing.assert_array_equal(fuse_priors(fuse, 1, bev, lambda: jnp.ones((8, 3))), 2.0 * bev)
    ((layer, cells),) = seen
    assert (layer, cells.grid.rows, cells.grid.columns, cells.grid.range) == (1, 2, 4, spec.bev_range)
    assert (cells.position == 1.0).all()
    (dx, dy), (x0, y0) = cells.grid.cell, spec.bev_range.low(2)
    for row, column in np.ndindex(2, 4):
        center = x0 + (column + 0.5) * dx, y0 + (row + 0.5) * dy
        np.testing.assert_allclose(cells.centers[4 * row + column], center, rtol=1e-6)
        np.testing.assert_array_equal(cells.features[4 * row + column], bev[row, column])


def test_without_a_hook_no_position_is_encoded():
    bev = jnp.arange(24.0).reshape(2, 4, 3)
    np.testing.assert_array_equal(fuse_priors(None, 0, bev, lambda: pytest.fail("encoded positions")), bev)


@pytest.mark.parametrize(("found", "shown"), [(jnp.zeros((6, 1)), r"an array of shape \(6, 1\)"), (None, "NoneType")])
def test_what_a_prior_makes_of_the_queries_has_their_shape(found, shown):
    """Regression: one channel was broadcast to all."""

    class Careless(Prior):
        def into_queries(self, tokens, layer, queries):
            return found

    queries = HostQueries(jnp.zeros((6, 16)), jnp.zeros((6, 16)), jnp.zeros((6, 1, 2)))
    with pytest.raises(UserError, match=rf"into_queries of the prior mine returned {shown}, expected \(6, 16\)"):
        fuse_into_queries({"mine": Careless()}, {"mine": None}, 0, queries)


def test_the_hosts_own_mask_keeps_groups_of_queries_apart():
    """MapTRv2's one-to-many queries must not change its one-to-one queries, also through the traffic-flow module."""
    spec = HostSpec(16, BASELINE.range, BASELINE.spec.bev_range, "point")
    priors = PriorsConfig(traffic_flow=FLOW).build(spec)
    observation = observe(priors, make_example(0), {})[0]
    group = jnp.arange(6) < 3
    mask = group[:, None] == group[None, :]

    class Host(nn.Module):
        @nn.compact
        def __call__(self, features, mask):
            bound = PriorsConfig(traffic_flow=FLOW).build(spec)
            tokens = encode(bound, observation, deterministic=True)
            queries = HostQueries(features, jnp.zeros_like(features), jnp.zeros((len(features), 1, 2)), mask)
            return fuse_into_queries(bound, tokens, 0, queries)

    features = jax.random.normal(jax.random.key(1), (6, 16))
    host = Host()
    params = random_params(host.init, features, mask)
    apply = jax.jit(host.apply)
    out = apply(params, features, mask)
    changed = features.at[4].add(3.0)
    np.testing.assert_array_equal(apply(params, changed, mask)[:3], out[:3])
    assert not np.array_equal(apply(params, changed, None)[:3], out[:3])


@pytest.mark.parametrize("where", ["unnamed", "made on the spot"])
def test_a_module_that_a_prior_does_not_name_is_an_error_that_names_the_prior(where):
    """Regression: Flax's error told of unbound modules, and of neither prior nor remedy."""

    class Own(Prior):
        def __init__(self):
            self.tokens = nn.Dense(2)

        def observe(self, example, memory):
            return jnp.ones(3), None

        def encode(self, observation, *, deterministic):
            return self.tokens(observation) if where == "unnamed" else nn.Dense(2)(observation)

    @dataclass(frozen=True)
    class OwnConfig:
        def build(self, host):
            return Own()

    @dataclass(frozen=True)
    class OwnPriors(PriorsConfig):
        own: OwnConfig = OwnConfig()

    model = replace(BASELINE, priors=OwnPriors()).build()
    with pytest.raises(UserError, match=r"encode of the prior own calls a module .*modules\(\), which has none"):
        jax.eval_shape(model.init, jax.random.key(0), make_example(0))
