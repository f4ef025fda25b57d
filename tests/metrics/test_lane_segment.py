"""Lane-segment metrics against the official evaluators, and against numbers worked out by hand."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.cases import straight
from tests.metrics.fixtures import expected_cases, load_segments
from tests.metrics.segments import evaluate, frame, moved, random_segments, with_types
from tflane_jax.errors import UserError
from tflane_jax.metrics import GroupedMetrics, LaneDetections
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS
from tflane_jax.metrics.lane_segment import LaneSegmentMetrics
from tflane_jax.metrics.partitions import ByDistance, ByOcclusion
from tflane_jax.metrics.segment_matching import (
    AREA_THRESHOLDS,
    AreaTruth,
    SegmentDetections,
    match_segments,
)

CASES = list(expected_cases("lanesegment"))
OF_LANESEGNET = partial(LaneSegmentMetrics, "LaneSegNet")


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


@settings(max_examples=20)
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


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.floats(-3.2, 3.2))
def test_a_turn_about_the_vehicle_and_a_mirror_change_nothing(seed, angle):
    rng = np.random.default_rng(seed)
    frames = [random_segments(rng) for _ in range(3)]
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    for flavour in ("OpenLane-V2", "LaneSegNet"):
        expected = evaluate(frames, flavour)
        turned = [tuple(moved(part, turn) for part in frame) for frame in frames]
        assert evaluate(turned, flavour) == pytest.approx(expected, abs=1e-9)
        mirrored = [tuple(moved(part, np.diag([1.0, -1.0, 1.0]), swap=True) for part in frame) for frame in frames]
        assert evaluate(mirrored, flavour) == pytest.approx(expected, abs=1e-9)


PARTITIONS = {"occlusion": ByOcclusion(), "distance": ByDistance((5.0, 15.0))}


@pytest.mark.parametrize("partition", PARTITIONS.values(), ids=PARTITIONS)
def test_groups_share_the_segments_of_all(partition):
    rng = np.random.default_rng(5)
    frames = [random_segments(rng) for _ in range(6)]
    grouped, parts = (GroupedMetrics(OF_LANESEGNET, partition=partition) for _ in range(2)), []
    grouped, other = grouped
    for detections, truth in frames:
        grouped.update(detections, truth)
    result = grouped.compute()
    assert result["all"] == evaluate(frames, "LaneSegNet")
    parts = [result[name] for name in partition.names]
    assert [name for name in result if name != "all"] == list(partition.names)
    assert sum(part["lanes"] for part in parts) == result["all"]["lanes"]
    for name in ("TOP_lsls", "recall"):  # means over the lanes
        weighted = sum(part["lanes"] * part[name] for part in parts) / result["all"]["lanes"]
        assert weighted == pytest.approx(result["all"][name])
    assert not {"AP_ped", "mAP", "crossing@0.5"} & parts[0].keys()
    hits = {group: counts.sum(0) for group, counts in grouped.recalled().items()}
    assert (hits["all"] == sum(hits[name] for name in partition.names)).all()
    for detections, truth in frames[:2]:
        other.update(detections, truth)
    rest = GroupedMetrics(OF_LANESEGNET, partition=partition)
    for detections, truth in frames[2:]:
        rest.update(detections, truth)
    merged = other.merge(rest).compute()
    assert all(merged[group] == pytest.approx(result[group]) for group in result)


@pytest.mark.parametrize(("scores", "precision"), [([0.9, 0.8, 0.7, 0.6], 1.0), ([0.6, 0.8, 0.7, 0.9], 0.5)])
def test_a_false_positive_belongs_to_the_group_of_its_nearest_segment_however_far(scores, precision):
    detections, truth = frame([-20.0, 20.0], [-20.0, 27.0, 60.0, -45.0], scores)
    assert match_segments(detections, truth, nearest="all").segments.nearest.tolist() == [0, 1, 1, 0]
    metrics = GroupedMetrics(OF_LANESEGNET, partition=ByDistance(), lane_groups=("right",))
    metrics.update(detections, truth, members={"right": np.array([True, False])})
    result = metrics.compute()["right"]
    assert (result["lanes"], result["AP_ls"]) == (1, pytest.approx(precision))  # the last detection is its own


def test_the_nearest_of_all_changes_no_official_number():
    rng = np.random.default_rng(6)
    for _ in range(5):
        detections, truth = random_segments(rng)
        close, every = (match_segments(detections, truth, nearest=nearest) for nearest in ("close", "all"))
        matched = close.hits.any(0)
        np.testing.assert_array_equal(close.hits, every.hits)
        np.testing.assert_array_equal(close.distance, every.distance)
        np.testing.assert_array_equal(close.segments.nearest[matched], every.segments.nearest[matched])
        assert not matched.all()


def test_errors_of_a_group_are_those_of_its_segments():
    near, far = [(0.0, 0.6), (9.0, 10.0)]
    detections, truth = with_types(
        frame([near[0], far[0]], [near[1], far[1]], [0.9, 0.8]), [(1, 1), (1, 1)], [(1, 1), (2, 1)]
    )
    metrics = GroupedMetrics(OF_LANESEGNET, partition=ByDistance((5.0,)), lane_groups=("second",))
    metrics.update(detections, truth, members={"second": np.array([False, True])})
    result = metrics.compute()
    assert (result["0 to 5 m"]["AE_dist"], result["0 to 5 m"]["AE_type"]) == (pytest.approx(0.6), 0.0)
    assert (result["from 5 m"]["AE_dist"], result["from 5 m"]["AE_type"]) == (pytest.approx(1.0), 0.5)
    assert result["second"] == result["from 5 m"]


def test_empty_input():
    assert evaluate([])["DET_l"] == 1.0
    assert evaluate([frame([], [], [])])["DET_a"] == 1.0
    assert "OLUS" not in evaluate([])


def test_mismatched_shapes_are_named():
    detections, truth = frame([0.0], [0.0], [0.9])
    with pytest.raises(UserError, match="detections: 1 centerlines, 0 left lines, 1 right lines"):
        evaluate([(dataclasses.replace(detections, left=[]), truth)])
    areas = AreaTruth([np.zeros((2, 3))], np.array([3]))
    with pytest.raises(UserError, match="truth: area categories must be whole numbers from 1 to 2"):
        evaluate([(detections, dataclasses.replace(truth, areas=areas))])
    with pytest.raises(UserError, match="cannot merge"):
        LaneSegmentMetrics().merge(LaneSegmentMetrics("LaneSegNet"))
