"""Pruned Chamfer distances and resampling of padded lines against the plain definitions, pair by pair."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.definitions import all_pairs, chamfer
from tflane_jax.errors import UserError
from tflane_jax.geometry.polylines import resample
from tflane_jax.metrics.chamfer import PaddedLines, near_pairs, pair_chamfer

QUICK = settings(max_examples=30)


def random_lines(rng, count, dims):
    starts = rng.uniform(-15, 15, (count, dims))
    return [start + np.cumsum(rng.normal(size=(rng.integers(1, 30), dims)), 0) for start in starts]


@QUICK
@given(seed=st.integers(0, 10**6), dims=st.sampled_from([2, 3]), within=st.floats(0.5, 15))
def test_no_near_pair_is_lost(seed, dims, within):
    rng = np.random.default_rng(seed)
    first, second = random_lines(rng, 6, dims), random_lines(rng, 7, dims)
    second[0] = first[2] + 0.1
    matrix = all_pairs(chamfer, first, second)
    limits, among = within * rng.uniform(0.5, 1.0, 6), rng.random((6, 7)) < 0.7
    a, b = PaddedLines.of(first, "a", dims), PaddedLines.of(second, "b", dims)
    i, j = near_pairs(a, b, limits, among)
    np.testing.assert_allclose(pair_chamfer(a, b, i, j), matrix[i, j], rtol=1e-12)
    found = np.zeros((6, 7), bool)
    found[i, j] = True
    assert not (found & ~among).any()
    assert not ((matrix <= limits[:, None]) & among & ~found).any()


def test_pruning_drops_far_pairs():
    # The boxes of the whole lines overlap, those of their pieces do not: a diagonal and a corner beside it.
    diagonal = np.linspace((0, 0), (20, 20), 40)
    corner = np.concatenate([np.linspace((1, 0), (20, 0), 20), np.linspace((20, 1), (20, 19), 20)])
    a, b = PaddedLines.of([diagonal], "a", 2), PaddedLines.of([corner, diagonal], "b", 2)
    np.testing.assert_array_equal(near_pairs(a, b, 1.5), [[0], [1]])


def test_a_closing_vertex_counts_once():
    square = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [0, 0, 0]], float)
    triangle = square[:3]
    point = PaddedLines.of([np.array([[0.0, 0, 3]])], "point")
    lines = PaddedLines.of([square, triangle], "lines").open_ends()
    # From the vertices of the square 3, 5, sqrt(41), 5 to the point and 3 back; the open triangle keeps its last one.
    expected = [((3 + 5 + 41**0.5 + 5) / 4 + 3) / 2, ((3 + 5 + 41**0.5) / 3 + 3) / 2]
    np.testing.assert_allclose(pair_chamfer(lines, point, np.array([0, 1]), np.array([0, 0])), expected)


def test_a_line_that_ends_above_its_start_is_not_closed():
    ramp = np.array([[0, 0, 0], [4, 0, 1], [4, 4, 2], [0, 0, 3]], float)
    assert PaddedLines.of([ramp], "ramp").open_ends().counts.tolist() == [4]


def test_a_line_of_one_vertex_is_not_closed():
    points = PaddedLines.of([np.zeros((1, 3)), np.array([[3.0, 4.0, 0.0]])], "points").open_ends()
    np.testing.assert_array_equal(pair_chamfer(points, points, np.array([0]), np.array([1])), [5.0])


@QUICK
@given(seed=st.integers(0, 10**6), dims=st.sampled_from([2, 3]))
def test_resampling_equals_that_of_each_line(seed, dims):
    rng = np.random.default_rng(seed)
    lines = random_lines(rng, 5, dims)
    lines[0] = np.repeat(lines[0], 2, axis=0)  # repeated positions
    lines[1] = np.repeat(lines[1][:1], 3, axis=0)  # no length
    together = PaddedLines.of(lines, "lines", dims).resampled(100)
    np.testing.assert_array_equal(together.counts, [100] * 5)
    for got, line in zip(together.points, lines, strict=True):
        np.testing.assert_allclose(got, resample(line, 100), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(got[[0, -1]], line[[0, -1]])


def test_twins_are_resampled_alike_to_the_last_bit():
    rng = np.random.default_rng(0)
    line, other = random_lines(rng, 2, 2)
    points = PaddedLines.of([line, other, line], "lines", 2).resampled(100).points
    alone = PaddedLines.of([line], "lines", 2).resampled(100).points
    np.testing.assert_array_equal(points[0], points[2])
    np.testing.assert_array_equal(points[0], alone[0])


def test_empty_and_invalid_input():
    none = PaddedLines.of([], "none", 2)
    one = PaddedLines.of([np.zeros((3, 2))], "one", 2)
    assert [len(x) for x in near_pairs(none, one, 1.0)] == [0, 0]
    assert none.resampled(100).points.shape == (0, 100, 2)
    assert pair_chamfer(one, one, *near_pairs(one, one, 0.0)) == [0.0]
    with pytest.raises(UserError, match=r"lines: points have shape .*, expected lines of 2-D points"):
        PaddedLines.of([np.zeros((3, 3))], "lines", 2)
