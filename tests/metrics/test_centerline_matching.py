"""Nearest lanes and boxes against the full matrix of pairs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.cases import random_frame
from tests.metrics.definitions import all_pairs, frechet
from tflane_jax.geometry.polylines import pad_lines
from tflane_jax.metrics.centerline_matching import iou_distance, nearest_lanes


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), lanes=st.integers(1, 8), detections=st.integers(0, 12))
def test_nearest_equals_the_full_matrix(seed, lanes, detections):
    found, truth = random_frame(seed, lanes, detections)
    relax = [max(0.5, 1 - 0.005 * min(np.hypot(np.hypot(*v[:2]), v[2]) for v in line)) for line in truth.points]
    matrix = np.array(relax)[:, None] * all_pairs(frechet, truth.points, found.points)
    distance, nearest = nearest_lanes(pad_lines(truth.points), pad_lines(found.points))
    np.testing.assert_allclose(distance, matrix.min(0), rtol=1e-12)
    np.testing.assert_array_equal(nearest, matrix.argmin(0))


def test_twins_give_the_first_and_no_lane_gives_inf():
    line = np.linspace((5, 0, 0), (20, 0, 0), 4)
    _, nearest = nearest_lanes(np.stack([line + 9, line, line]), line[None] + 0.1)
    np.testing.assert_array_equal(nearest, [1])
    distance, nearest = nearest_lanes(np.zeros((0, 4, 3)), line[None])
    assert np.isinf(distance).all()
    assert nearest.shape == (1,)


def test_iou_distance():
    box = [[0, 0], [2, 2]]
    others = np.array([box, [[1, 0], [3, 2]], [[5, 5], [6, 6]], [[1, 1], [1, 1]]], float)
    np.testing.assert_allclose(iou_distance(np.array([box], float), others), [[0, 1 - 2 / 6, 1, 1]])
    point = np.zeros((1, 2, 2))
    assert iou_distance(point, point) == pytest.approx(1.0)
    assert iou_distance(np.zeros((0, 2, 2)), others).shape == (0, 4)
