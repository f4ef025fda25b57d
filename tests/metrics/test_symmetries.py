"""What metrics of lanes and map lines do not depend on: where the axes point, and the scale of topology scores."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.cases import hand_frame, random_frame
from tflane_jax.metrics import CenterlineMetrics, MapDetections, MapTruth, VectorMapMetrics
from tflane_jax.metrics.centerline_matching import nearest_lanes
from tflane_jax.metrics.frames import checked_lines
from tflane_jax.metrics.map_matching import match_map


def turned(angle, mirrored, dims):
    """Return the matrix that turns about z, after a mirror at the plane y = 0."""
    cos, sin, side = np.cos(angle), np.sin(angle), -1.0 if mirrored else 1.0
    turn = np.eye(3)
    turn[:2, :2] = [[cos, -side * sin], [sin, side * cos]]
    return turn[:dims, :dims]


def moved(frame, move):
    """Return detections and truth with every line moved."""
    return (dataclasses.replace(part, points=[move(line) for line in part.points]) for part in frame)


def score(metrics, detections, truth):
    metrics.update(detections, truth)
    return metrics.compute()


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.floats(-3.1, 3.1), st.booleans())
def test_centerlines_may_be_turned_about_the_vehicle_and_mirrored(seed, angle, mirrored):
    frame, turn = random_frame(seed), turned(angle, mirrored, 3)
    other = tuple(moved(frame, lambda line: line @ turn.T))
    expected, found = (score(CenterlineMetrics(("v2.1", "v1.0")), *each) for each in (frame, other))
    assert found == pytest.approx(expected, rel=1e-9, nan_ok=True)
    # Thresholds hide small differences; distances do not.
    expected, found = (
        nearest_lanes(*(checked_lines(part.points, "lines") for part in reversed(each)))[0] for each in (frame, other)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.floats(-3.1, 3.1), st.booleans(), st.sampled_from(["maptr", "maptrv2"]))
def test_map_lines_may_be_moved_and_mirrored(seed, angle, mirrored, sampling):
    rng, turn = np.random.default_rng(seed), turned(angle, mirrored, 2)
    true = [rng.uniform(-4, 4, 2) + np.cumsum(rng.uniform(0, 1, (rng.integers(2, 9), 2)), 0) for _ in range(5)]
    near = [true[rng.integers(5)] + rng.normal(0.0, 0.5, 2) for _ in range(9)]
    frame = MapDetections(near, rng.integers(0, 3, 9), rng.permutation(9) / 10), MapTruth(true, rng.integers(0, 3, 5))
    other = tuple(moved(frame, lambda line: line @ turn.T + [70, -9]))
    expected, found = (score(VectorMapMetrics(sampling), *each) for each in (frame, other))
    assert found == pytest.approx(expected, rel=1e-9, nan_ok=True)
    expected, found = (match_map(*each, sampling).distance for each in (frame, other))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_topology_above_1_counts_by_its_order():
    """Sums, as TopoLogic's, score as the probabilities of the same order."""

    def stretched(scores):
        return np.where(np.asarray(scores) > 0.5, 9.0 * np.asarray(scores), scores)

    detections, truth = hand_frame()
    assert np.max(detections.successor) > 0.5
    elements = dataclasses.replace(detections.elements, lane=stretched(detections.elements.lane))
    sums = dataclasses.replace(detections, successor=stretched(detections.successor), elements=elements)
    assert score(CenterlineMetrics(), sums, truth) == score(CenterlineMetrics(), detections, truth)
