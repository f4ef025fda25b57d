"""Annotations of OpenLane-V2 at the capacities of an example."""

import numpy as np
import pytest

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.openlane_annotation import Annotation
from tflane_jax.datasets.openlane_example import area_set, lane_graph


def test_distances_are_to_lines_and_not_to_their_vertices():
    """A straight line past the vehicle has only far ends; a line 20 m aside has a vertex every 5 m."""
    beside = np.array([[x, 20.0, 0.0] for x in range(-50, 51, 5)])
    lines = [beside, np.array([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]])]
    none = np.zeros(2, int)
    found = Annotation(
        lines=lines,
        left=None,
        right=None,
        left_type=none,
        right_type=none,
        is_connector=np.zeros(2, bool),
        successor=np.zeros((2, 2), bool),
        boxes=np.zeros((0, 2, 2)),
        element_category=none[:0],
        attribute=none[:0],
        lane_element=np.zeros((2, 0), bool),
        areas=lines,
        area_category=none + 2,
    )
    with pytest.warns(TruncationWarning, match="more (lanes|areas)"):
        (graph, kept), areas = lane_graph(found, 1, 11), area_set(found, 1, 20)
    assert kept.tolist() == [1]
    np.testing.assert_array_equal(graph.points[0, :, 1], 0.0)
    np.testing.assert_array_equal(areas.points[0, :, 1], 0.0)
