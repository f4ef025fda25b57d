"""Lane segments and areas, or plain arrays, as inputs of MapTR's metric."""

import dataclasses

import numpy as np
import pytest

from tflane_jax.evaluation.vector_maps import dividers, map_detections, truth_of_segment_lines
from tflane_jax.metrics import VectorMapMetrics
from tflane_jax.scene import Areas, AreaType, LaneGraph, LineType

NONE, SOLID, DASHED = LineType.NONE, LineType.SOLID, LineType.DASHED


def straight(y, start=0.0, stop=20.0):
    return np.linspace((start, y, 0.5), (stop, y, 0.5), 5)


def graph(*rows, garbage=np.nan):
    """Return segments (left, right, left type, right type), and behind them one invalid row."""
    n = len(rows)
    graph = LaneGraph.empty(n + 1, 5)
    valid = np.arange(n + 1) < n
    left, right = (np.full((n + 1, 5, 3), garbage, np.float32) for _ in range(2))
    kinds = np.full((2, n + 1), int(SOLID))
    for i, (a, b, first, second) in enumerate(rows):
        left[i], right[i], kinds[0, i], kinds[1, i] = a, b, first, second
    return dataclasses.replace(graph, left=left, right=right, left_type=kinds[0], right_type=kinds[1], valid=valid)


def areas(garbage=np.nan):
    ring = np.array([[0, 0, 0], [3, 0, 0], [3, 8, 0], [0, 8, 0], [0, 0, 0]])
    points = np.stack([np.full((5, 3), garbage), straight(-9), ring]).astype(np.float32)
    category = np.array([0, AreaType.ROAD_BOUNDARY, AreaType.PEDESTRIAN_CROSSING])
    return Areas(points, category, np.array([False, True, True]))


def lines_y(found):
    return [float(line[0, 1]) for line in found]


def test_a_line_between_neighbours_counts_once():
    two = graph((straight(4), straight(0), SOLID, DASHED), (straight(0), straight(-4), DASHED, SOLID))
    assert lines_y(dividers(two)) == [4.0, 0.0, -4.0]
    # Opposite traffic: the same line, driven the other way.
    both = graph((straight(4), straight(0), SOLID, DASHED), (straight(-4), straight(0)[::-1], SOLID, DASHED))
    assert lines_y(dividers(both)) == [4.0, -4.0, 0.0]
    assert dividers(both)[0].shape == (5, 2)


def test_unpainted_and_invalid_lines_are_left_out():
    assert lines_y(dividers(graph((straight(4), straight(0), NONE, SOLID)))) == [0.0]
    assert dividers(graph((straight(4), straight(0), NONE, NONE))) == []
    assert dividers(LaneGraph.empty(4, 5)) == []


@pytest.mark.parametrize(("shift", "expected"), [(0.0, 1), (0.19, 1), (0.21, 2)])
def test_the_longer_of_two_lines_stays(shift, expected):
    short, long = straight(shift, 2.0, 9.0), straight(0.0)
    found = dividers(graph((short, straight(9), DASHED, NONE), (long, straight(9), DASHED, NONE)))
    assert len(found) == expected
    assert any((line == long[:, :2]).all() for line in found)


def test_truth_joins_dividers_crossings_and_boundaries():
    segments = graph((straight(4), straight(0), SOLID, DASHED))
    truth = truth_of_segment_lines(segments, areas())
    np.testing.assert_array_equal(truth.classes, [0, 0, 2, 1])
    for line, expected in zip(truth.points, [straight(4), straight(0), *areas().points[1:]], strict=True):
        np.testing.assert_allclose(line, expected[:, :2])


def score(detections, truth):
    metrics = VectorMapMetrics()
    metrics.update(detections, truth)
    return metrics.compute()


def test_perfect_detections_get_the_full_score_in_any_order():
    truth = truth_of_segment_lines(graph((straight(4), straight(0), SOLID, DASHED)), areas())
    points = np.concatenate([np.stack(list(truth.points)), np.ones((4, 5, 1))], -1)[::-1]
    found = map_detections(points, truth.classes[::-1], np.array([0.1, 0.4, 0.3, 0.2]))
    np.testing.assert_array_equal(found.scores, [0.4, 0.3, 0.2, 0.1])
    np.testing.assert_array_equal(found.classes, [2, 0, 0, 1])
    assert score(found, truth)["mAP"] == 1.0
    wrong = dataclasses.replace(found, classes=(found.classes + 1) % 3)
    assert score(wrong, truth)["mAP"] == 0.0


def test_padding_changes_no_metric():
    segments = (straight(4), straight(0), SOLID, DASHED)
    found = map_detections(np.stack([straight(4), straight(-9)]), np.array([0, 2]), np.array([0.5, 0.9]))
    padded = map_detections(
        np.stack([np.full((5, 3), np.nan), straight(4), straight(-9)]),
        np.array([77, 0, 2]),
        np.array([np.nan, 0.5, 0.9]),
        np.array([False, True, True]),
    )
    results = [
        score(detections, truth_of_segment_lines(graph(segments, garbage=garbage), areas(garbage)))
        for detections, garbage in ((found, np.nan), (padded, 0.0))
    ]
    assert results[0] == results[1]
    assert results[0]["AP_boundary"] == 1.0


def test_empty_input():
    truth = truth_of_segment_lines(LaneGraph.empty(2, 5), Areas.empty(2, 5))
    none = map_detections(np.zeros((0, 5, 2)), np.zeros(0, int), np.zeros(0))
    result = score(none, truth)
    assert (result["lines"], result["mAP"]) == (0, 0.0)
