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
from tflane_jax.scene import Areas, AreaType, LaneGraph, LineType


def example():
    """A straight lane of 40 m, a quarter circle of 20 m radius that follows it, and padding full of NaN."""
    lanes = LaneGraph.empty(4, 21)
    lanes.points[0, :, 0] = np.linspace(0.0, 40.0, 21)
    angle = np.linspace(0.0, np.pi / 2, 21)
    lanes.points[1, :, :2] = np.stack([40.0 + 20.0 * np.sin(angle), 20.0 - 20.0 * np.cos(angle)], -1)
    lanes.left[0], lanes.right[0] = lanes.points[0] + [0.0, 1.5, 0.0], lanes.points[0] - [0.0, 2.0, 0.0]
    lanes.left_type[0], lanes.left_type[1] = LineType.DASHED, LineType.SOLID
    lanes.points[2:], lanes.left[2:] = np.nan, np.nan
    lanes.visibility[:] = [0.75, 0.25, np.nan, np.nan]
    lanes.is_connector[:] = [False, True, True, True]
    lanes.successor[0, 1:] = True
    lanes.valid[:2] = True
    areas = Areas.empty(4, 3)
    areas.category[:] = [AreaType.PEDESTRIAN_CROSSING, AreaType.ROAD_BOUNDARY, AreaType.ROAD_BOUNDARY, 1]
    areas.valid[:3] = True
    areas.points[0, :, :2], areas.points[3] = [[0.0, -2.0], [20.0, -2.0], [40.0, -2.0]], np.nan
    # Road boundaries, the first one less than a metre beside the unpainted right side of the first lane.
    areas.points[1, :, :2] = [[-10.0, -2.9], [20.0, -2.9], [50.0, -2.9]]
    areas.points[2, :, :2] = [[-10.0, 9.0], [20.0, 9.0], [50.0, 9.0]]
    return FakeDataset(FakeConfig(1)).example(0).replace(lanes=lanes, areas=areas)


def test_lanes_are_measured_and_padding_is_not():
    found = lane_quantities(example())
    assert tuple(found) == LANE_QUANTITIES
    np.testing.assert_allclose(found["length, m"], [40.0, 20.0 * np.pi / 2], rtol=1e-3)
    # A connector has no width that counts.
    np.testing.assert_allclose(found["width, m"], [3.5], rtol=1e-6)
    np.testing.assert_allclose(found["painted sides"], [0.5])
    np.testing.assert_array_equal(found["unpainted sides at the road's edge"], [1.0])
    # The first and the last chord of the arc point half a step off its ends.
    np.testing.assert_allclose(found["turn, degrees"], [0.0, 90.0 * 19 / 20], rtol=1e-3)
    np.testing.assert_allclose(found["curvature, 1/100 m"], [0.0, 5.0], rtol=1e-2)
    np.testing.assert_array_equal(found["visible fraction"], [0.75, 0.25])


@pytest.mark.parametrize(
    ("beside", "expected"), [(-2.9, [1.0]), (-1.1, [1.0]), (-3.1, [0.0]), (1.5, [0.0]), (None, [])]
)
def test_unpainted_sides_at_the_edge_of_the_road(beside, expected):
    """The right side of the first lane, at y = -2, has no paint; the painted left side does not count."""
    frame = example()
    if beside is None:
        frame.areas.category[:] = AreaType.PEDESTRIAN_CROSSING
    else:
        frame.areas.points[1, :, 1] = beside
    found = lane_quantities(frame)
    np.testing.assert_array_equal(found["unpainted sides at the road's edge"], expected)


def test_a_lane_that_a_corner_of_the_box_cuts_to_millimetres_has_no_curvature():
    frame = example()
    frame.lanes.points[1, :, :2] = [40.0, 0.0] + 1e-4 * frame.lanes.points[1, :, :2]
    assert len(lane_quantities(frame)["curvature, 1/100 m"]) == 1


def test_frames_are_counted():
    found = {name: values.item() for name, values in frame_quantities(example()).items()}
    assert tuple(found) == FRAME_QUANTITIES
    assert found.pop("metres of lane") == pytest.approx(40.0 + 10.0 * np.pi, rel=1e-3)
    # Of the 20 chords of the arc, 4.5 degrees apart, 14 lie at 15 to 75 degrees.
    oblique = found.pop("oblique fraction of lane length")
    assert oblique == pytest.approx(10.0 * np.pi * 14 / 20 / (40.0 + 10.0 * np.pi), rel=1e-2)
    counts = {"lanes": 2, "connectors": 1, "topology links": 1, "crossings": 1, "road boundaries": 2}
    assert found == counts | {
        "lanes beside the vehicle": 1,
        "oncoming lanes beside the vehicle": 0,
        "vehicle on a connector": 0,
    }


@pytest.mark.parametrize(
    ("moved", "turned", "beside", "oncoming", "on_connector"),
    [
        ((-50.0, 0.0), 0.0, 1, 0, 1),
        ((-20.0, 4.0), 0.0, 1, 0, 0),
        ((-20.0, 4.0), np.pi, 0, 1, 0),
        ((-20.0, 4.0), np.pi / 2, 0, 0, 0),
        ((20.0, 0.0), 0.0, 0, 0, 0),
    ],
)
def test_lanes_around_the_vehicle(moved, turned, beside, oncoming, on_connector):
    """The lanes are moved, then turned about the vehicle."""
    frame = example()
    cos, sin = np.cos(turned), np.sin(turned)
    xy = frame.lanes.points[..., :2] + moved
    frame.lanes.points[..., :2] = xy @ np.array([[cos, sin], [-sin, cos]])
    found = frame_quantities(frame)
    assert found["lanes beside the vehicle"].item() == beside
    assert found["oncoming lanes beside the vehicle"].item() == oncoming
    assert found["vehicle on a connector"].item() == on_connector


def test_a_frame_without_lanes_has_no_values_of_lanes():
    empty = example()
    empty.lanes.valid[:] = False
    assert all(len(values) == 0 for values in lane_quantities(empty).values())
    assert all(frame_quantities(empty)[name].item() == 0.0 for name in ("metres of lane", "vehicle on a connector"))


def test_pooling_keeps_every_value_and_the_order_of_quantities():
    found = pooled([{"a": np.array([1.0])}, {"b": np.array([2.0, 3.0]), "a": np.array([4.0])}])
    assert list(found) == ["a", "b"]
    np.testing.assert_array_equal(found["a"], [1, 4])
    np.testing.assert_array_equal(found["b"], [2, 3])
    assert pooled([]) == {}
