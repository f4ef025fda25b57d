"""Marker observations become lanes with a confidence."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.priors.markers import MarkerPriorConfig, confidence, select_marker_lanes, stride
from tflane_jax.scene import MarkerObservations

CONFIG = MarkerPriorConfig(points=3)


def observations(markers=2, lanes=3, points=5, seed=0, valid=(True, True), garbage=0.0):
    rng = np.random.default_rng(seed)
    pose = np.tile(np.eye(4, dtype=np.float32), (markers, 1, 1))
    pose[:, :3, 3] = rng.uniform(-30, 30, (markers, 3))
    out = MarkerObservations(
        marker_id=np.arange(markers), pose=pose, score=rng.uniform(0.5, 1, markers).astype(np.float32),
        residual=rng.uniform(0, 5, markers).astype(np.float32),
        lanes=rng.uniform(-40, 40, (markers, lanes, points, 3)).astype(np.float32),
        lane_valid=rng.random((markers, lanes)) < 0.7, successor=rng.random((markers, lanes, lanes)) < 0.3,
        valid=np.array(valid[:markers], bool),
    )  # fmt: skip
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
@settings(max_examples=50, deadline=None)
def test_farther_or_less_steady_is_trusted_less(distance, residual, more, shake):
    config = MarkerPriorConfig()
    here = confidence(np.array([distance]), np.array([residual]), config)
    assert confidence(np.array([distance + more]), np.array([residual]), config) < here
    assert confidence(np.array([distance]), np.array([residual + shake]), config) < here
    assert 0 < here <= 1


def test_lanes_are_thinned_and_keep_their_ends():
    markers = observations()
    lanes = select_marker_lanes(markers, CONFIG)
    np.testing.assert_array_equal(stride(5, 3), [0, 2, 4])
    for row in np.flatnonzero(lanes.valid):
        m, j = divmod(int(row), 3)
        np.testing.assert_array_equal(lanes.points[row], markers.lanes[m, j, ::2, :2])
        expected = np.exp(-np.hypot(*markers.pose[m, :2, 3]) / 40 - markers.residual[m] / 10)
        np.testing.assert_allclose(lanes.confidence[row], expected, rtol=1e-5)
    np.testing.assert_allclose(lanes.frame_confidence, lanes.confidence.max())


def test_lanes_of_different_markers_are_not_connected():
    markers = observations(seed=3).replace(successor=np.ones((2, 3, 3), bool), lane_valid=np.ones((2, 3), bool))
    edges = select_marker_lanes(markers, CONFIG).successor
    np.testing.assert_array_equal(edges, np.kron(np.eye(2), np.ones((3, 3))).astype(bool))
    own = observations(seed=4).replace(lane_valid=np.ones((2, 3), bool))
    edges = select_marker_lanes(own, CONFIG).successor
    np.testing.assert_array_equal(edges[:3, :3], own.successor[0])
    np.testing.assert_array_equal(edges[3:, 3:], own.successor[1])


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
    assert lanes.points.shape == (sizes[0] * sizes[1], 3, 2)
    assert lanes.frame_confidence >= 0


def test_the_raw_score_counts_where_it_is_asked_for():
    markers = observations()
    plain, scored = (select_marker_lanes(markers, MarkerPriorConfig(3, use_score=use)) for use in (False, True))
    np.testing.assert_allclose(scored.confidence, plain.confidence * np.repeat(markers.score, 3), rtol=1e-6)


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="asks for 11"):
        select_marker_lanes(observations(), MarkerPriorConfig())
