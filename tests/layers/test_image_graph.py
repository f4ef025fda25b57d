"""Edge types of an image against matrices that loops build cell by cell."""

import itertools
import math
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from tests.shared import random_array
from tflane_jax.layers.image_graph import SIDES, Relation, attend_along, attend_near, mix_relations, smooth

RELATIONS = get_args(Relation)
SHAPE = (3, 4)


def random_valid(seed, shape=SHAPE):
    return np.random.default_rng(seed).random(shape) < 0.7


def senders(relation, i, j, valid):
    """Return the source cells of cell (i, j), without the self-loop of cells that have none."""
    height, width = valid.shape
    if relation in ("row", "column"):
        line = [(i, b) for b in range(width)] if relation == "row" else [(a, j) for a in range(height)]
    elif relation == "near":
        line = [(i + a, j + b) for a, b in itertools.product((-1, 0, 1), repeat=2)]
    else:
        down, right = SIDES.get(relation, (0, 0))
        line = [(i + down, j + right)]
    return [(a, b) for a, b in line if 0 <= a < height and 0 <= b < width and valid[a, b]]


def dense_adjacency(relation, valid):
    """The matrix of an edge type: receivers are rows, which sum to 1, or to 0 where a cell is not valid."""
    width = valid.shape[1]
    matrix = np.zeros((valid.size, valid.size), np.float32)
    for i, j in zip(*np.nonzero(valid), strict=True):
        heard = senders(relation, i, j, valid) or [(i, j)]
        for a, b in heard:
            matrix[i * width + j, a * width + b] = 1 / len(heard)
    return matrix


def dense_stack(relations, valid):
    return jnp.asarray(np.array([dense_adjacency(relation, valid) for relation in relations]))


@jax.jit
def by_matrices(stack, fractions, x):
    mixed = jnp.einsum("ec,enm,mc->nc", fractions, stack, x.reshape(-1, x.shape[-1]))
    return mixed.reshape(x.shape)


@pytest.mark.parametrize("shape", [SHAPE, (1, 1), (1, 5), (4, 1), (0, 3), (2, 0)])
def test_shifts_and_means_equal_the_matrices(shape):
    valid = random_valid(0, shape)
    fractions, x = random_array(1, len(RELATIONS), 2), random_array(2, *shape, 2)
    x = jnp.where(valid[..., None], x, 0.0)
    out = jax.jit(lambda s, x: mix_relations(RELATIONS, s, x, jnp.asarray(valid)))(fractions, x)
    np.testing.assert_allclose(out, by_matrices(dense_stack(RELATIONS, valid), fractions, x), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("relations", [RELATIONS, ("self",), ("up", "right"), ("column", "self")])
def test_gradients_equal_those_of_the_matrices(relations):
    valid = random_valid(3)
    fractions, x = random_array(4, len(relations), 2), random_array(5, *SHAPE, 2)
    weight, stack = random_array(6, *SHAPE, 2), dense_stack(relations, valid)

    def gradients(mix):
        scalar = lambda s, x: (weight * mix(s, jnp.where(valid[..., None], x, 0.0))).sum()  # noqa: E731
        return jax.jit(jax.grad(scalar, argnums=(0, 1)))(fractions, x)

    ours = gradients(lambda s, x: mix_relations(relations, s, x, jnp.asarray(valid)))
    theirs = gradients(lambda s, x: by_matrices(stack, s, x))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


_mix_all = jax.jit(lambda s, x, v: mix_relations(RELATIONS, s, x, v))


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_mixtures_keep_a_constant(seed):
    """Rows sum to 1: a constant stays for all mixing weights and any padding."""
    valid = random_valid(seed)
    fractions = jax.nn.softmax(3 * random_array(seed, len(RELATIONS), 2), axis=0)
    constant = jnp.where(valid[..., None], jnp.asarray([2.0, -1.0]), 0.0)
    np.testing.assert_allclose(_mix_all(fractions, constant, jnp.asarray(valid)), constant, rtol=1e-5)


def test_flipping_the_map_swaps_up_and_down():
    valid, x = random_valid(7), random_array(8, *SHAPE, 2)
    x = jnp.where(valid[..., None], x, 0.0)
    fractions = random_array(9, 4, 2)
    mix = jax.jit(mix_relations, static_argnums=0)
    up = mix(("up", "down", "left", "row"), fractions, x, jnp.asarray(valid))
    down = mix(("down", "up", "left", "row"), fractions, x[::-1], jnp.asarray(valid[::-1]))
    np.testing.assert_allclose(up[::-1], down, rtol=1e-6)


@pytest.mark.parametrize("shape", [SHAPE, (1, 1), (0, 3)])
def test_smoothing_is_symmetrically_normalised(shape):
    valid, x = random_valid(10, shape), random_array(11, *shape, 2)
    edges = (dense_adjacency("near", valid) > 0).astype(np.float64)
    degree = np.maximum(edges.sum(1), 1)
    expected = edges / np.sqrt(degree[:, None] * degree[None]) @ np.asarray(x).reshape(-1, 2)
    np.testing.assert_allclose(jax.jit(smooth)(x, jnp.asarray(valid)), expected.reshape(x.shape), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("relation", ["near", "row", "column"])
def test_graph_attention_equals_loops(relation):
    valid = random_valid(12)
    destination, source = random_array(13, *SHAPE, 2), random_array(14, *SHAPE, 2)
    value = random_array(15, *SHAPE, 2, 3)
    if relation == "near":
        out, weights = jax.jit(attend_near)(destination, source, value, jnp.asarray(valid))
        total = weights.sum(0)
    else:
        along = jax.jit(attend_along, static_argnums=0)
        out, weights = along(int(relation == "row"), destination, source, value, jnp.asarray(valid))
        total = weights.sum(2) if relation == "row" else weights.sum(2).swapaxes(0, 1)
    np.testing.assert_allclose(np.asarray(total)[valid], 1.0, rtol=1e-5)
    destination, source, value, out = (np.asarray(x) for x in (destination, source, value, out))
    for (i, j), head in itertools.product(zip(*np.nonzero(valid), strict=True), range(2)):
        cells = senders(relation, i, j, valid)
        scores = [float(destination[i, j, head] + source[a, b, head]) for a, b in cells]
        exps = [math.exp(score if score > 0 else 0.2 * score) for score in scores]
        expected = sum(e * value[a, b, head] for e, (a, b) in zip(exps, cells, strict=True)) / sum(exps)
        np.testing.assert_allclose(out[i, j, head], expected, rtol=1e-5, atol=1e-5)


def test_gradients_equal_finite_differences():
    """The gradient of the shifts is written by hand; here it is compared in float64."""
    valid, rng = random_valid(16), np.random.default_rng(16)
    with jax.enable_x64(True):
        destination, source, x = (jnp.asarray(rng.normal(size=(*SHAPE, 2))) for _ in range(3))
        value = jnp.asarray(rng.normal(size=(*SHAPE, 2, 2)))
        attend = jax.jit(lambda *arrays: attend_near(*arrays, jnp.asarray(valid)))
        check_grads(attend, (destination, source, value), order=1, modes=["rev"])
        check_grads(jax.jit(lambda x: smooth(x, jnp.asarray(valid))), (x,), order=1, modes=["rev"])


def test_gradients_have_the_dtypes_of_what_they_belong_to():
    with jax.enable_x64(True):
        given = jnp.ones((2, 3), jnp.float32), jnp.ones((4, 5, 3), jnp.float64)
        valid = jnp.ones((4, 5), bool)
        gradients = jax.grad(lambda w, x: mix_relations(("up", "row"), w, x, valid).sum(), (0, 1))(*given)
    assert [g.dtype for g in gradients] == [x.dtype for x in given]
