"""Polylines: arc length, resampling and clipping against the official cases, shapely and plain interpolation."""

import gzip
import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely import LineString, Point, box

from tests.shared import shared_root
from tflane_jax.geometry import PerceptionRange, pose_matrix, transform_points
from tflane_jax.geometry.polylines import (
    arc_length,
    clip_to_range,
    line_distances,
    line_lengths,
    nearest_lines,
    nearest_on,
    pad_lines,
    resample,
    sample_at,
    simplify,
    without_repeats,
)

QUICK = settings(max_examples=60)
RANGE = PerceptionRange((-10.0, 10.0), (-5.0, 5.0))
GOLDEN = shared_root() / "golden/metrics/resample/cases.json.gz"


def golden_cases():
    if not GOLDEN.exists():
        return []
    with gzip.open(GOLDEN, "rt") as file:
        return json.load(file)["cases"]


@pytest.mark.golden
@pytest.mark.parametrize("case", golden_cases(), ids=lambda case: f"{len(case['points'])}to{case['n']}")
def test_golden_resampling(case):
    expected = np.array(case["expected"])
    np.testing.assert_allclose(resample(np.array(case["points"]), case["n"]), expected, rtol=0, atol=1e-9)


def random_line(seed, points, dims=3, grid=False):
    rng = np.random.default_rng(seed)
    line = rng.uniform(-15, 15, (points, dims))
    # On a grid: repeated vertices, segments along the border and vertices exactly on it.
    return np.round(line / 5) * 5 if grid else line


@QUICK
@given(seed=st.integers(0, 10**6), points=st.integers(2, 9), count=st.integers(2, 20))
def test_resampling_equals_interpolation_over_ground_length(seed, points, count):
    line = random_line(seed, points)
    along = np.array([0.0, *np.cumsum([np.hypot(*(b - a)[:2]) for a, b in pairwise(line)])])
    np.testing.assert_allclose(arc_length(line), along, atol=1e-12)
    distances = np.linspace(0, along[-1], count)
    expected = np.stack([np.interp(distances, along, line[:, axis]) for axis in range(3)], -1)
    out = resample(line, count)
    np.testing.assert_allclose(out, expected, atol=1e-9)
    np.testing.assert_array_equal(out[[0, -1]], line[[0, -1]])
    assert arc_length(out)[-1] <= along[-1] + 1e-9


@QUICK
@given(seed=st.integers(0, 10**6), points=st.integers(2, 9), count=st.integers(2, 12))
def test_resampling_commutes_with_motion_and_reversal(seed, points, count):
    line = random_line(seed, points)
    yaw = seed % 7
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    pose = pose_matrix(turn, np.array([3.0, -40.0, 2.0]))
    np.testing.assert_allclose(
        resample(transform_points(pose, line), count), transform_points(pose, resample(line, count)), atol=1e-9
    )
    np.testing.assert_allclose(resample(line[::-1], count), resample(line, count)[::-1], atol=1e-9)


def test_resampling_a_straight_line_is_even_and_again_is_the_same():
    out = resample(np.array([[0.0, 0, 0], [1, 0, 1], [1, 0, 1], [10, 0, 10]]), 11)
    np.testing.assert_allclose(out, np.arange(11)[:, None] * [1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(resample(out, 11), out, atol=1e-12)


@pytest.mark.parametrize("line", [np.ones((1, 3)), np.ones((4, 3)), np.array([[1.0, 1, 1], [1, 1, 9]])])
def test_line_without_ground_length_repeats_its_first_point(line):
    np.testing.assert_array_equal(resample(line, 5), np.ones((5, 3)))


def test_no_points_and_distances_beyond_the_ends():
    with pytest.raises(ValueError, match="without points"):
        resample(np.zeros((0, 3)), 5)
    line = np.array([[0.0, 0.0], [2.0, 0.0]])
    np.testing.assert_array_equal(sample_at(line, np.array([-1.0, 0.5, 3.0])), [[0, 0], [0.5, 0], [2, 0]])
    assert sample_at(line, np.zeros(0)).shape == (0, 2)


@QUICK
@given(seed=st.integers(0, 10**6), points=st.integers(2, 12), grid=st.booleans())
def test_clipping_equals_shapely(seed, points, grid):
    line = random_line(seed, points, grid=grid)
    assume(arc_length(line)[-1] > 0)
    pieces = clip_to_range(line, RANGE)
    for piece in pieces:
        assert RANGE.contains(piece).all()
        assert arc_length(piece)[-1] > 0
    frame = box(RANGE.x[0], RANGE.y[0], RANGE.x[1], RANGE.y[1])
    segments = [LineString(line[i : i + 2, :2]) for i in range(points - 1) if (line[i, :2] != line[i + 1, :2]).any()]
    # Segment by segment, because shapely merges what a line covers twice.
    expected = sum(segment.intersection(frame).length for segment in segments)
    assert sum(arc_length(piece)[-1] for piece in pieces) == pytest.approx(expected, abs=1e-9)
    ends = [end for piece in pieces for end in (piece[0], piece[-1])]
    own = {tuple(vertex) for vertex in line}
    for end in ends:
        on_border = np.isin(end[0], RANGE.x) or np.isin(end[1], RANGE.y)
        assert on_border or tuple(end) in own


@QUICK
@given(seed=st.integers(0, 10**6), points=st.integers(1, 12))
def test_the_nearest_place_on_a_line_is_that_of_shapely(seed, points):
    line, place = random_line(seed, points, grid=False), np.random.default_rng(seed).uniform(-20, 20, 2)
    segment, fraction, distance = nearest_on(line, place)
    expected = Point(line[0]) if points == 1 else LineString(line[:, :2])
    assert distance == pytest.approx(expected.distance(Point(place)))
    there = line[segment] + fraction * (line[min(segment + 1, points - 1)] - line[segment])
    assert np.linalg.norm(there[:2] - place) == pytest.approx(distance)


@pytest.mark.parametrize("shape", [(3,), (2, 4), (0, 3), (2, 1)])
def test_lengths_of_lines_are_in_the_ground_plane(shape):
    lines = np.random.default_rng(0).uniform(-9, 9, (*shape, 3))
    expected = [arc_length(line)[-1] for line in lines.reshape(-1, *lines.shape[-2:])]
    np.testing.assert_allclose(line_lengths(lines), np.reshape(expected, shape[:-1]))


@QUICK
@given(seed=st.integers(0, 10**6), points=st.integers(1, 9), others=st.integers(2, 9))
def test_distances_to_lines_are_those_of_shapely(seed, points, others):
    rng = np.random.default_rng(seed)
    lines, seconds = rng.uniform(-9, 9, (2, points, 3)), rng.uniform(-9, 9, (3, others, 3))
    seconds[0, 1] = seconds[0, 0]  # a piece without length
    distance, place = line_distances(lines[:, None], seconds)
    assert distance.shape == place.shape == (2, 3, points)
    for i, j, k in np.ndindex(distance.shape):
        assert distance[i, j, k] == pytest.approx(LineString(seconds[j, :, :2]).distance(Point(lines[i, k, :2])))
        there = [np.interp(place[i, j, k], np.arange(others), seconds[j, :, axis]) for axis in (0, 1)]
        assert np.linalg.norm(there - lines[i, k, :2]) == pytest.approx(distance[i, j, k])
    paired = line_distances(lines, seconds[:2])
    for pair, alone in zip(paired, (distance, place), strict=True):
        np.testing.assert_array_equal(pair, alone[[0, 1], [0, 1]])


@pytest.mark.parametrize(("lines", "others"), [(0, 3), (3, 0), (0, 0), (1, 1)])
def test_distances_of_few_lines(lines, others):
    found = line_distances(np.zeros((lines, 1, 4, 3)), np.zeros((others, 2, 3)))
    assert [array.shape for array in found] == [(lines, others, 4)] * 2


def test_the_nearest_lines_are_those_that_pass_near():
    lines = [np.array(points, float) for points in ([[5, 3]], [[-60, 0], [60, 0]], [[-1, 2], [0, 2], [1, 2]])]
    assert nearest_lines(lines, 1).tolist() == [1]
    assert nearest_lines(lines, 2).tolist() == [1, 2]
    assert nearest_lines(lines, 1, (5.0, 3.0)).tolist() == [0]
    assert nearest_lines(lines, 9).tolist() == [0, 1, 2]
    assert nearest_lines([], 2).tolist() == []


@QUICK
@given(seed=st.integers(0, 10**6), points=st.integers(2, 12), grid=st.booleans())
def test_clipping_cuts_exactly_where_the_line_leaves(seed, points, grid):
    line = random_line(seed, points, grid=grid)
    pieces = clip_to_range(line, RANGE)
    # Sampled finely in the line's own parameter, a piece is a run of points inside: as many runs of some length as
    # pieces (a touch at one point is no piece), in the same order.
    t = np.linspace(0, points - 1, 4_000 * (points - 1) + 1)
    dense = np.stack([np.interp(t, np.arange(points), line[:, axis]) for axis in range(3)], -1)
    inside = RANGE.contains(dense)
    starts = np.flatnonzero(np.diff(np.concatenate([[False], inside]).astype(int)) == 1)
    stops = np.flatnonzero(np.diff(np.concatenate([inside, [False]]).astype(int)) == -1)
    long = [(i, j) for i, j in zip(starts, stops, strict=True) if arc_length(dense[i : j + 1])[-1] > 0.02]
    clear = [piece for piece in pieces if arc_length(piece)[-1] > 0.02]
    assert len(long) == len(clear)
    for (i, j), piece in zip(long, clear, strict=True):
        np.testing.assert_allclose(piece[[0, -1]], dense[[i, j]], atol=0.01)


def test_clipping_keeps_a_line_inside_and_drops_touches():
    line = np.array([[-9.0, 0, 1], [0, 1, 2], [9, 0, 3]])
    (piece,) = clip_to_range(line, RANGE)
    np.testing.assert_array_equal(piece, line)
    assert clip_to_range(np.array([[10.0, 8, 0], [10, 5, 0], [14, 5, 0]]), RANGE) == []
    assert clip_to_range(np.array([[0.0, 8, 0], [9, 8, 0]]), RANGE) == []
    for size in (0, 1):
        assert clip_to_range(np.zeros((size, 3)), RANGE) == []


@pytest.mark.parametrize("top", [0.0, 3.0])
def test_clipping_drops_lines_without_length_on_the_ground(top):
    assert clip_to_range(np.array([[1.0, 2, 0], [1, 2, top]]), RANGE) == []


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ([[-12, 0], [-10, 0], [0, 0]], [[[-10, 0], [0, 0]]]),
        ([[-12, 0], [-10, 0], [12, 0]], [[[-10, 0], [10, 0]]]),
        ([[0, 0], [10, 0], [12, 0]], [[[0, 0], [10, 0]]]),
        ([[0, 0], [10, 0], [12, 0], [10, 0], [0, 0]], [[[0, 0], [10, 0]], [[10, 0], [0, 0]]]),
        ([[0, 0], [10, 0], [0, 2]], [[[0, 0], [10, 0], [0, 2]]]),  # touches the border from inside: stays whole
        ([[12, 3], [8, 7], [0, 0]], [[[5.714285714285714, 5], [0, 0]]]),  # touches the corner (10, 5) first
    ],
)
def test_clipping_keeps_a_vertex_on_the_border_once(line, expected):
    """Regression: the segment outside that ends there gave the vertex a second time."""
    pieces = clip_to_range(np.array(line, float), RANGE)
    assert len(pieces) == len(expected)
    for piece, points in zip(pieces, expected, strict=True):
        np.testing.assert_allclose(piece, points, rtol=1e-12)


def test_clipping_beside_a_parallel_border_moves_no_point_sideways():
    # Half a metre from the border x = 10, cut at half of its length.
    (piece,) = clip_to_range(np.array([[9.5, -10, 0], [9.5, 0, 0]]), RANGE)
    np.testing.assert_array_equal(piece, [[9.5, -5, 0], [9.5, 0, 0]])


def test_clipping_interpolates_height_and_splits():
    line = np.array([[0.0, 0, 0], [20, 0, 10], [20, 2, 10], [0, 2, 0]])
    first, second = clip_to_range(line, RANGE)
    np.testing.assert_allclose(first, [[0, 0, 0], [10, 0, 5]])
    np.testing.assert_allclose(second, [[10, 2, 5], [0, 2, 0]])


def test_pad_lines_without_lines_or_points():
    assert pad_lines([]).shape[::2] == (0, 3)
    with pytest.raises(ValueError, match="polyline 1 has no points"):
        pad_lines([np.zeros((2, 3)), np.zeros((0, 3))])


@settings(max_examples=40)
@given(st.integers(0, 1000), st.integers(1, 30), st.floats(0.01, 5.0))
def test_simplified_lines_stay_within_the_tolerance(seed, count, tolerance):
    line = np.cumsum(np.random.default_rng(seed).normal(size=(count, 2)), 0)
    short = simplify(line, tolerance)
    np.testing.assert_array_equal(short[[0, -1]], line[[0, -1]])
    assert len(short) <= len(line)
    if len(short) > 1:
        assert max(LineString(short).distance(Point(point)) for point in line) <= tolerance + 1e-9
    np.testing.assert_array_equal(simplify(line, 0.0), line)


def test_simplifying_drops_points_on_a_straight_line():
    line = np.stack([np.arange(9.0), np.zeros(9)], -1)
    np.testing.assert_array_equal(simplify(line, 0.1), line[[0, -1]])
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = 15 * np.stack([np.cos(angle), np.sin(angle)], -1)
    ring[-1] = ring[0]
    # Chords of 22.5 degrees miss the circle by 0.3 m, of 45 degrees by 1.1 m.
    assert len(simplify(ring, 1.0)) == 17


def test_lines_are_simplified_in_the_ground_plane():
    line = random_line(3, 40)
    short = simplify(line, 4.0)
    assert 2 < len(short) < 40
    np.testing.assert_array_equal(short[:, :2], simplify(line[:, :2], 4.0))
    assert {tuple(point) for point in short} <= {tuple(point) for point in line}


@pytest.mark.parametrize("dims", [2, 3])
def test_points_that_repeat_the_one_before_are_left_out(dims):
    line = np.array([[0, 0, 0], [0.05, 0, 9], [0.1, 0, 0], [1, 0, 0], [1, 0.3, 0], [1, 0.3, 5]])[:, :dims]
    assert without_repeats(line, 0.1)[:, :2].tolist() == [[0, 0], [1, 0], [1, 0.3]]
    np.testing.assert_array_equal(without_repeats(line, 0.0), line[:5])
    for count in (0, 1):
        assert without_repeats(line[:count], 0.1).shape == (count, dims)
