"""Fréchet distances along anti-diagonals against the plain recursion, pair by pair."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.definitions import all_pairs, frechet
from tflane_jax.geometry.polylines import pad_lines
from tflane_jax.metrics.frechet import end_distance, pair_frechet


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 12), m=st.integers(1, 12), dims=st.sampled_from([2, 3]))
def test_equals_the_recursion(seed, n, m, dims):
    rng = np.random.default_rng(seed)
    # Few levels, so that cells tie.
    a, b = rng.integers(0, 6, (4, n, dims)) / 2, rng.integers(0, 6, (5, m, dims)) / 2
    expected = all_pairs(frechet, a, b)
    i, j = np.nonzero(rng.random((4, 5)) < 0.8)
    np.testing.assert_allclose(pair_frechet(a, b, i, j), expected[i, j], rtol=1e-14)
    assert (end_distance(a, b) <= expected).all()


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), counts=st.lists(st.integers(1, 8), min_size=1, max_size=4))
def test_padding_by_the_last_vertex_keeps_the_distance(seed, counts):
    rng = np.random.default_rng(seed)
    lines = [rng.uniform(-5, 5, (count, 3)) for count in counts]
    padded, i, j = pad_lines(lines), *np.indices((len(lines), len(lines))).reshape(2, -1)
    np.testing.assert_allclose(pair_frechet(padded, padded, i, j), all_pairs(frechet, lines, lines).ravel(), rtol=1e-14)


def test_pairs_in_parts(monkeypatch):
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-5, 5, (6, 4, 3)), rng.uniform(-5, 5, (7, 5, 3))
    i, j = np.indices((6, 7)).reshape(2, -1)
    at_once = pair_frechet(a, b, i, j)
    for block in (1, 100, 4 * 5 * 21):
        monkeypatch.setattr("tflane_jax.metrics.frechet._BLOCK", block)
        np.testing.assert_array_equal(pair_frechet(a, b, i, j), at_once)


def test_by_hand():
    a = np.array([[(0, 0), (1, 0), (2, 0), (3, 0)]], float)
    b = np.array([[(0, 1), (3, 1)]], float)
    first = np.array([0])
    # The middle vertices are coupled with the ends of b, one metre along and one aside.
    assert pair_frechet(a, b, first, first) == pytest.approx([2**0.5])
    assert pair_frechet(a, b[:, ::-1], first, first) == pytest.approx([10**0.5])
    assert end_distance(a, b).tolist() == [[1.0]]
    assert pair_frechet(a, b, first[:0], first[:0]).shape == (0,)
