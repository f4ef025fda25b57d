"""Rows of lane segments and crossings, as LaneSegNet learns them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.models.segment_truth import segment_targets
from tflane_jax.scene import Areas, AreaType, LaneGraph, LineType

POINTS = 4


def scene(lanes=2, crossings=1, *, capacity=(3, 3), padding=0.0):
    """Return segments along x, each the successor of the one before, and crossings beside a road boundary."""
    segments, areas = LaneGraph.empty(capacity[0], POINTS), Areas.empty(capacity[1], 2 * POINTS)
    for array in (segments.points, segments.left, segments.right, areas.points):
        array[:] = padding
    x = np.linspace(0.0, 6.0, POINTS)
    for i in range(lanes):
        for line, y in ((segments.points, 0.3), (segments.left, 2.0), (segments.right, -2.0)):
            line[i] = np.stack([x + 6.0 * i, np.full(POINTS, y), np.zeros(POINTS)], -1)
    segments.left_type[:], segments.right_type[:] = LineType.SOLID, LineType.DASHED
    segments.valid[:lanes] = True
    segments.successor[:] = True  # also between padding
    for i in range(crossings):
        left = np.stack([np.full(POINTS, 20.0 + i), x, np.zeros(POINTS)], -1)
        areas.points[i] = np.concatenate([left, (left + np.array([3.0, 0.0, 0.0]))[::-1]])
        areas.category[i], areas.valid[i] = AreaType.PEDESTRIAN_CROSSING, True
    if crossings < capacity[1]:
        areas.points[crossings], areas.category[crossings] = 1.0, AreaType.ROAD_BOUNDARY
        areas.valid[crossings] = True
    return segments, areas


def test_segments_come_first_and_crossings_are_of_the_second_class():
    targets = segment_targets(*scene())
    assert targets.valid.tolist() == [True, True, False, True, False, False]
    assert targets.category.tolist() == [0, 0, 0, 1, 1, 1]
    assert targets.left_type.tolist() == [1, 1, 0, 0, 0, 0]
    assert targets.right_type.tolist() == [2, 2, 0, 0, 0, 0]
    expected = np.zeros((6, 6), bool)
    expected[:2, :2] = True
    np.testing.assert_array_equal(targets.successor, expected)
    np.testing.assert_allclose(targets.left[3, :, 0], 20.0)
    np.testing.assert_allclose(targets.right[3, :, 0], 23.0)
    np.testing.assert_allclose(targets.points[3], 0.5 * (targets.left[3] + targets.right[3]))
    np.testing.assert_allclose(targets.right[3, :, 1], targets.left[3, :, 1])  # same direction


@pytest.mark.parametrize(("center", "y"), [("mean", 0.0), ("annotated", 0.3)])
def test_the_center_is_the_mean_of_the_boundaries_or_as_annotated(center, y):
    targets = segment_targets(*scene(), center=center)
    np.testing.assert_allclose(targets.points[:2, :, 1], y, atol=1e-6)
    np.testing.assert_allclose(targets.points[3, :, 0], 21.5)


@pytest.mark.parametrize(
    ("lanes", "crossings", "capacity"), [(0, 0, (0, 0)), (1, 0, (1, 0)), (0, 1, (0, 1)), (1, 1, (1, 1))]
)
def test_sizes_zero_and_one(lanes, crossings, capacity):
    targets = segment_targets(*scene(lanes, crossings, capacity=capacity))
    assert targets.valid.sum() == lanes + crossings
    assert targets.points.shape == (sum(capacity), POINTS, 3)


def test_padding_content_changes_nothing_and_jax_agrees_with_numpy():
    clean, dirty = (segment_targets(*scene(padding=value)) for value in (0.0, np.nan))
    traced = jax.jit(segment_targets)(*jax.tree.map(jnp.asarray, scene(padding=np.nan)))
    for other in (dirty, traced):
        jax.tree.map(np.testing.assert_array_equal, other, clean)


def test_points_that_do_not_fit_are_named():
    segments, _ = scene()
    with pytest.raises(ValueError, match="areas have 6 points, expected 2 x 4"):
        segment_targets(segments, Areas.empty(2, 6))
