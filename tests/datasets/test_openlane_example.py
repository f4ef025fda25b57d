"""Annotations of OpenLane-V2 at the capacities of an example."""

from dataclasses import replace

import numpy as np
import pytest

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.openlane_annotation import Annotation
from tflane_jax.datasets.openlane_example import area_set, element_set, lane_graph
from tflane_jax.scene import TrafficElements


def annotation(lines, left=None):
    """Return an annotation of lines that are lanes (or lane segments) and road boundaries alike."""
    none, count = np.zeros(len(lines), int), len(lines)
    return Annotation(
        lines=lines,
        left=left,
        right=left,
        left_type=none,
        right_type=none,
        is_connector=np.zeros(count, bool),
        successor=np.zeros((count, count), bool),
        boxes=np.zeros((0, 2, 2)),
        element_category=none[:0],
        attribute=none[:0],
        lane_element=np.zeros((count, 0), bool),
        areas=lines,
        area_category=none + 2,
    )


def test_segments_and_areas_are_resampled_even_if_they_have_the_wanted_points():
    """However many points an annotator drew; a centerline has the devkit's 201, or our own."""
    uneven = np.zeros((10, 3))
    uneven[1:, 0] = np.linspace(1, 4, 9) ** 2
    even = np.linspace(0, 16, 10)
    segments, _ = lane_graph(annotation([uneven], [uneven + np.array([0, 2, 0])]), 1, 10)
    for lines, y in ((segments.points, 0), (segments.left, 2), (segments.right, 2)):
        np.testing.assert_allclose(lines[0, :, :2], np.stack([even, np.full(10, y)], -1), atol=1e-5)
    np.testing.assert_allclose(area_set(annotation([uneven]), 1, 10).points[0, :, 0], even, atol=1e-5)
    lanes, _ = lane_graph(annotation([uneven]), 1, 10)
    np.testing.assert_array_equal(lanes.points[0], uneven.astype(np.float32))


def test_distances_are_to_lines_and_not_to_their_vertices():
    """A straight line past the vehicle has only far ends; a line 20 m aside has a vertex every 5 m."""
    beside = np.array([[x, 20.0, 0.0] for x in range(-50, 51, 5)])
    lines = [beside, np.array([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]])]
    found = annotation(lines)
    with pytest.warns(TruncationWarning, match="more (lanes|areas)"):
        (graph, kept), areas = lane_graph(found, 1, 11), area_set(found, 1, 20)
    assert kept.tolist() == [1]
    np.testing.assert_array_equal(graph.points[0, :, 1], 0.0)
    np.testing.assert_array_equal(areas.points[0, :, 1], 0.0)


def test_of_too_many_elements_the_largest_in_the_image_stay_with_their_lanes():
    """In the order of the file; of the lanes, those that the example has. A box without height is none."""
    sizes = np.array([(2.0, 3.0), (5.0, 4.0), (90.0, 0.0), (4.0, 4.0)])
    found = replace(
        annotation([np.zeros((2, 3))] * 3),
        boxes=np.stack([np.full((4, 2), 10.0), 10.0 + sizes], 1),
        element_category=np.array([1, 2, 1, 1]),
        attribute=np.arange(4),
        lane_element=np.arange(12).reshape(3, 4) % 5 == 0,  # lane 0: element 0; lane 1: element 1; lane 2: element 2
    )
    with pytest.warns(TruncationWarning, match="more elements"):
        out = element_set(found, TrafficElements.empty(2, 2), np.array([1, 2]), None)
    assert out.attribute.tolist() == [1, 3]
    assert out.category.tolist() == [2, 1]
    assert out.lane.tolist() == [[True, False], [False, False]]
    whole = element_set(found, TrafficElements.empty(4, 2), np.array([1, 2]), None)
    assert whole.attribute[whole.valid].tolist() == [0, 1, 3]
