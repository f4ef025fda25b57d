"""Lane-segment metrics against the official evaluators, and against numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.cases import straight
from tests.metrics.fixtures import expected_cases, load_segments
from tflane_jax.errors import UserError
from tflane_jax.metrics import LaneDetections, LaneTruth
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, match_lanes
from tflane_jax.metrics.chamfer import PaddedLines, pair_chamfer
from tflane_jax.metrics.lane_segment import (
    AREA_THRESHOLDS,
    AreaDetections,
    AreaTruth,
    Flavour,
    LaneSegmentMetrics,
    SegmentDetections,
    SegmentTruth,
    nearest_segments,
)

CASES = list(expected_cases("lanesegment"))


def evaluate(frames, flavour: Flavour = "OpenLane-V2"):
    metrics = LaneSegmentMetrics(flavour)
    for detections, truth in frames:
        metrics.update(detections, truth)
    return metrics.compute()


@pytest.mark.golden
@pytest.mark.parametrize("case", CASES)
def test_golden_totals(case):
    expected = expected_cases("lanesegment")[case]
    frames = [frame[:2] for frame in load_segments(case)]
    result = evaluate(frames)
    stable = expected["olus"] | expected["stable_sort_differs"]
    for name in ("DET_l", "DET_a", "DET_t", "TOP_ll", "TOP_lt", "OLUS"):
        assert result[name] == pytest.approx(stable[name], abs=1e-6), name
    lanesegnet = evaluate(frames, "LaneSegNet")
    stable = expected["lanesegnet"] | expected["lanesegnet_stable_sort_differs"]
    for name in ("AP_ls", "AP_ped", "mAP", "TOP_lsls"):
        assert lanesegnet[name] == pytest.approx(stable[name], abs=1e-6), name
    if not expected["tie_sensitive"]:
        for ours, official, thresholds in (
            ("DET_l", "DET_l", LANE_THRESHOLDS),
            ("crossing", "DET_a_ped", AREA_THRESHOLDS),
            ("boundary", "DET_a_boundary", AREA_THRESHOLDS),
            ("DET_t", "DET_t", range(13)),
        ):
            key = f"{official}_per_{'attribute' if ours == 'DET_t' else 'threshold'}"
            got = [result[f"{ours}@{t}"] for t in thresholds]
            np.testing.assert_allclose(got, expected["olus"][key], atol=1e-6, err_msg=key)


@pytest.mark.golden
@pytest.mark.parametrize("case", CASES)
def test_golden_distances_and_matches(case):
    expected = expected_cases("lanesegment")[case]
    topology = {key: np.array(expected["olus"][f"{key}_per_threshold_frame"], float) for key in ("TOP_ll", "TOP_lt")}
    tied = bool(expected["tie_sensitive"])
    for f, (detections, truth, official) in enumerate(load_segments(case)):
        distance, nearest = nearest_segments(
            [truth.lanes.points, truth.left, truth.right],
            [detections.lanes.points, detections.left, detections.right],
        )
        matrix = official["out_lane_dist"]
        if len(matrix):
            # Pairs beyond the largest threshold are not all measured; they must only stay beyond it.
            near = matrix.min(0) < LANE_THRESHOLDS[-1]
            np.testing.assert_array_equal(distance < LANE_THRESHOLDS[-1], near)
            np.testing.assert_allclose(distance[near], matrix.min(0)[near], atol=1e-6)
            np.testing.assert_array_equal(nearest[near], matrix.argmin(0)[near])
        scores = detections.lanes.scores
        if len(set(scores.tolist())) == len(scores):  # the official order of ties is not defined
            frame = match_lanes(detections.lanes, truth.lanes, distance, nearest)
            matches = np.where(frame.hits, frame.nearest, -1)
            np.testing.assert_array_equal(matches, [official[f"out_lane_match_{t}"] for t in LANE_THRESHOLDS])
            assert np.isnan(topology["TOP_ll"][:, f]).all() == (frame.lanes == 0)
            if frame.lanes and not tied:
                mean = frame.topology["v2.1"].sum(-1) / (2 * frame.lanes)
                np.testing.assert_allclose(mean, topology["TOP_ll"][:, f], atol=1e-6)
            elements = frame.elements
            if elements is not None and elements.vertices and not tied:
                np.testing.assert_allclose(
                    elements.topology["v2.1"] / elements.vertices, topology["TOP_lt"][:, f], atol=1e-6
                )


@pytest.mark.golden
@pytest.mark.parametrize("case", CASES)
def test_golden_area_distances(case):
    for detections, truth, official in load_segments(case):
        true = PaddedLines.of(truth.areas.points, "truth").open_ends()
        found = PaddedLines.of(detections.areas.points, "detections")
        i, j = np.nonzero(np.ones((len(true), len(found))))
        expected = official["out_area_dist"][i, j]
        np.testing.assert_allclose(pair_chamfer(true, found, i, j), expected, atol=1e-6)


def segment(y, points=5):
    """Return a 10 m segment along x, 4 m wide, its centerline at `y`."""
    return [straight((0, y + side, 0), (10, y + side, 0), points) for side in (0.0, 2.0, -2.0)]


def frame(true, found, scores, areas=((), ()), found_areas=((), (), ())):
    """Return a frame of segments at the given y."""
    (tc, tl, tr), (fc, fl, fr) = (
        zip(*map(segment, ys), strict=True) if len(ys) else ((), (), ()) for ys in (true, found)
    )
    g, p = len(true), len(found)
    return (
        SegmentDetections(
            LaneDetections(fc, np.array(scores, float), np.zeros((p, p))),
            fl,
            fr,
            AreaDetections(found_areas[0], np.array(found_areas[1], int), np.array(found_areas[2])),
        ),
        SegmentTruth(LaneTruth(tc, np.zeros((g, g), bool)), tl, tr, AreaTruth(areas[0], np.array(areas[1], int))),
    )


def test_a_shift_counts_one_and_a_half_times():
    detections, truth = frame([0.0], [0.6, 0.8], [0.9, 0.8])
    distance, nearest = nearest_segments(
        [truth.lanes.points, truth.left, truth.right], [detections.lanes.points, detections.left, detections.right]
    )
    np.testing.assert_allclose(distance, [0.9, 1.2])
    np.testing.assert_array_equal(nearest, [0, 0])
    # Within 1 m only the first; the second never gets a lane, which is taken.
    result = evaluate([(detections, truth)])
    assert [result[f"DET_l@{t}"] for t in LANE_THRESHOLDS] == [1.0, 1.0, 1.0]
    second = evaluate([frame([0.0], [0.6, 0.8], [0.8, 0.9])])
    # The first in rank misses at 1 m (precision 1/2 at every recall) and takes the lane at 2 and 3 m.
    assert [second[f"DET_l@{t}"] for t in LANE_THRESHOLDS] == pytest.approx([0.5, 1.0, 1.0])


def test_side_lines_cannot_bring_back_a_far_centerline():
    detections, truth = frame([0.0], [0.0], [0.9])
    moved = dataclasses.replace(detections, lanes=dataclasses.replace(detections.lanes, points=[segment(3.0)[0]]))
    distance, _ = nearest_segments(
        [truth.lanes.points, truth.left, truth.right], [moved.lanes.points, moved.left, moved.right]
    )
    assert distance.tolist() == [np.inf]


def test_areas_by_hand():
    square = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [0, 0, 0]], float)
    # The closing vertex of the truth is dropped; shifted by 0.6 m, every vertex is 0.6 m from its twin.
    moved = square + np.array([0, 0, 0.6])
    result = evaluate([frame([], [], [], ([square], [1]), ([moved], [1], [0.5]))])
    assert [result[f"crossing@{t}"] for t in AREA_THRESHOLDS] == [0.0, 1.0, 1.0]
    # No boundary on either side counts as found, and so do lanes.
    assert [result[f"boundary@{t}"] for t in AREA_THRESHOLDS] == [1.0, 1.0, 1.0]
    assert result["DET_a"] == pytest.approx(5 / 6)
    own = evaluate([frame([], [], [], ([square], [1]), ([moved], [1], [0.5]))], "LaneSegNet")
    assert own["AP_ped"] == pytest.approx(2 / 3)
    assert own["mAP"] == pytest.approx((1 + 2 / 3) / 2)
    # A boundary is no crossing.
    other = evaluate([frame([], [], [], ([square], [1]), ([moved], [2], [0.5]))])
    assert other["DET_a"] == 0.0


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 10**6))
def test_order_does_not_matter_and_parts_merge(seed):
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(3):
        g, p = rng.integers(0, 5), rng.integers(0, 7)
        frames.append(frame(rng.uniform(-20, 20, g), rng.uniform(-20, 20, p), rng.permutation(p) / 10 + 0.05))
    whole = evaluate(frames)
    detections, truth = frames[0]
    order = rng.permutation(len(detections.left))
    pick = lambda lines: [lines[i] for i in order]  # noqa: E731
    shuffled = SegmentDetections(
        LaneDetections(pick(detections.lanes.points), detections.lanes.scores[order], detections.lanes.successor),
        pick(detections.left),
        pick(detections.right),
        detections.areas,
    )
    assert evaluate([(shuffled, truth), *frames[1:]]) == pytest.approx(whole)
    first, second = LaneSegmentMetrics(), LaneSegmentMetrics()
    first.update(*frames[0])
    for later in frames[1:]:
        second.update(*later)
    assert first.merge(second).compute() == pytest.approx(whole)


def test_arrays_may_be_reused_after_an_update():
    boundary = straight((0, 0, 0), (5, 0, 0), 4)
    frames = [frame([0.0, 8.0], [0.1, 4.0], [0.9, 0.8], ([boundary], [2]), ([boundary], [2], [0.5]))]
    frames.append(frame([0.0], [4.0, 0.1], [0.7, 0.6], ([boundary], [2]), ([boundary + 9], [2], [0.4])))
    metrics = LaneSegmentMetrics()
    for detections, truth in frames:
        metrics.update(detections, truth)
    expected = metrics.compute()
    for detections, _ in frames[:1]:
        detections.lanes.scores[:] = 0.0
        detections.areas.scores[:] = 0.0
        detections.areas.categories[:] = 1
    assert metrics.compute() == expected


def test_empty_input():
    assert evaluate([])["DET_l"] == 1.0
    assert evaluate([frame([], [], [])])["DET_a"] == 1.0
    assert "OLUS" not in evaluate([])


def test_mismatched_shapes_are_named():
    detections, truth = frame([0.0], [0.0], [0.9])
    with pytest.raises(UserError, match="detections: 1 centerlines, 0 left lines, 1 right lines"):
        evaluate([(dataclasses.replace(detections, left=[]), truth)])
    areas = AreaTruth([np.zeros((2, 3))], np.array([3]))
    with pytest.raises(UserError, match="truth: area categories must be 1"):
        evaluate([(detections, dataclasses.replace(truth, areas=areas))])
    with pytest.raises(UserError, match="cannot merge"):
        LaneSegmentMetrics().merge(LaneSegmentMetrics("LaneSegNet"))
