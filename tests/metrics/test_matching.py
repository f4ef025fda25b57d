"""Matching and average precision against plain loops and numbers worked out by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.metrics.matching import (
    average_precision_11,
    average_precision_area,
    descending,
    greedy_match,
    vertex_average_precision,
)
from tflane_jax.metrics.topology import confidence_levels

QUICK = settings(max_examples=40)


def match_by_loop(distance, nearest, scores, threshold):
    taken = np.full(len(scores), -1)
    for p in sorted(range(len(scores)), key=lambda p: -scores[p]):
        if distance[p] < threshold and nearest[p] not in taken:
            taken[p] = nearest[p]
    return taken


@QUICK
@given(seed=st.integers(0, 10**6), count=st.integers(0, 12))
def test_greedy_match_equals_the_loop(seed, count):
    rng = np.random.default_rng(seed)
    # Few levels, so that scores tie and distances lie on the threshold.
    args = rng.integers(0, 4, count) / 2.0, rng.integers(0, 5, count), rng.integers(0, 4, count) / 4.0, 1.0
    distance, nearest, scores, threshold = args
    np.testing.assert_array_equal(greedy_match(distance < threshold, nearest, scores), match_by_loop(*args))


def test_a_detection_is_matched_with_its_nearest_truth_only():
    taken = greedy_match(np.array([0.1, 0.2, 1.0]) < 1.0, np.array([0, 0, 1]), np.array([0.5, 0.9, 0.7]))
    np.testing.assert_array_equal(taken, [-1, 0, -1])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint64, bool, np.int8, np.float32])
def test_scores_of_any_type_are_ranked(dtype):
    np.testing.assert_array_equal(descending(np.array([0, 1, 0, 1], dtype)), [1, 3, 0, 2])
    assert average_precision_11(np.array([100, 0], np.uint8), np.array([True, False]), 1) == 1.0


def test_descending_is_stable():
    np.testing.assert_array_equal(descending(np.array([0.5, 1.0, 0.5, 1.0] * 8))[:16], np.arange(32)[1::2])


@QUICK
@given(seed=st.integers(0, 10**6), count=st.integers(1, 30), truths=st.integers(1, 30))
def test_average_precision_equals_the_definition(seed, count, truths):
    rng = np.random.default_rng(seed)
    hits = rng.random(count) < 0.6
    hits &= np.cumsum(hits) <= truths
    scores = -np.arange(count) / count
    found = np.cumsum(hits)
    precision = found / np.arange(1, count + 1)
    best = [precision[10 * found >= k * truths].max(initial=0.0) for k in range(11)]
    order = rng.permutation(count)
    assert average_precision_11(scores[order], hits[order], truths) == pytest.approx(np.mean(best))


@pytest.mark.parametrize("found", range(11))
def test_recall_is_compared_exactly(found):
    # `found` of ten truths, all hits: recall k/10 must reach its own threshold.
    assert average_precision_11(np.ones(found), np.ones(found, bool), 10) == pytest.approx((found + (found > 0)) / 11)


def test_average_precision_without_truth_or_predictions():
    none, one = np.zeros(0), np.ones(1)
    assert average_precision_11(none, none.astype(bool), 0) == 1.0
    assert average_precision_11(one, one < 0, 0) == 0.0
    assert average_precision_11(none, none.astype(bool), 3) == 0.0


def test_area_under_the_curve():
    # Precisions 1, 1/2, 2/3 at the ranks; from each rank on the best is 1, 2/3, 2/3; true positives at ranks 1 and 3.
    hits, scores = np.array([True, False, True]), np.array([0.9, 0.8, 0.7])
    assert average_precision_area(scores, hits, 3) == pytest.approx((1 + 2 / 3) / 3)
    assert average_precision_area(scores[::-1], hits, 2) == pytest.approx((1 + 2 / 3) / 2)
    assert average_precision_area(scores[:0], hits[:0], 3) == 0.0
    assert average_precision_area(scores[:0], hits[:0], 0) == 0.0
    assert average_precision_area(scores, hits & False, 0) == 0.0


@pytest.mark.parametrize(
    ("edges", "confidence", "expected"),
    [
        ([0, 0], [0.5, 0.1], 1.0),  # nothing to find, nothing above one half
        ([0, 0], [0.51, 0.1], 0.0),
        ([1, 0], [0.5, 0.1], 0.0),
        ([1, 0], [0.6, 0.1], 1.0),
        ([1, 0], [0.6, 0.9], 0.5),
        ([1, 1, 0], [0.6, 0.9, 0.7], (1 + 2 / 3) / 2),
        ([1, 1], [0.6, 0.4], 0.5),  # the one not predicted contributes nothing
        ([], [], 1.0),
    ],
)
def test_vertex_precision(edges, confidence, expected):
    edges, confidence = np.array([edges], bool), np.array([confidence], float)
    assert vertex_average_precision(edges, confidence) == pytest.approx([expected])


def levels_by_loop(scores, taken):
    """The cut-offs of docs/reference/metrics.md, section 2.6, as a loop (scores in descending order)."""
    n, kept = len(scores), []
    found = np.cumsum(taken >= 0)
    for r in range(1, 11):
        v = n * r / 10 - 1.5
        k = int(np.floor(v)) if v == np.floor(v) and v % 2 == 0 else int(np.floor(v)) + 1
        j = max(j for j in range(n) if found[j] == found[max(k, 0)])
        kept.append((taken >= 0) & (scores >= scores[j]))
    return np.array(kept)


@QUICK
@given(seed=st.integers(0, 10**6), count=st.integers(1, 40))
def test_confidence_levels_equal_the_loop(seed, count):
    rng = np.random.default_rng(seed)
    scores = np.sort(rng.integers(0, 30, count) / 30)[::-1]
    taken = np.where(rng.random(count) < 0.5, np.arange(count), -1)
    np.testing.assert_array_equal(confidence_levels(scores, taken), levels_by_loop(scores, taken))
