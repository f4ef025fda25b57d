"""Lane segments, areas and elements as inputs of the lane-segment metrics."""

import dataclasses

import numpy as np
import pytest

from tflane_jax.evaluation.lane_segments import detections_of_segments, segment_detections, truth_of_segments
from tflane_jax.metrics import ElementDetections, LaneSegmentMetrics
from tflane_jax.scene import AreaPrediction, Areas, AreaType, LaneGraph, SegmentPrediction, TrafficElements
from tflane_jax.scene.lane_segments import governed_lanes, governed_segments

VALID = np.array([True, False, True, True])


def ring(x, y, points=9):
    corners = np.array([[x, y, 0], [x + 3, y, 0], [x + 3, y + 8, 0], [x, y + 8, 0], [x, y, 0]], float)
    return np.stack([np.interp(np.linspace(0, 4, points), np.arange(5), corners[:, i]) for i in range(3)], -1)


def scene(garbage=np.nan):
    """Return three segments (rows 0 -> 2 ahead of each other, 3 beside), their centerlines, areas and elements."""
    start = np.array([[0, 0, 0], [0, 0, 0], [10, 0, 0], [0, 4, 0]], float)
    center = start[:, None] + np.linspace(0, 10, 5)[:, None] * [1, 0, 0]
    side = np.array([0, 2, 0])
    lines = [np.where(VALID[:, None, None], line, garbage).astype(np.float32) for line in (center, center + side)]
    successor = np.zeros((4, 4), bool)
    successor[0, 2] = True
    successor[1, 1] = np.isnan(garbage)
    segments = dataclasses.replace(
        LaneGraph.empty(4, 5),
        points=lines[0],
        left=lines[1],
        right=np.where(VALID[:, None, None], center - side, garbage).astype(np.float32),
        visibility=np.where(VALID, np.float32(0.5), garbage),
        successor=successor,
        valid=VALID,
    )
    # The merged centerline of rows 0 and 2, and that of row 3; the first row is padding.
    whole = np.stack([np.full((5, 3), garbage), np.linspace((0, 0, 0), (20, 0, 0), 5), center[3]]).astype(np.float32)
    lanes = dataclasses.replace(LaneGraph.empty(3, 5), points=whole, valid=np.array([False, True, True]))
    areas = Areas(
        np.stack([np.full((9, 3), garbage), ring(5, -4), ring(30, -4)]).astype(np.float32),
        np.array([9, AreaType.PEDESTRIAN_CROSSING, AreaType.ROAD_BOUNDARY]),
        np.array([False, True, True]),
    )
    elements = dataclasses.replace(
        TrafficElements.empty(3, 3),
        box=np.array([[[9, 9], [9, 9]], [[0, 0], [10, 10]], [[20, 0], [30, 10]]], np.float32),
        attribute=np.array([99, 2, 5]),
        lane=np.array([[True, True, True], [True, True, False], [True, False, True]]),
        valid=np.array([False, True, True]),
    )
    return segments, lanes, areas, elements


def test_truth_holds_what_is_valid():
    segments, lanes, areas, elements = scene()
    truth = truth_of_segments(segments, areas, elements, lanes)
    for ours, theirs in (
        (truth.lanes.points, segments.points),
        (truth.left, segments.left),
        (truth.right, segments.right),
    ):
        np.testing.assert_array_equal(ours, theirs[[0, 2, 3]])
    np.testing.assert_array_equal(np.argwhere(truth.lanes.successor), [[0, 1]])
    np.testing.assert_array_equal(truth.areas.points, areas.points[1:])
    np.testing.assert_array_equal(truth.areas.categories, [1, 2])
    assert truth.lanes.elements is not None
    np.testing.assert_array_equal(truth.lanes.elements.attributes, [2, 5])
    np.testing.assert_array_equal(truth.lanes.elements.boxes, elements.box[1:])
    # Element 1 governs the merged centerline, so both its segments; element 2 the lane beside it.
    np.testing.assert_array_equal(truth.lanes.elements.lane, [[True, False], [True, False], [False, True]])
    assert truth_of_segments(segments, areas).lanes.elements is None


def test_elements_may_govern_the_segments_themselves():
    segments, lanes, areas, elements = scene()
    direct = dataclasses.replace(elements, lane=None, segment=np.eye(4, 3, dtype=bool)[[1, 0, 2, 2]])
    for centerlines in (None, lanes):
        truth = truth_of_segments(segments, areas, direct, centerlines)
        assert truth.lanes.elements is not None
        np.testing.assert_array_equal(truth.lanes.elements.lane, [[True, False], [False, True], [False, True]])
    with pytest.raises(ValueError, match="govern centerlines: pass `lanes`"):
        truth_of_segments(segments, areas, elements)


def test_what_governs_a_lane_follows_from_its_segments_and_back():
    """Each way, of what lies on what; a lane is governed by what governs any of its segments."""
    segments, lanes, _, elements = scene()
    by_segment = governed_segments(elements, segments, lanes)
    np.testing.assert_array_equal(by_segment[VALID][:, 1:], [[True, False], [True, False], [False, True]])
    known = dataclasses.replace(elements, lane=None, segment=by_segment)
    np.testing.assert_array_equal(governed_lanes(known, lanes, segments)[1:, 1:], [[True, False], [False, True]])
    assert governed_lanes(None, lanes, segments).shape == (3, 0)
    assert governed_segments(None, segments, lanes).shape == (4, 0)


def perfect(garbage=0.0, successor=None):
    """Return detections equal to the truth of `scene`, its crossing as a query of the second class."""
    segments, lanes, areas, elements = scene()
    truth = truth_of_segments(segments, areas, elements, lanes)
    crossing = np.asarray(truth.areas.points[0])
    left, right = crossing[[2, 3, 4, 5, 6]], crossing[[0, 0, 1, 8, 8]][::-1]
    points = [np.concatenate([np.asarray(x), y[None]]) for x, y in ((truth.left, left), (truth.right, right))]
    n = 4
    edges = np.zeros((n, n)) if successor is None else successor
    edges[:3, :3] = np.where(truth.lanes.successor, 0.9, 0.1)
    center = np.concatenate([np.asarray(truth.lanes.points), np.full((1, 5, 3), garbage)])
    assert truth.lanes.elements is not None
    found = ElementDetections(
        truth.lanes.elements.boxes,
        truth.lanes.elements.attributes,
        np.ones(2),
        np.concatenate([np.where(truth.lanes.elements.lane, 0.9, 0.1), np.ones((1, 2))]),
    )
    scores, classes = np.array([0.3, 0.9, 0.6, 0.8]), np.array([0, 0, 0, 1])
    return (center, points[0], points[1], classes, scores, edges), found, truth


def test_detections_are_sorted_by_score_and_crossings_become_areas():
    (center, left, right, classes, scores, edges), elements, _ = perfect()
    found = segment_detections(center, left, right, classes, scores, edges, elements=elements)
    np.testing.assert_array_equal(found.lanes.scores, [0.9, 0.6, 0.3])
    np.testing.assert_array_equal(found.lanes.points, center[[1, 2, 0]])
    np.testing.assert_array_equal(found.left, left[[1, 2, 0]])
    np.testing.assert_array_equal(found.right, right[[1, 2, 0]])
    assert found.lanes.successor[2, 0] == 0.9  # row 0 continues in row 1
    assert found.lanes.elements is not None
    np.testing.assert_array_equal(found.lanes.elements.lane, elements.lane[[1, 2, 0]])
    np.testing.assert_array_equal(found.areas.points, [[*left[3], *right[3][::-1]]])
    np.testing.assert_array_equal(found.areas.categories, [1])
    np.testing.assert_array_equal(found.areas.scores, [0.8])


def test_perfect_detections_get_the_full_score():
    arrays, elements, truth = perfect()
    metrics = LaneSegmentMetrics()
    metrics.update(segment_detections(*arrays, elements=elements), truth)
    result = metrics.compute()
    assert [result[name] for name in ("DET_l", "TOP_ll", "DET_t", "TOP_lt")] == [1.0] * 4
    # The line around a crossing by its two long sides lies near the ring of the example.
    assert result["crossing@1.5"] == 1.0
    assert result["boundary@1.5"] == 0.0


def test_padding_and_invalid_queries_change_nothing():
    segments, lanes, areas, elements = scene(0.0)
    arrays, found, truth = perfect()
    shown = truth, truth_of_segments(segments, areas, elements, lanes)
    padded = [np.concatenate([array, np.full((1, *array.shape[1:]), 7, array.dtype)]) for array in arrays[:5]]
    edges = np.pad(arrays[5], (0, 1), constant_values=np.nan)
    more = dataclasses.replace(found, lane=np.concatenate([found.lane, np.full((1, 2), np.nan)]))
    detections = (
        segment_detections(*arrays, elements=found),
        segment_detections(*padded, successor=edges, valid=np.arange(5) < 4, elements=more),
    )
    results = []
    for one, other in zip(detections, shown, strict=True):
        metrics = LaneSegmentMetrics()
        metrics.update(one, other)
        results.append(metrics.compute())
    assert results[0] == results[1]


def test_empty_input():
    empty = truth_of_segments(LaneGraph.empty(3, 5), Areas.empty(2, 9), TrafficElements.empty(2, segments=3))
    line = np.zeros((0, 5, 3))
    none = segment_detections(line, line, line, np.zeros(0, int), np.zeros(0), np.zeros((0, 0)))
    metrics = LaneSegmentMetrics("LaneSegNet")
    metrics.update(none, empty)
    assert metrics.compute()["mAP"] == 1.0
    assert np.shape(empty.lanes.points) == (0, 5, 3)
    assert np.shape(none.areas.points) == (0, 10, 3)


def test_areas_of_their_own_are_measured_by_class():
    """Perfect areas get the full score; the two classes exchanged get none."""
    segments, _, areas, _ = scene(0.0)
    truth = truth_of_segments(segments, areas)
    rows = np.flatnonzero(areas.valid)
    logits = np.where(np.arange(2) == areas.category[rows, None] - 1, 4.0, -4.0)
    queries = SegmentPrediction(
        segments.points, segments.left, segments.right, np.where(segments.valid, 3.0, -3.0)[:, None]
    )
    scores = []
    for columns in (logits, logits[:, ::-1]):
        found = detections_of_segments(queries.replace(areas=AreaPrediction(areas.points[rows], columns)))
        metrics = LaneSegmentMetrics("OpenLane-V2")
        metrics.update(found, truth)
        scores.append(metrics.compute()["DET_a"])
    assert scores == [1.0, 0.0]
