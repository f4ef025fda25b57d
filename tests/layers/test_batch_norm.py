"""Batch norm: statistics of the stacked batch, of its valid views alone, and of one example without a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.layers.batch_norm import BATCH_AXIS, BatchNorm


def one_norm(x, valid=None, *, train, **options):
    norm = BatchNorm(**options)
    variables = norm.init(jax.random.key(0), x[0], train=train)
    apply = lambda one, valid: norm.apply(variables, one, train=train, valid=valid, mutable=["batch_stats"])  # noqa: E731
    return jax.vmap(apply, axis_name=BATCH_AXIS, out_axes=(0, None))(x, valid)


def test_batch_statistics_are_those_of_the_stacked_batch():
    x = np.random.default_rng(0).normal(2.0, 3.0, (4, 5, 6, 2)).astype(np.float32)
    out, state = one_norm(jnp.asarray(x), train=True)
    mean, variance = x.mean((0, 1, 2)), x.var((0, 1, 2))
    np.testing.assert_allclose(out, (x - mean) / np.sqrt(variance + 1e-5), rtol=1e-4, atol=1e-5)
    count = x.size // 2
    np.testing.assert_allclose(state["batch_stats"]["mean"], 0.1 * mean, rtol=1e-5)
    np.testing.assert_allclose(state["batch_stats"]["var"], 0.9 + 0.1 * variance * count / (count - 1), rtol=1e-5)


@pytest.mark.parametrize("options", [{"train": False}, {"train": True, "frozen": True}])
def test_running_statistics_stay_without_training(options):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4, 2)).astype(np.float32))
    out, state = one_norm(x, **options)
    np.testing.assert_allclose(out, x / np.sqrt(1 + 1e-5), rtol=1e-6)
    np.testing.assert_array_equal(state["batch_stats"]["mean"], np.zeros(2))
    np.testing.assert_array_equal(state["batch_stats"]["var"], np.ones(2))


def test_a_frozen_norm_has_nothing_to_learn():
    variables = BatchNorm(frozen=True).init(jax.random.key(0), jnp.zeros((1, 3)), train=True)
    assert "params" not in variables
    assert set(variables["batch_stats"]) == {"mean", "var", "scale", "bias"}


def test_one_value_does_not_divide_by_zero():
    out, state = one_norm(jnp.full((1, 1, 2), 7.0), train=True)
    np.testing.assert_array_equal(out, np.zeros((1, 1, 2)))
    np.testing.assert_allclose(state["batch_stats"]["var"], [0.9, 0.9])


def test_works_for_one_example_without_a_batch():
    norm, x = BatchNorm(), jnp.asarray(np.random.default_rng(1).normal(size=(6, 2)).astype(np.float32))
    variables = norm.init(jax.random.key(0), x, train=True)
    out, _ = norm.apply(variables, x, train=True, mutable=["batch_stats"])
    np.testing.assert_allclose(out.mean(0), [0, 0], atol=1e-6)


def views():
    """Return features of two examples with three views each, of which three are valid, and which."""
    x = np.random.default_rng(2).normal(2.0, 3.0, (2, 3, 4, 5, 2)).astype(np.float32)
    return x, np.array([[True, False, True], [False, True, False]])


@pytest.mark.parametrize("padding", [0.0, 1e4])
def test_statistics_are_those_of_the_valid_views(padding):
    x, valid = views()
    shown = x[valid]
    x[~valid] = padding
    out, state = one_norm(jnp.asarray(x), jnp.asarray(valid), train=True)
    expected, alone = one_norm(jnp.asarray(shown[None]), train=True)
    np.testing.assert_allclose(out[valid], expected[0], rtol=1e-5, atol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), state, alone)


def test_all_views_valid_is_as_without_a_mask():
    x, _ = views()
    masked, plain = one_norm(jnp.asarray(x), jnp.ones((2, 3), bool), train=True), one_norm(jnp.asarray(x), train=True)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), masked, plain)


def test_a_batch_without_a_view_leaves_the_running_statistics():
    x, valid = views()
    out, state = one_norm(jnp.asarray(x), jnp.zeros_like(valid), train=True)
    assert np.isfinite(out).all()
    np.testing.assert_array_equal(state["batch_stats"]["mean"], np.zeros(2))
    np.testing.assert_array_equal(state["batch_stats"]["var"], np.ones(2))


def test_no_gradient_comes_from_padding_to_the_valid_views():
    x, valid = views()
    weight = np.random.default_rng(3).normal(size=x.shape) * valid[..., None, None, None]
    loss = lambda x: (one_norm(x, jnp.asarray(valid), train=True)[0] * weight).sum()  # noqa: E731
    gradient = np.asarray(jax.jit(jax.grad(loss))(jnp.asarray(x)))
    assert np.abs(gradient[valid]).max() > 0.01
    assert not gradient[~valid].any()
