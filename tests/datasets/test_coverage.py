"""What evidence and traffic show of lanes that can be drawn on paper."""

import numpy as np
import pytest

from tflane_jax.datasets.coverage import covered_by_evidence, covered_by_traffic, observed_frames
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.scene import BevChannel, LaneGraph, RoadUser, TrafficFlow

BOX = PerceptionRange((-20.0, 20.0), (-10.0, 10.0))
# Cells of 1 m.
GRID = BevGrid(PerceptionRange((-20.0, 20.0), (-10.0, 10.0)), rows=20, columns=40)


def straight_lanes(*ys, capacity=4):
    """Return lanes along x from -10 to 10 m with a point every 5 m, 3 m wide."""
    lanes = LaneGraph.empty(capacity, 5)
    lanes.points[:], lanes.left[:], lanes.right[:] = np.nan, np.nan, np.nan
    for i, y in enumerate(ys):
        for line, offset in ((lanes.points, 0.0), (lanes.left, 1.5), (lanes.right, -1.5)):
            line[i] = np.stack([np.linspace(-10.0, 10.0, 5), np.full(5, y + offset), np.zeros(5)], -1)
        lanes.valid[i] = True
    return lanes


def one_box(x, y, yaw=0.0, *, category=RoadUser.CAR, occluded=False):
    flow = TrafficFlow.empty(2, 3)
    flow.position[:], flow.yaw[:] = np.nan, np.nan
    flow.position[0, 1], flow.yaw[0, 1] = (x, y, 0.0), yaw
    flow.category[0], flow.valid[0, 1], flow.occluded[0, 1] = category, True, occluded
    return flow


@pytest.mark.parametrize(
    ("box", "covered"),
    [
        (one_box(0.0, 0.0), [2]),
        (one_box(1.0, 1.0), [2]),
        (one_box(1.2, 1.2), []),
        (one_box(5.0, 0.0, 0.5), [3]),
        (one_box(5.0, 0.0, 2 * np.pi + 0.5), [3]),
        (one_box(5.0, 0.0, 0.55), []),
        (one_box(0.0, 0.0, np.pi), []),
        (one_box(0.0, 0.0, category=RoadUser.BICYCLE), [2]),
        (one_box(0.0, 0.0, category=RoadUser.PEDESTRIAN), []),
        (one_box(0.0, 0.0, occluded=True), []),
    ],
)
def test_traffic_covers_the_points_that_it_drives_over_in_their_direction(box, covered):
    found = covered_by_traffic(straight_lanes(0.0, 5.0), box, BOX)
    assert found.shape == (4, 5)
    assert np.flatnonzero(found[0]).tolist() == covered
    assert not found[1:].any()


def test_traffic_outside_the_range_or_without_lanes_covers_nothing():
    lanes = straight_lanes(9.5)
    assert covered_by_traffic(lanes, one_box(0.0, 9.5), BOX).any()
    assert not covered_by_traffic(lanes, one_box(0.0, 10.5), BOX).any()
    assert not covered_by_traffic(straight_lanes(), one_box(0.0, 0.0), BOX).any()
    assert not observed_frames(one_box(0.0, 10.5), BOX).any()


@pytest.mark.parametrize("channel", [BevChannel.LANE_PAINT, BevChannel.ROAD_EDGE, BevChannel.CROSSING])
def test_evidence_is_looked_for_at_the_boundaries(channel):
    bev = np.zeros((20, 40, len(BevChannel)), np.uint8)
    # The lane's left boundary is at y = 1.5, row 11; its point at x = 5 is on the border of columns 24 and 25.
    bev[11, 25, channel] = 64
    found = covered_by_evidence(straight_lanes(0.0), bev, GRID)
    expected = [] if channel is BevChannel.CROSSING else [3]
    assert np.flatnonzero(found[0]).tolist() == expected
    bev[11, 25, channel] = 63
    assert not covered_by_evidence(straight_lanes(0.0), bev, GRID).any()


def test_evidence_outside_the_raster_is_none():
    bev = np.full((20, 40, len(BevChannel)), 255, np.uint8)
    found = covered_by_evidence(straight_lanes(0.0, 30.0), bev, GRID)
    assert found.all(-1).tolist() == [True, False, False, False]
