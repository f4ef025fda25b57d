"""Masked attention against plain loops, finite differences and the libraries' numbers."""

import math
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from tests.shared import random_mask
from tflane_jax.layers import attention
from tflane_jax.layers.attention import MultiHeadAttention, attention_probabilities, masked_attention
from tflane_jax.layers.masks import key_mask, pair_mask

HEADS, D, E = 2, 4, 3


@pytest.fixture(params=["whole", "in blocks"])
def either_way(request, monkeypatch):
    """Run a small problem whole, and cut into blocks of queries as large ones are."""
    if request.param == "in blocks":
        monkeypatch.setattr(attention, "BLOCK", 11)


def arrays(seed, queries, keys, heads=HEADS):
    """Return query, key, value and a gradient of the result."""
    rng = np.random.default_rng(seed)
    shapes = ((heads, queries, D), (heads, keys, D), (heads, keys, E), (heads, queries, E))
    return tuple(jnp.asarray(rng.normal(size=shape).astype(np.float32)) for shape in shapes)


def with_gradients(query, key, value, gradient, mask):
    """Return the result and the gradients of query, key and value."""
    return _with_gradients(query, key, value, gradient, mask, block=attention.BLOCK)


@partial(jax.jit, static_argnames="block")
def _with_gradients(query, key, value, gradient, mask, block):
    assert block == attention.BLOCK
    out, pull = jax.vjp(lambda q, k, v: masked_attention(q, k, v, mask), query, key, value)
    return out, *pull(gradient)


def loop_attention(query, key, value, mask):
    """Attention written as loops over heads, queries and allowed keys, in float64."""
    query, key, value = (np.asarray(x, np.float64) for x in (query, key, value))
    heads, queries, keys = len(query), query.shape[1], key.shape[1]
    allowed = np.ones((heads, queries, keys), bool) if mask is None else np.broadcast_to(mask, (heads, queries, keys))
    out, weights = np.zeros((heads, queries, value.shape[-1])), np.zeros((heads, queries, keys))
    for h in range(heads):
        for i in range(queries):
            seen = [j for j in range(keys) if allowed[h, i, j]]
            exps = [math.exp(query[h, i] @ key[h, j] / math.sqrt(query.shape[-1])) for j in seen]
            for j, e in zip(seen, exps, strict=True):
                weights[h, i, j] = e / sum(exps)
                out[h, i] += weights[h, i, j] * value[h, j]
    return out, weights


SIZES = [(8, 3), (1, 1), (1, 6), (6, 1), (0, 4), (4, 0)]
MASKS = {
    "none": lambda q, k: None,
    "pairs": lambda q, k: random_mask(1, q, k),
    "pairs per head": lambda q, k: random_mask(2, HEADS, q, k),
    "keys": lambda q, k: random_mask(3, 1, k),
    "keys per head": lambda q, k: random_mask(4, HEADS, 1, k),
    "queries": lambda q, k: random_mask(5, q, 1),
    "nothing": lambda q, k: jnp.zeros((1, 1), bool),
}


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize(
    ("queries", "keys", "kind"), [(5, 7, kind) for kind in MASKS] + [(*size, "pairs") for size in SIZES]
)
def test_matches_loops(queries, keys, kind):
    query, key, value, _ = arrays(0, queries, keys)
    mask = MASKS[kind](queries, keys)
    out, weights = loop_attention(query, key, value, mask)
    run = jax.jit(lambda q, k, v, m: (masked_attention(q, k, v, m), attention_probabilities(q, k, m)))
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        got, got_weights = run(query, key, value, mask)
    np.testing.assert_allclose(got, out, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(got_weights, weights, rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("kind", ["none", "pairs", "keys per head"])
def test_gradients_match_finite_differences(kind):
    with jax.enable_x64(True):
        query, key, value, _ = (x.astype(jnp.float64) for x in arrays(1, 5, 7))
        mask = MASKS[kind](5, 7)
        attend = jax.jit(lambda q, k, v: masked_attention(q, k, v, mask))
        check_grads(attend, (query, key, value), 1, ["rev"], 1e-6, 1e-6)


@pytest.mark.usefixtures("either_way")
def test_rows_with_keys_match_the_library():
    query, key, value, gradient = arrays(2, 6, 5)
    mask = random_mask(6, 6, 5).at[:, 0].set(True)

    def library(q, k, v):
        return jax.nn.dot_product_attention(*(x.swapaxes(0, 1) for x in (q, k, v)), mask=mask[None]).swapaxes(0, 1)

    # The library wants as many channels in values as in keys.
    value, gradient = (jnp.concatenate([x, x[..., :1]], -1) for x in (value, gradient))
    out, pull = jax.jit(partial(jax.vjp, library))(query, key, value)
    for got, want in zip(with_gradients(query, key, value, gradient, mask), (out, *pull(gradient)), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("either_way")
def test_queries_without_keys_are_exactly_zero():
    query, key, value, gradient = arrays(3, 6, 5)
    blind = np.array([1, 4])
    mask = random_mask(7, 6, 5).at[:, 2].set(True).at[blind].set(False)
    out, to_query, to_key, to_value = with_gradients(query, key, value, gradient, mask)
    assert not np.any(out[:, blind])
    assert not np.any(to_query[:, blind])
    # They contribute nothing to the gradients of keys and values.
    others = np.setdiff1d(np.arange(6), blind)
    rest = with_gradients(query[:, others], key, value, gradient[:, others], mask[others])
    np.testing.assert_allclose(to_key, rest[2], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(to_value, rest[3], rtol=1e-5, atol=1e-6)

    for leaf in with_gradients(query, key, value, gradient, jnp.zeros((6, 5), bool)):
        assert not np.any(leaf)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("garbage", [np.nan, np.inf, -1e30])
@pytest.mark.parametrize("heads", ["shared", "per head"])
def test_masked_slots_may_hold_anything(garbage, heads):
    query, key, value, gradient = arrays(4, 6, 5)
    valid_queries = np.array([[1, 1, 0, 1, 1, 0], [1, 0, 1, 1, 1, 1]], bool)
    valid_keys = np.array([[1, 0, 1, 1, 0], [0, 1, 1, 1, 1]], bool)
    if heads == "shared":
        valid_queries[1], valid_keys[1] = valid_queries[0], valid_keys[0]
    mask = jax.vmap(pair_mask)(jnp.asarray(valid_queries), jnp.asarray(valid_keys))
    clean = with_gradients(query, key, value, gradient, mask)
    query = jnp.where(valid_queries[..., None], query, garbage)
    key, value = (jnp.where(valid_keys[..., None], x, garbage) for x in (key, value))
    if heads == "shared":
        mask = mask[0]
    for got, want in zip(with_gradients(query, key, value, gradient, mask), clean, strict=True):
        np.testing.assert_array_equal(got, want)
        assert np.isfinite(got).all()


@pytest.mark.usefixtures("either_way")
def test_large_logits_do_not_overflow():
    query, key, value, gradient = arrays(5, 6, 5)
    for leaf in with_gradients(1e4 * query, 1e4 * key, value, gradient, random_mask(8, 6, 5)):
        assert np.isfinite(leaf).all()


@pytest.mark.usefixtures("either_way")
def test_padding_changes_nothing():
    """A padded and an unpadded twin agree."""
    query, key, value, gradient = arrays(6, 6, 5)
    short = with_gradients(query, key[:, :3], value[:, :3], gradient, None)
    padded = with_gradients(query, key, value, gradient, key_mask(jnp.arange(5) < 3))
    for got, want in zip(padded, short, strict=True):
        np.testing.assert_allclose(got[:, : want.shape[1]], want, rtol=1e-5, atol=1e-6)
        assert not np.any(got[:, want.shape[1] :])


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("depth", [1, 2])
def test_vmap_is_a_loop_in_one_trace(depth):
    """Over a batch, and over instances within it, as the temporal encoder runs."""
    shape = (3, 2)[:depth]
    count = math.prod(shape)
    batch = [arrays(10 + i, 6, 5) for i in range(count)]
    masks = [random_mask(20 + i, 6, 5) for i in range(count)]
    stacked = [jnp.stack(x).reshape(*shape, *x[0].shape) for x in (*zip(*batch, strict=True), masks)]

    traces = []

    @jax.jit
    def run(*stacked):
        traces.append(stacked)
        inner = with_gradients if depth == 1 else jax.vmap(with_gradients)
        return jax.vmap(inner)(*stacked)

    run(*stacked[:-1], ~stacked[-1])
    one_by_one = [with_gradients(*example, mask) for example, mask in zip(batch, masks, strict=True)]
    for got, want in zip(run(*stacked), zip(*one_by_one, strict=True), strict=True):
        np.testing.assert_allclose(got.reshape(count, *got.shape[depth:]), np.stack(want), rtol=1e-5, atol=1e-6)
    assert len(traces) == 1


@pytest.mark.usefixtures("either_way")
def test_bfloat16_stays_bfloat16_and_close():
    exact = [x.astype(jnp.bfloat16).astype(jnp.float32) for x in arrays(7, 6, 5)]
    mask = random_mask(9, 6, 5)
    with jax.numpy_dtype_promotion("strict"):
        coarse = with_gradients(*(x.astype(jnp.bfloat16) for x in exact), mask)
    for got, want in zip(coarse, with_gradients(*exact, mask), strict=True):
        assert got.dtype == jnp.bfloat16
        np.testing.assert_allclose(got.astype(np.float32), want, rtol=0.0, atol=0.02 * (1.0 + np.abs(want).max()))


def test_gradients_of_many_blocks_in_bfloat16_are_as_good_as_those_of_one(monkeypatch):
    exact = [x.astype(jnp.bfloat16).astype(jnp.float32) for x in arrays(7, 256, 32)]
    want = with_gradients(*exact, None)[-2:]  # by keys and values, to which every block adds

    def error(block):
        monkeypatch.setattr(attention, "BLOCK", block)
        got = with_gradients(*(x.astype(jnp.bfloat16) for x in exact), None)[-2:]
        return max(np.abs(g.astype(np.float32) - w).max() / np.abs(w).max() for g, w in zip(got, want, strict=True))

    assert error(2 * 32) < 2.0 * error(256 * 32)


@pytest.mark.usefixtures("either_way")
def test_bfloat16_gradients_hold_where_all_values_are_alike():
    """Regression: what all values share changes no weight, but its rounding was in the gradients, up to 7 %."""
    query, key, value, pull = arrays(7, 64, 64)
    common = 10.0 * np.random.default_rng(1).normal(size=(value.shape[0], 1, value.shape[2]))
    every = (query, key, value + common.astype(np.float32), pull)
    exact = [x.astype(jnp.bfloat16).astype(jnp.float32) for x in every]
    found = with_gradients(*(x.astype(jnp.bfloat16) for x in exact), None)[1:3]
    for got, want in zip(found, with_gradients(*exact, None)[1:3], strict=True):
        assert np.linalg.norm(got.astype(np.float32) - want) < 0.02 * np.linalg.norm(want)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**16), size=st.sampled_from([(1, 1), (5, 6)]))
def test_order_of_queries_and_keys_does_not_matter(seed, size):
    queries, keys = size
    rng = np.random.default_rng(seed)
    query, key, value, _ = arrays(seed, queries, keys)
    mask = random_mask(seed, queries, keys)
    rows, columns = rng.permutation(queries), rng.permutation(keys)
    run = jax.jit(masked_attention)
    permuted = run(query[:, rows], key[:, columns], value[:, columns], mask[rows][:, columns])
    np.testing.assert_allclose(permuted, run(query, key, value, mask)[:, rows], rtol=1e-5, atol=1e-6)


@pytest.fixture
def module():
    """Return a module whose biases are not zero, its variables, and tokens of a query and a key side."""
    rng = np.random.default_rng(0)
    query, key = (jnp.asarray(rng.normal(size=(n, 8)).astype(np.float32)) for n in (6, 5))
    module = MultiHeadAttention(8, 2)
    params = jax.jit(module.init)(jax.random.key(0), query, key, key)
    return module, jax.tree.map(lambda x: x + 0.1, params), query, key


def test_module_without_keys_is_zero(module):
    module, params, query, key = module
    assert not np.any(module.apply(params, query, key[:0], key[:0]))
    assert not np.any(module.apply(params, query, key, key, jnp.zeros((6, 5), bool)))
    assert module.apply(params, query[:0], key, key).shape == (0, 8)
    mask = jnp.ones((2, 6, 5), bool).at[:, 3].set(False)
    out = module.apply(params, query, key, key, mask)
    assert not np.any(out[3])
    np.testing.assert_allclose(out[0], module.apply(params, query, key, key)[0], rtol=1e-5, atol=1e-6)


def test_a_slot_is_unseen_only_if_no_head_sees_it(module):
    """Heads with windows of their own: a query that one head alone answers keeps that answer."""
    module, params, query, key = module
    mask = jnp.zeros((2, 6, 5), bool).at[1, :4, :3].set(True).at[0, 0, 4].set(True)
    weights = jax.tree.map(np.asarray, params["params"])
    q, k, v = (
        (np.asarray(x) @ weights[name]["kernel"] + weights[name]["bias"]).reshape(len(x), 2, 4).swapaxes(0, 1)
        for name, x in (("query", query), ("key", key), ("value", key))
    )
    heads = loop_attention(q, k, v, mask)[0].swapaxes(0, 1).reshape(6, 8)
    expected = heads @ weights["output"]["kernel"] + weights["output"]["bias"]
    out = module.apply(params, query, key, key, mask)
    np.testing.assert_allclose(out[:4], expected[:4], rtol=1e-5, atol=1e-5)
    assert not np.any(out[4:])


def test_module_ignores_masked_slots_in_parameter_gradients(module):
    module, params, query, key = module
    valid_query, valid_key = jnp.arange(6) != 2, jnp.arange(5) < 3
    mask = pair_mask(valid_query, valid_key)

    @jax.jit
    def gradients(query, key):
        return jax.grad(lambda p, q, k: (module.apply(p, q, k, k, mask) ** 2).sum(), (0, 1, 2))(params, query, key)

    clean = gradients(query, key)
    dirty = gradients(jnp.where(valid_query[:, None], query, jnp.nan), jnp.where(valid_key[:, None], key, jnp.nan))
    chex.assert_trees_all_equal(dirty, clean)
    chex.assert_tree_all_finite(clean)


def test_module_shows_its_weights(module):
    module, params, query, key = module
    mask = random_mask(1, 6, 5)
    out, state = module.apply(params, query, key, key, mask, mutable="intermediates")
    (weights,) = state["intermediates"]["probabilities"]
    assert weights.shape == (2, 6, 5)
    np.testing.assert_allclose(weights.sum(-1), np.broadcast_to(mask.any(1), (2, 6)), atol=1e-6)
    np.testing.assert_array_equal(out, module.apply(params, query, key, key, mask))


def test_module_names_a_width_that_does_not_split():
    x = jnp.zeros((2, 6))
    with pytest.raises(ValueError, match="dim 6 does not split over 4 heads"):
        MultiHeadAttention(6, 4).init(jax.random.key(0), x, x, x)


@pytest.mark.usefixtures("either_way")
def test_gradients_have_the_dtypes_of_what_they_belong_to():
    query, key, value, _ = arrays(3, 5, 7)
    with jax.enable_x64(True):
        given = query.astype(jnp.float64), key, value
        gradients = jax.grad(lambda *x: masked_attention(*x).sum(), (0, 1, 2))(*given)
    assert [g.dtype for g in gradients] == [x.dtype for x in given]


@pytest.mark.parametrize("dtype", ["float32", "int32"])
def test_masks_of_numbers_are_refused(dtype):
    """An additive mask, 0 and -inf, would be read inverted."""
    x = jnp.ones((HEADS, 5, 4))
    mask = np.zeros((5, 5), dtype)
    for attend in (masked_attention, lambda q, k, v, m: attention_probabilities(q, k, m)):
        with pytest.raises(TypeError, match=f"mask is {dtype}: it must be bool, true where a query may attend"):
            attend(x, x, x, mask)
    with pytest.raises(TypeError, match=f"mask is {dtype}"):
        MultiHeadAttention(8, 2).init(jax.random.key(0), x[0], x[0], x[0], mask)
