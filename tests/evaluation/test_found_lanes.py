"""Lanes found by a model, the threshold of its best F-score, and frames in which two models differ: against loops."""

import numpy as np
import pytest

from tests.fakes import fake_example
from tests.metrics.definitions import all_pairs, frechet
from tflane_jax.evaluation.found_lanes import (
    WITHIN,
    best_threshold,
    confidences_of,
    detection_scores,
    frames_of_difference,
    lane_confidences,
)
from tflane_jax.evaluation.lane_graph import LaneGraphMetrics
from tflane_jax.metrics.centerline_matching import relaxation
from tflane_jax.metrics.frames import LaneDetections, LaneTruth
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics
from tflane_jax.scene import LaneGraph, Prediction, SegmentPrediction


def frame(seed, lanes=6, queries=30, points=5):
    """Return true lanes, and detections scattered around them, with scores that repeat."""
    rng = np.random.default_rng(seed)
    start, step = rng.uniform(-20, 20, (lanes, 1, 3)), rng.uniform(0, 4, (lanes, points, 3))
    truth = start + np.cumsum(step, 1)
    detected = truth[rng.integers(lanes, size=queries)] + rng.normal(0, 1.2, (queries, 1, 3))
    return truth, detected, rng.integers(1, 20, queries) / 20


@pytest.mark.parametrize("seed", range(5))
def test_confidences_against_loops(seed):
    truth, detected, scores = frame(seed)
    distance = all_pairs(frechet, truth, detected)
    distance *= relaxation(truth)[:, None]
    expected = np.full(len(truth), -np.inf)
    for p, score in enumerate(scores):
        lane = distance[:, p].argmin()
        if distance[lane, p] < WITHIN:
            expected[lane] = max(expected[lane], score)
    assert np.isfinite(expected).sum() > 0
    np.testing.assert_array_equal(lane_confidences(truth, detected, scores), expected)


def test_without_threshold_the_found_lanes_are_the_recall_of_the_metric():
    metrics, found = CenterlineMetrics(), []
    for seed in range(8):
        truth, detected, scores = frame(seed, queries=8)
        metrics.update(
            LaneDetections(detected, scores, np.zeros((8, 8))), LaneTruth(truth, np.zeros((6, 6), bool), None)
        )
        found.append(np.isfinite(lane_confidences(truth, detected, scores)))
    assert 0.2 < np.mean(found) < 1.0
    assert metrics.compute()[f"recall@{WITHIN:.1f}"] == pytest.approx(np.mean(found))


@pytest.mark.parametrize(("lanes", "queries"), [(0, 3), (3, 0), (0, 0), (1, 1)])
def test_few_lanes_and_detections(lanes, queries):
    truth = np.arange(lanes * 6.0).reshape(lanes, 2, 3)
    found = lane_confidences(truth, np.arange(queries * 6.0).reshape(queries, 2, 3), np.full(queries, 0.5))
    assert found.tolist() == ([0.5] if queries == 1 else [-np.inf] * lanes)


def test_without_threshold_the_found_segments_are_the_recall_of_the_metric():
    metrics, found = LaneGraphMetrics(), []
    for seed in range(8):
        truth, detected, scores = frame(seed, queries=8)
        across = np.array([0.0, 1.8, 0.0])
        segments = LaneGraph.empty(9, 5)
        segments.points[:], segments.left[:], segments.right[:] = np.nan, np.nan, np.nan
        segments.points[:6], segments.left[:6], segments.right[:6] = truth, truth + across, truth - across
        segments.valid[:6], segments.visibility[:] = True, 1.0
        logits = np.stack([scores, np.where(np.arange(8) == 0, 5.0, -9.0)], -1)  # the first is a crossing
        prediction = SegmentPrediction(detected, detected + across, detected - across, logits)
        metrics.update(Prediction(segments=prediction), fake_example().replace(segments=segments))
        confidence = confidences_of(segments, prediction)
        assert not np.isfinite(confidence[6:]).any()
        found.append(np.isfinite(confidence[:6]))
        assert detection_scores(prediction)[0] == 0.0
    assert 0.1 < np.mean(found) < 1.0
    assert metrics.compute()["all"][f"recall@{WITHIN:.1f}"] == pytest.approx(np.mean(found))


@pytest.mark.parametrize("seed", range(5))
def test_the_best_threshold_against_all_thresholds(seed):
    frames = [frame(10 * seed + i) for i in range(4)]
    lanes = [lane_confidences(*each) for each in frames]
    detections = [scores for _, _, scores in frames]

    def f_score(threshold):
        found = sum(int((each >= threshold).sum()) for each in lanes)
        kept = sum(int((each >= threshold).sum()) for each in detections)
        recall, precision = found / sum(map(len, lanes)), found / kept
        return 2 * recall * precision / max(recall + precision, 1e-9)

    levels = np.unique(np.concatenate(detections))[::-1]
    expected = levels[np.argmax([f_score(level) for level in levels])]
    assert best_threshold(lanes, detections) == expected


def test_a_model_that_finds_nothing_has_no_threshold():
    assert best_threshold([np.full(3, -np.inf)], [np.array([0.9, 0.1])]) == np.inf
    assert best_threshold([], []) == np.inf


SCENE = np.repeat(np.arange(5), 2)


@pytest.mark.parametrize(
    ("first", "second", "count", "expected"),
    [
        # 3 : 9 lanes alone: one frame for the first, three for the second, largest lead first.
        ([0, 0, 2, 0, 0, 0, 1, 0, 0, 0], [1, 2, 0, 0, 3, 0, 0, 0, 1, 2], 4, ([2], [4, 1, 9])),
        # A frame in which each finds one lane alone is no lead; the second gets what the first cannot use.
        ([1, 0, 0, 0, 0, 0, 0, 0, 0, 0], [1, 0, 1, 0, 1, 0, 0, 0, 0, 0], 4, ([], [2, 4])),
        # One lead against many still gets its frame.
        ([9, 0, 9, 0, 9, 0, 9, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0, 0, 0, 1], 3, ([0, 2], [9])),
        ([0, 1, 0, 1, 0, 1, 0, 0, 0, 0], [0] * 10, 2, ([1, 3], [])),
        ([0] * 10, [0] * 10, 4, ([], [])),
    ],
)
def test_frames_of_difference(first, second, count, expected):
    assert frames_of_difference(np.array(first), np.array(second), SCENE, count) == expected
    assert frames_of_difference(np.array(second), np.array(first), SCENE, count) == expected[::-1]
