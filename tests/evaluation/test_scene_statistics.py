"""Quantities of a frame against lanes drawn by hand."""

import numpy as np
import pytest

from tests.fakes import FakeConfig, FakeDataset
from tflane_jax.evaluation.scene_statistics import (
    FRAME_QUANTITIES,
    LANE_QUANTITIES,
    frame_quantities,
    lane_quantities,
    pooled,
)
from tflane_jax.scene import Areas, AreaType, LaneGraph


def example():
    """A straight lane of 40 m, a quarter circle of 20 m radius that follows it, and padding full of NaN."""
    lanes = LaneGraph.empty(4, 21)
    lanes.points[0, :, 0] = np.linspace(0.0, 40.0, 21)
    angle = np.linspace(0.0, np.pi / 2, 21)
    lanes.points[1, :, :2] = np.stack([40.0 + 20.0 * np.sin(angle), 20.0 - 20.0 * np.cos(angle)], -1)
    lanes.points[2:] = np.nan
    lanes.visibility[:] = [0.75, 0.25, np.nan, np.nan]
    lanes.is_connector[:] = [False, True, True, True]
    lanes.successor[0, 1:] = True
    lanes.valid[:2] = True
    areas = Areas.empty(4, 3)
    areas.category[:] = [AreaType.PEDESTRIAN_CROSSING, AreaType.ROAD_BOUNDARY, AreaType.ROAD_BOUNDARY, 1]
    areas.valid[:3] = True
    return FakeDataset(FakeConfig(1)).example(0).replace(lanes=lanes, areas=areas)


def test_lanes_are_measured_and_padding_is_not():
    found = lane_quantities(example())
    assert tuple(found) == LANE_QUANTITIES
    np.testing.assert_allclose(found["length, m"], [40.0, 20.0 * np.pi / 2], rtol=1e-3)
    # The first and the last chord of the arc point half a step off its ends.
    np.testing.assert_allclose(found["turn, degrees"], [0.0, 90.0 * 19 / 20], rtol=1e-3)
    np.testing.assert_allclose(found["curvature, 1/100 m"], [0.0, 5.0], rtol=1e-2)
    np.testing.assert_array_equal(found["visible share"], [0.75, 0.25])


def test_frames_are_counted():
    found = {name: values.item() for name, values in frame_quantities(example()).items()}
    assert tuple(found) == FRAME_QUANTITIES
    assert found.pop("metres of lane") == pytest.approx(40.0 + 10.0 * np.pi, rel=1e-3)
    assert found == {"lanes": 2, "connectors": 1, "topology links": 1, "crossings": 1, "road boundaries": 2}


def test_a_frame_without_lanes_has_no_values_of_lanes():
    empty = example()
    empty.lanes.valid[:] = False
    assert all(len(values) == 0 for values in lane_quantities(empty).values())
    assert frame_quantities(empty)["metres of lane"].item() == 0.0


def test_pooling_keeps_every_value_and_the_order_of_quantities():
    found = pooled([{"a": np.array([1.0])}, {"b": np.array([2.0, 3.0]), "a": np.array([4.0])}])
    assert list(found) == ["a", "b"]
    np.testing.assert_array_equal(found["a"], [1, 4])
    np.testing.assert_array_equal(found["b"], [2, 3])
    assert pooled([]) == {}
