"""Matching of lane segments against the official results, and the errors of matched pairs."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.fixtures import expected_cases, load_segments
from tests.metrics.segments import evaluate, frame, random_segments, segment, with_types
from tflane_jax.errors import UserError
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, match_lanes
from tflane_jax.metrics.chamfer import PaddedLines, pair_chamfer
from tflane_jax.metrics.segment_matching import (
    CROSSING,
    AreaDetections,
    AreaTruth,
    match_areas,
    match_segments,
    nearest_segments,
)

CASES = list(expected_cases("lanesegment"))


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


def test_far_segments_are_nearest_by_the_relaxed_distance():
    """All in between are 3 m or more away: 28 m x 0.9 to the lane at 20 m, and 32 m x 0.6 to that at 80 m."""
    detections, truth = frame([20.0, 80.0], [48.0], [0.9])
    distance, nearest = nearest_segments(
        [truth.lanes.points, truth.left, truth.right],
        [detections.lanes.points, detections.left, detections.right],
        nearest="all",
    )
    assert distance.tolist() == [np.inf]
    assert nearest.tolist() == [1]


def test_side_lines_cannot_bring_back_a_far_centerline():
    detections, truth = frame([0.0], [0.0], [0.9])
    moved = dataclasses.replace(detections, lanes=dataclasses.replace(detections.lanes, points=[segment(3.0)[0]]))
    distance, _ = nearest_segments(
        [truth.lanes.points, truth.left, truth.right], [moved.lanes.points, moved.left, moved.right]
    )
    assert distance.tolist() == [np.inf]


def chamfer_by_loops(a, b):
    """Return the Chamfer distance of the rules, the first line without its closing vertex."""
    a = a[:-1] if len(a) > 1 and (a[0] == a[-1]).all() else a
    distance = np.array([[np.linalg.norm(u - v) for v in b] for u in a])
    return 0.5 * (distance.min(0).mean() + distance.min(1).mean())


def ring_and_moved_corner(x, shift):
    """Return a closed ring of 4 m x 2 m that begins at `x`, and its four corners with the first one moved along x."""
    ring = np.array([(x, 0, 0), (x + 4, 0, 0), (x + 4, 2, 0), (x, 2, 0), (x, 0, 0)], float)
    corners = ring[:-1].copy()
    corners[0, 0] += shift
    return ring, corners


def test_the_closing_vertex_of_a_true_area_does_not_count():
    """One corner of four is 1.8 m off: 0.45 m, a hit at each threshold; counted twice, it would be 0.585 m."""
    ring, corners = ring_and_moved_corner(0.0, -1.8)
    assert chamfer_by_loops(ring, corners) == pytest.approx(0.45)
    detected = AreaDetections([corners], np.array([CROSSING]), np.array([0.9]))
    matched = match_areas(detected, AreaTruth([ring], np.array([CROSSING])))
    assert matched.hits.tolist() == [[True], [True], [True]]


def test_the_closing_vertex_of_a_true_side_line_does_not_count_in_the_error():
    """As of areas: one corner of four is 1.2 m off, on one of three lines."""
    ring, corners = ring_and_moved_corner(10.0, -1.2)
    detections, truth = frame([0.0], [0.0], [0.9])
    sides = dataclasses.replace(detections, left=[corners]), dataclasses.replace(truth, left=[ring])
    assert chamfer_by_loops(ring, corners) == pytest.approx(0.3)
    assert evaluate([sides], "LaneSegNet")["AE_dist"] == pytest.approx(0.3 / 3)


@pytest.mark.golden
@pytest.mark.parametrize("case", CASES)
def test_errors_are_those_of_the_official_matches(case):
    frames, errors = load_segments(case), {t: [] for t in LANE_THRESHOLDS}
    if any(len(set(d.lanes.scores.tolist())) < len(d.lanes.scores) for d, _, _ in frames):
        pytest.skip("the official order of ties is not defined")
    for detections, truth, official in frames:
        for threshold, found in errors.items():
            for p, g in enumerate(official[f"out_lane_match_{threshold}"]):
                if g >= 0:
                    pairs = [(truth.lanes.points, detections.lanes.points)]
                    pairs += [(getattr(truth, side), getattr(detections, side)) for side in ("left", "right")]
                    found.append(np.mean([chamfer_by_loops(a[g], b[p]) for a, b in pairs]))
    result = evaluate([frame[:2] for frame in frames], "LaneSegNet")
    for threshold, found in errors.items():
        if found:
            assert result[f"AE_dist@{threshold}"] == pytest.approx(np.mean(found), abs=1e-6)
        else:
            assert f"AE_dist@{threshold}" not in result
    assert result.get("AE_dist") == result.get("AE_dist@3.0")
    assert "AE_type" not in result  # these files have no types


def test_errors_by_hand():
    """Two segments: the first is found 0.6 m aside with one wrong type, the second 1.6 m aside with two right ones."""
    shifted = with_types(
        frame([0.0, 9.0], [0.6, 10.6, 30.0], [0.9, 0.8, 0.7]), [(1, 2), (0, 1)], [(1, 1), (0, 1), (2, 2)]
    )
    result = evaluate([shifted], "LaneSegNet")
    assert result["AE_dist@1.0"] == pytest.approx(0.6)  # the distance of 1.6 m aside is 2.3 m, after relaxation
    assert result["AE_dist"] == result["AE_dist@3.0"] == pytest.approx(1.1)
    assert (result["AE_type@1.0"], result["AE_type"]) == (0.5, 0.25)
    assert evaluate([shifted])["AE_dist"] == result["AE_dist"]
    # Frames without types count in the distance alone.
    mixed = evaluate([shifted, frame([0.0], [0.0], [0.9])], "LaneSegNet")
    assert (mixed["AE_type"], mixed["AE_dist"]) == (0.25, pytest.approx(2.2 / 3))
    with pytest.raises(UserError, match="detections: left_type has shape"):
        evaluate([(dataclasses.replace(shifted[0], left_type=np.zeros(2, int)), shifted[1])])


@pytest.mark.parametrize(("true", "found"), [([], []), ([0.0], []), ([], [0.0]), ([0.0], [8.0])])
def test_without_matched_pairs_there_is_no_error(true, found):
    none = with_types(frame(true, found, [0.5] * len(found)), [(0, 0)] * len(true), [(0, 0)] * len(found))
    assert not [name for name in evaluate([none], "LaneSegNet") if name.startswith("AE")]


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_a_rigid_motion_keeps_the_errors_of_the_same_pairs(seed):
    """A shift changes the relaxation of the AP with the distance to the vehicle, but no error of a pair."""
    rng = np.random.default_rng(seed)
    detections, truth = random_segments(rng)
    shift = rng.uniform(-5, 5, 3)

    def shifted(part):
        lines = {side: [line + shift for line in getattr(part, side)] for side in ("left", "right")}
        points = [line + shift for line in part.lanes.points]
        return dataclasses.replace(part, lanes=dataclasses.replace(part.lanes, points=points), **lines)

    one, other = (match_segments(d, t) for d, t in ((detections, truth), (shifted(detections), shifted(truth))))
    both = one.hits[-1] & other.hits[-1] & (one.segments.nearest == other.segments.nearest)
    np.testing.assert_allclose(one.distance[both], other.distance[both], atol=1e-9)
    np.testing.assert_array_equal(one.wrong[both], other.wrong[both])
