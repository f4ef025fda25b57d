"""Dropout of attention weights, at once and in blocks of queries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from tflane_jax.layers import attention
from tflane_jax.layers.attention import MultiHeadAttention, WeightDropout, attention_probabilities, masked_attention

RATE, QUERIES, KEYS = 0.3, 6, 5


def arrays(dtype=np.float32, queries=QUERIES, keys=KEYS):
    rng = np.random.default_rng(20)
    query, key, value = (jnp.asarray(rng.normal(size=(2, n, 4)), dtype) for n in (queries, keys, keys))
    return query, key, value, jnp.asarray(rng.random((queries, keys)) < 0.6).at[1].set(False)


class Dropping(WeightDropout):
    """Dropout with a stream of its own, in place of a module's."""

    def stream(self):
        return jax.random.key(3)


DROP = Dropping(RATE, deterministic=False)


@pytest.fixture
def blocks(monkeypatch):
    """Let two queries be a block."""
    monkeypatch.setattr(attention, "BLOCK", 2 * KEYS)


def kept(blocks):
    """Return the factors of dropout that blocks of queries draw."""
    streams = jax.random.split(DROP.stream(), blocks)
    factors = [jax.random.bernoulli(stream, 1 - RATE, (2, QUERIES // blocks, KEYS)) for stream in streams]
    return jnp.concatenate(factors, 1) / (1 - RATE)


def test_weights_can_be_dropped():
    query, key, value, mask = arrays()
    plain = masked_attention(query, key, value, mask)
    np.testing.assert_allclose(masked_attention(query, key, value, mask, lambda w: w), plain, rtol=1e-5, atol=1e-6)
    first = masked_attention(query, key, value, mask, lambda weights: weights.at[..., 1:].set(0.0))
    weights = attention_probabilities(query, key, mask)
    np.testing.assert_allclose(first, weights[..., :1] * value[:, :1], rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize("masked", [True, False])
def test_blocks_drop_weights_as_if_all_were_held(masked):
    query, key, value, mask = arrays()
    mask = mask if masked else None

    def held(query, key, value):
        weights = attention_probabilities(query, key, mask) * kept(3)
        return jnp.einsum("hqk,hke->hqe", weights, value)

    out, pull = jax.vjp(held, query, key, value)
    got, pull_blocks = jax.vjp(jax.jit(lambda *x: masked_attention(*x, mask, DROP)), query, key, value)
    np.testing.assert_allclose(got, out, rtol=1e-5, atol=1e-6)
    gradient = jnp.cos(jnp.arange(out.size, dtype=jnp.float32)).reshape(out.shape)
    for one, other in zip(pull_blocks(gradient), pull(gradient), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("blocks")
def test_gradients_of_dropping_blocks_match_finite_differences():
    with jax.enable_x64(True):
        query, key, value, mask = arrays(np.float64)
        check_grads(jax.jit(lambda *x: masked_attention(*x, mask, DROP)), (query, key, value), 1, ["rev"], 1e-6, 1e-6)


@pytest.mark.usefixtures("blocks")
def test_padding_of_nan_changes_no_dropping_block():
    query, key, value, _ = arrays()
    mask = jnp.ones((1, KEYS), bool).at[0, 3:].set(False)

    def run(fill):
        filled = (x.at[:, 3:].set(fill) for x in (key, value))
        return jax.value_and_grad(lambda *x: masked_attention(*x, mask, DROP).sum(), (0, 1, 2))(query, *filled)

    jax.tree.map(np.testing.assert_array_equal, run(np.nan), run(7.0))


@pytest.mark.usefixtures("blocks")
def test_a_module_draws_other_weights_with_every_key():
    module, x = MultiHeadAttention(8, 2, dropout=RATE), arrays()[0].reshape(QUERIES, 8)
    params = module.init(jax.random.key(0), x, x, x)

    def run(seed, **given):
        return module.apply(params, x, x, x, rngs={"dropout": jax.random.key(seed)}, **given)

    np.testing.assert_array_equal(run(1, deterministic=False), run(1, deterministic=False))
    assert np.abs(run(1, deterministic=False) - run(2, deterministic=False)).max() > 1e-3
    np.testing.assert_array_equal(run(1), module.apply(params, x, x, x))
    many = jax.jit(jax.vmap(lambda seed: run(seed, deterministic=False)))(jnp.arange(400)).mean(0)
    np.testing.assert_allclose(many, run(1), atol=0.1)


def test_large_problems_hold_no_weights():
    """Regression: dropout kept the weights of all pairs, gigabytes at the sizes of the papers."""
    shapes = [jax.ShapeDtypeStruct((2, 8192, 4), np.float32)] * 3
    gradient = jax.jit(jax.grad(lambda *x: masked_attention(*x, None, DROP).sum(), (0, 1, 2)))
    weights = 4 * 2 * 8192**2
    assert gradient.lower(*shapes).compile().memory_analysis().temp_size_in_bytes < weights / 8
