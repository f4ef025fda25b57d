"""Matching: against scipy called directly, padding, batching, sizes 0 and 1."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from tflane_jax.matching import match

BACKENDS = ["scipy", "jax"]


def _total(cost, assignment):
    n = np.arange(cost.shape[1])[np.asarray(assignment.matched)]
    return cost[np.asarray(assignment.query)[n], n].sum()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("queries", "targets", "count"), [(5, 5, 5), (8, 3, 2), (3, 7, 7), (3, 7, 5), (1, 1, 1), (6, 4, 0)]
)
def test_least_cost(backend, queries, targets, count):
    rng = np.random.default_rng([queries, targets, count])
    cost = rng.normal(size=(queries, targets)).astype(np.float32)
    valid = rng.permutation(np.arange(targets) < count)
    got = match(jnp.asarray(cost), jnp.asarray(valid), backend)
    rows, columns = linear_sum_assignment(cost[:, valid])
    assert _total(cost, got) == pytest.approx(cost[:, valid][rows, columns].sum(), rel=1e-5)
    assert np.asarray(got.matched).sum() == min(queries, count)
    assert not np.asarray(got.matched)[~valid].any()
    used = np.asarray(got.query)[np.asarray(got.matched)]
    assert len(set(used.tolist())) == len(used)


@pytest.mark.parametrize("backend", BACKENDS)
def test_padding_is_never_read(backend):
    rng = np.random.default_rng(0)
    cost = rng.normal(size=(2, 6, 5)).astype(np.float32)
    valid = np.array([[True, False, True, False, True], [False] * 5])
    dirty = np.where(valid[:, None], cost, np.nan)
    clean, filled = (match(jnp.asarray(c), jnp.asarray(valid), backend) for c in (cost, dirty))
    np.testing.assert_array_equal(clean.query, filled.query)
    np.testing.assert_array_equal(clean.matched, filled.matched)


@pytest.mark.parametrize("backend", BACKENDS)
def test_costs_of_padding_leave_small_differences_of_others_alone(backend):
    """One query, three targets and padding at the limit, next to which float32 holds no differences of hundredths."""
    cost, valid = jnp.array([[0.03, 0.01, 0.02, 1e6]]), jnp.array([True, True, True, False])
    assert match(cost, valid, backend).matched.tolist() == [False, True, False, False]


@pytest.mark.parametrize(
    ("problems", "queries", "targets"), [(40, 12, 9), pytest.param(12, 48, 40, marks=pytest.mark.slow), (6, 5, 8)]
)
def test_backends_agree_on_many_problems(problems, queries, targets):
    rng = np.random.default_rng(1)
    cost = jnp.asarray(rng.normal(size=(problems, queries, targets)).astype(np.float32))
    valid = jnp.asarray(rng.random((problems, targets)) < 0.6)
    host, device = (match(cost, valid, b) for b in BACKENDS)
    np.testing.assert_array_equal(host.query, device.query)


def test_backends_agree_on_lanes():
    """Costs of a training: distances of lanes that are alike, which differ little."""
    rng = np.random.default_rng(2)
    true = np.cumsum(rng.normal(size=(4, 1, 30, 33)), -1)
    found = true[:, :, rng.integers(0, 30, 48)] + rng.normal(size=(4, 3, 48, 33))
    cost = jnp.asarray(0.025 * np.abs(found[:, :, :, None] - true[:, :, None]).sum(-1), jnp.float32)
    valid = jnp.asarray(np.arange(30) < np.array([30, 22, 1, 0])[:, None, None])
    host, device = (match(cost, valid, b) for b in BACKENDS)
    np.testing.assert_array_equal(host.query, device.query)
    np.testing.assert_array_equal(host.matched, device.matched)


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0)])
def test_nothing_to_match(shape):
    got = match(jnp.zeros(shape), jnp.ones(shape[1], bool))
    assert got.query.shape == (shape[1],)
    assert not got.matched.any()


def test_one_callback_for_all_axes(monkeypatch):
    from tflane_jax import matching

    calls = []
    host = matching._assign_on_host
    monkeypatch.setattr(matching, "_assign_on_host", lambda c, v: calls.append(c.shape) or host(c, v))
    rng = np.random.default_rng(2)
    cost = rng.normal(size=(3, 4, 2, 6, 5)).astype(np.float32)  # seeds, batch, layers, queries, targets
    valid = rng.random((4, 5)) < 0.7

    def layers(c, v):
        return match(c, jnp.broadcast_to(v, (2, 5)), "scipy")

    nested = jax.jit(jax.vmap(jax.vmap(layers), in_axes=(0, None)))
    got = nested(cost, valid)
    assert len(calls) == 1
    for index in np.ndindex(3, 4, 2):
        rows, columns = linear_sum_assignment(cost[index][:, valid[index[1]]])
        expected = np.zeros(valid[index[1]].sum(), int)
        expected[columns] = rows
        np.testing.assert_array_equal(np.asarray(got.query)[index][valid[index[1]]], expected)


def test_diverged_costs_give_some_assignment():
    cost = jnp.array([[jnp.nan, jnp.inf], [-jnp.inf, jnp.nan], [0.0, 1.0]])
    got = match(cost, jnp.ones(2, bool))
    assert got.matched.all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_cost_that_is_no_number_is_the_highest(backend):
    got = match(jnp.array([[jnp.nan, 2.0], [5.0, jnp.nan], [jnp.nan, 1.0]]), jnp.ones(2, bool), backend)
    assert got.query.tolist() == [1, 2]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("offset", [-50.0, 50.0])
def test_no_query_is_idle_where_targets_are_left_over(backend, offset):
    """However much it costs: two queries, and three targets in five places."""
    cost = offset + np.random.default_rng(4).uniform(size=(2, 5)).astype(np.float32)
    valid = np.array([True, False, True, True, False])
    got = match(jnp.asarray(cost), jnp.asarray(valid), backend)
    rows, columns = linear_sum_assignment(cost[:, valid])
    assert got.matched.sum() == 2
    assert _total(cost, got) == pytest.approx(cost[:, valid][rows, columns].sum(), rel=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_64_bit_mode_gives_the_same(backend):
    rng = np.random.default_rng(3)
    cost, valid = rng.normal(size=(3, 4, 6)).astype(np.float32), np.arange(6) < np.array([[6], [3], [0]])
    expected = match(jnp.asarray(cost), jnp.asarray(valid), backend)
    with jax.enable_x64(True):
        got = jax.jit(match, static_argnums=2)(cost, valid, backend)
    assert got.query.dtype == np.int32
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def test_other_backends_are_refused():
    """Regression: any other word was the host's."""
    for backend in ("device", "Jax", None):
        with pytest.raises(ValueError, match="it must be 'scipy' or 'jax'"):
            match(jnp.zeros((3, 2)), jnp.ones(2, bool), backend)
