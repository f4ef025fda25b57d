"""Marker observations as lanes with a confidence."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.priors.markers import MarkerPriorConfig, confidence, marker_confidence, select_marker_lanes, stride
from tflane_jax.scene import MarkerObservations

CONFIG = MarkerPriorConfig(points=3, lanes=7)


def observations(markers=2, lanes=3, points=5, seed=0, valid=(True, True), garbage=0.0):
    rng = np.random.default_rng(seed)
    pose = np.tile(np.eye(4, dtype=np.float32), (markers, 1, 1))
    pose[:, :3, 3] = rng.uniform(-30, 30, (markers, 3))
    out = MarkerObservations(
        marker_id=np.arange(markers),
        pose=pose,
        score=rng.uniform(0.5, 1, markers).astype(np.float32),
        residual=rng.uniform(0, 5, markers).astype(np.float32),
        lanes=rng.uniform(-40, 40, (markers, lanes, points, 3)).astype(np.float32),
        lane_valid=rng.random((markers, lanes)) < 0.7,
        successor=rng.random((markers, lanes, lanes)) < 0.3,
        valid=np.array(valid[:markers], bool),
    )
    out.validate()
    gone, lane_gone = ~out.valid, ~(out.lane_valid & out.valid[:, None])
    for value in (out.pose, out.score, out.residual):
        value[gone] = garbage
    out.lanes[lane_gone] = garbage
    return out


def test_confidence_is_equation_two():
    config = MarkerPriorConfig()
    assert confidence(np.array([0.0]), np.array([0.0]), config) == 1.0
    got = confidence(np.array([40.0, 20.0]), np.array([0.0, 10.0]), config)
    np.testing.assert_allclose(got, [np.exp(-1.0), np.exp(-1.5)])


@given(st.floats(0, 200), st.floats(0, 200), st.floats(0.1, 50), st.floats(0.1, 50))
@settings(max_examples=50)
def test_confidence_falls_with_distance_and_residual(distance, residual, more, shake):
    config = MarkerPriorConfig()
    here = confidence(np.array([distance]), np.array([residual]), config)
    assert confidence(np.array([distance + more]), np.array([residual]), config) < here
    assert confidence(np.array([distance]), np.array([residual + shake]), config) < here
    assert 0 < here <= 1


def expected_lanes(markers):
    """Return (trust, marker, lane) of every valid lane, the most trusted first."""
    trust = np.exp(-np.hypot(*markers.pose[:, :2, 3].T) / 40 - markers.residual / 10)
    rows = [(trust[m], m, j) for m in range(len(trust)) for j in np.flatnonzero(markers.lane_valid[m])]
    return sorted(rows, key=lambda row: -row[0])


def test_lanes_are_thinned_keep_their_ends_and_come_in_order_of_trust():
    markers = observations()
    lanes, expected = select_marker_lanes(markers, CONFIG), expected_lanes(markers)
    np.testing.assert_array_equal(stride(5, 3), [0, 2, 4])
    np.testing.assert_array_equal(np.flatnonzero(lanes.valid), np.arange(len(expected)))
    assert 2 < len(expected) < 7
    for row, (trust, m, j) in enumerate(expected):
        np.testing.assert_array_equal(lanes.points[row], markers.lanes[m, j, ::2, :2])
        np.testing.assert_allclose(lanes.confidence[row], trust, rtol=1e-5)
    np.testing.assert_allclose(lanes.frame_confidence, expected[0][0], rtol=1e-5)


def test_beyond_capacity_the_least_trusted_are_left_out():
    markers = observations()
    expected = expected_lanes(markers)
    trusted = [markers.lanes[m, j, ::2, :2] for trust, m, j in expected if trust == expected[0][0]]
    assert len(trusted) < len(expected)
    few = select_marker_lanes(markers, MarkerPriorConfig(3, lanes=len(trusted)))
    assert few.valid.all()
    assert sorted(few.points.tolist()) == sorted(np.stack(trusted).tolist())
    np.testing.assert_allclose(few.confidence, expected[0][0], rtol=1e-5)


def test_edges_stay_within_their_marker():
    markers = observations(seed=3).replace(lane_valid=np.ones((2, 3), bool))
    edges = select_marker_lanes(markers, CONFIG).successor
    names = [(m, j) for _, m, j in expected_lanes(markers)]
    for a, (m, i) in enumerate(names):
        for b, (n, j) in enumerate(names):
            assert edges[a, b] == (m == n and markers.successor[m, i, j])
    assert not edges[6:].any()


@pytest.mark.parametrize("valid", [(True, False), (False, False)])
def test_padding_may_hold_nan_and_numpy_equals_jax(valid):
    clean, dirty = (observations(seed=1, valid=valid, garbage=value) for value in (0.0, np.nan))
    expected = select_marker_lanes(clean, CONFIG)
    for got in (select_marker_lanes(dirty, CONFIG), jax.jit(select_marker_lanes, static_argnums=1)(dirty, CONFIG)):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), got, expected)
    assert expected.valid.any() == any(valid)
    assert bool(expected.frame_confidence > 0) == any(valid)


@pytest.mark.parametrize("sizes", [(0, 3), (2, 0), (1, 1)])
def test_no_markers_and_no_lanes(sizes):
    lanes = select_marker_lanes(observations(*sizes), CONFIG)
    assert lanes.points.shape == (7, 3, 2)
    assert not lanes.valid[sizes[0] * sizes[1] :].any()
    assert lanes.frame_confidence >= 0


def test_the_raw_score_counts_if_configured():
    markers = observations(markers=1)
    plain, scored = (select_marker_lanes(markers, MarkerPriorConfig(3, use_score=use)) for use in (False, True))
    np.testing.assert_allclose(scored.confidence, plain.confidence * markers.score, rtol=1e-6)


def test_all_markers_can_be_trusted_alike():
    """Then neither distance, residual nor score tells them apart, and they keep the order in which they come."""
    markers = observations()
    markers.residual[:] = [25.0, 0.0]
    chosen = select_marker_lanes(markers, replace(CONFIG, trust="all", use_score=True))
    np.testing.assert_array_equal(chosen.confidence, chosen.valid.astype(float))
    assert chosen.frame_confidence == 1.0
    first = markers.lanes[0, np.flatnonzero(markers.lane_valid[0])[0]]
    np.testing.assert_array_equal(chosen.points[0, [0, -1]], first[[0, -1], :2])


@pytest.mark.parametrize("changed", [{}, {"use_score": True}, {"trust": "all"}])
def test_the_confidence_of_a_marker_is_that_of_its_lanes(changed):
    config = replace(CONFIG, **changed)
    markers = observations(markers=3, valid=(True, True, False), garbage=np.nan).replace(lane_valid=np.eye(3) > 0)
    trust, chosen = marker_confidence(markers, config), select_marker_lanes(markers, config)
    assert trust[2] == 0.0
    np.testing.assert_array_equal(chosen.confidence[:2], sorted(trust[:2], reverse=True))


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="asks for 11"):
        select_marker_lanes(observations(), MarkerPriorConfig())


def test_of_lanes_that_are_trusted_alike_the_nearest_are_kept():
    """One board with five lanes side by side, of which the last in the store is the nearest to the vehicle."""
    empty = MarkerObservations.empty(2, 5, 3)
    lanes = np.zeros((2, 5, 3, 3), np.float32)
    lanes[0, :, :, 0], lanes[0, :, :, 1] = [1.0, 5.0, 9.0], np.array([8.0, 6.0, -4.0, -7.0, 1.0])[:, None]
    lane_valid = np.zeros((2, 5), bool)
    lane_valid[0] = True
    lanes[1] = np.nan
    markers = empty.replace(lanes=lanes, lane_valid=lane_valid, valid=np.array([True, False]), score=np.ones(2))
    for count, kept in ((3, [1.0, -4.0, 6.0]), (5, [8.0, 6.0, -4.0, -7.0, 1.0])):
        for select in (select_marker_lanes, jax.jit(select_marker_lanes, static_argnums=1)):
            found = select(markers, MarkerPriorConfig(lanes=count, points=3))
            assert found.valid.all()
            np.testing.assert_allclose(found.points[:, 0, 1], kept)


def test_the_lane_under_the_vehicle_is_kept_although_its_points_are_far_away():
    empty = MarkerObservations.empty(1, 2, 3)
    lanes = np.zeros((1, 2, 3, 3), np.float32)
    lanes[0, 0, :, 0], lanes[0, 1, :, 0] = [-12.0, -4.5, 4.5], [-9.0, 0.0, 9.0]
    lanes[0, 1, :, 1] = 4.0  # beside the vehicle, with a point nearer than any of the other lane
    markers = empty.replace(lanes=lanes, lane_valid=np.ones((1, 2), bool), valid=np.array([True]), score=np.ones(1))
    for select in (select_marker_lanes, jax.jit(select_marker_lanes, static_argnums=1)):
        found = select(markers, MarkerPriorConfig(lanes=1, points=3))
        np.testing.assert_allclose(found.points[0, :, 1], 0.0)
