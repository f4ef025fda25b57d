"""Groups of lanes by evidence and traffic: against plain loops, and by hand."""

import numpy as np
import pytest

from tests.priors.test_traffic_flow import make_flow
from tflane_jax.evaluation.lane_groups import (
    BESIDE,
    EVIDENCE,
    HEADING,
    LANE_GROUPS,
    SAMPLES,
    driven_fraction,
    lane_groups,
    line_groups,
    shown_fraction,
)
from tflane_jax.geometry import PerceptionRange, resample
from tflane_jax.scene import BevChannel, LaneGraph, LineClass, MapLines, RoadUser, TrafficFlow

GROUND = PerceptionRange((-20.0, 20.0), (-10.0, 10.0))
CELL = 0.5


def raster():
    return np.zeros((40, 80, len(BevChannel)), np.uint8)


def wiggling_lines(seed, count=6, points=7):
    rng = np.random.default_rng(seed)
    start, step = rng.uniform([-18, -9, 0], [10, 9, 1], (count, 3)), rng.uniform(-0.5, 3.5, (count, points, 3))
    return (start[:, None] + np.cumsum(step, 1) * rng.choice([-1, 1], (count, 1, 3))).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_shown_fraction_against_loops(seed):
    rng = np.random.default_rng(seed)
    bev = (rng.random((40, 80, 4)) ** 40 * 255).astype(np.uint8)
    left, right = wiggling_lines(seed), wiggling_lines(seed + 100)
    expected = []
    for sides in zip(left, right, strict=True):
        seen = np.zeros(SAMPLES, bool)
        for line in sides:
            for i, (x, y, _) in enumerate(resample(line, SAMPLES)):
                if abs(x) > 20 or abs(y) > 10:
                    continue
                column, row = min(int((x + 20) / CELL), 79), min(int((y + 10) / CELL), 39)
                for r in range(max(row - 2, 0), min(row + 3, 40)):
                    for c in range(max(column - 2, 0), min(column + 3, 80)):
                        channels = bev[r, c, BevChannel.LANE_PAINT], bev[r, c, BevChannel.ROAD_EDGE]
                        seen[i] |= max(channels) >= EVIDENCE
        expected.append(seen.mean())
    assert 0.0 < np.mean(expected) < 1.0
    np.testing.assert_allclose(shown_fraction(left, right, bev, GROUND), expected)


@pytest.mark.parametrize("seed", range(4))
def test_driven_fraction_against_loops(seed):
    flow, lines = make_flow(seed, instances=4), wiggling_lines(seed, count=3)
    # A vehicle that drives along the first lane, so that something is covered.
    flow.position[0, :, :2] = resample(lines[0], 20)[:, :2]
    flow.yaw[0] = np.arctan2(*np.gradient(flow.position[0, :, :2], axis=0).T[::-1])
    flow.category[0], flow.valid[0] = RoadUser.TRUCK, True
    driven, nearest = np.zeros((len(lines), SAMPLES), bool), np.full(len(lines), np.inf)
    seen = flow.valid & ~flow.occluded & (flow.category != RoadUser.PEDESTRIAN)[:, None]
    fraction = np.linspace(0.0, 1.0, 1001)
    for lane, line in enumerate(lines):
        points = resample(line, SAMPLES)[:, :2]
        forward = np.gradient(points, axis=0)
        for k, n in zip(*np.nonzero(seen), strict=True):
            m = n + 1 if n + 1 < 20 and seen[k, n + 1] else n
            a, b = flow.position[k, n, :2], flow.position[k, m, :2]
            turn = np.angle(np.exp(1j * (flow.yaw[k, m] - flow.yaw[k, n])))
            for i, point in enumerate(points):
                distance = np.linalg.norm(a + fraction[:, None] * (b - a) - point, axis=-1)
                nearest[lane] = min(nearest[lane], distance.min())
                yaw = flow.yaw[k, n] + fraction[distance.argmin()] * turn
                off = np.angle(np.exp(1j * (yaw - np.arctan2(forward[i, 1], forward[i, 0]))))
                driven[lane, i] |= distance.min() <= BESIDE and abs(off) <= HEADING
    assert driven[0].any()
    assert not driven.all()
    found, distance = driven_fraction(lines, flow)
    np.testing.assert_allclose(found, driven.mean(-1))
    np.testing.assert_allclose(distance, nearest, atol=5e-3)


def straight_lanes(*sides):
    """Return lanes along x at the given y, 3.5 m wide, in the odd rows of a graph whose padding holds NaN."""
    lanes = LaneGraph.empty(2 * len(sides), 5)
    for line in (lanes.points, lanes.left, lanes.right):
        line[:] = np.nan
    for i, y in enumerate(sides):
        for line, offset in ((lanes.points, 0.0), (lanes.left, 1.75), (lanes.right, -1.75)):
            line[2 * i + 1] = [[x, y + offset, 0.0] for x in np.linspace(-10.0, 10.0, 5)]
        lanes.valid[2 * i + 1] = True
    return lanes


def driving(x, y, *, yaw=0.0, category=RoadUser.CAR, occluded=False):
    """Return the track of one road user from -x to x, and an instance of NaN."""
    flow = TrafficFlow.empty(2, 3)
    flow.position[:], flow.yaw[:] = np.nan, np.nan
    flow.position[0], flow.yaw[0] = [[-x, y, 0], [0, y, 0], [x, y, 0]], yaw
    flow.category[0], flow.valid[0], flow.occluded[0] = category, True, occluded
    return flow


def painted(*sides):
    bev = raster()
    for y in sides:
        bev[int((y + 10) / CELL), :, BevChannel.LANE_PAINT] = 200
    return bev


def members(lanes, bev, flow):
    groups = lane_groups(lanes, bev, flow, GROUND)
    assert tuple(groups) == LANE_GROUPS
    return [[name for name in LANE_GROUPS if groups[name][i]] for i in range(int(lanes.valid.sum()))]


def test_groups_by_hand():
    lanes = straight_lanes(-7.0, 0.0, 6.0)
    # Paint at the left side of the first lane only; a car along the whole second lane.
    assert members(lanes, painted(-5.25), driving(10.0, 0.2)) == [
        ["visible-traffic"],
        ["hidden+traffic"],
        ["hidden-traffic", "hidden-neighbours"],
    ]
    # The lane beside the driven one has no traffic of its own, but a neighbour that has.
    assert members(straight_lanes(3.5), raster(), driving(10.0, 0.0)) == [["hidden-traffic"]]
    # A lane of which less than half was driven, or with a vehicle at its side, is in no group.
    assert members(straight_lanes(0.0), raster(), driving(3.0, 0.2)) == [[]]
    assert members(straight_lanes(0.0), raster(), driving(10.0, 2.0)) == [[]]
    assert members(straight_lanes(0.0), painted(-1.75), driving(6.0, 0.2)) == [["visible+traffic"]]


@pytest.mark.parametrize(
    ("flow", "group"),
    [
        (driving(10.0, 0.0, yaw=np.radians(29.0)), ["hidden+traffic"]),
        (driving(10.0, 0.0, yaw=np.radians(31.0)), []),
        (driving(10.0, 0.0, yaw=np.pi), []),
        (driving(10.0, 1.6), []),
        (driving(10.0, 0.0, category=RoadUser.PEDESTRIAN), ["hidden-traffic", "hidden-neighbours"]),
        (driving(10.0, 0.0, occluded=True), ["hidden-traffic", "hidden-neighbours"]),
        (TrafficFlow.empty(0, 3), ["hidden-traffic", "hidden-neighbours"]),
    ],
)
def test_what_counts_as_traffic(flow, group):
    assert members(straight_lanes(0.0), raster(), flow) == [group]


@pytest.mark.parametrize(
    ("channel", "value", "group"),
    [
        (BevChannel.LANE_PAINT, EVIDENCE, "visible"),
        (BevChannel.ROAD_EDGE, EVIDENCE, "visible"),
        (BevChannel.LANE_PAINT, EVIDENCE - 1, "hidden"),
        (BevChannel.CROSSING, 255, "hidden"),
        (BevChannel.OBSTACLE, 255, "hidden"),
    ],
)
def test_what_counts_as_evidence(channel, value, group):
    bev = raster()
    bev[:, :, channel] = value
    assert members(straight_lanes(0.0), bev, TrafficFlow.empty(1, 3))[0][0] == f"{group}-traffic"


def test_a_lane_without_boundaries_is_in_no_group():
    """Regression: boundaries that nobody had filled in were looked for at the vehicle."""
    bev, lanes = raster(), straight_lanes(0.0, 6.0)
    bev[:, :, BevChannel.LANE_PAINT] = 200
    assert [len(of_lane) for of_lane in members(lanes, bev, TrafficFlow.empty(1, 3))] == [1, 1]
    lanes.left[3] = lanes.right[3] = 0.0
    assert [len(of_lane) for of_lane in members(lanes, bev, TrafficFlow.empty(1, 3))] == [1, 0]


def test_a_frame_without_lanes_has_empty_groups():
    groups = lane_groups(LaneGraph.empty(3, 5), raster(), driving(10.0, 0.0), GROUND)
    assert {name: len(group) for name, group in groups.items()} == dict.fromkeys(LANE_GROUPS, 0)


def test_the_tolerance_is_in_metres_on_cells_of_any_shape():
    """Cells of 1 m across and 0.5 m along the lane."""
    side = straight_lanes(0.5).points[1:]
    for row, shown in ((10, 1.0), (11, 1.0), (12, 0.0)):
        bev = np.zeros((20, 80, len(BevChannel)), np.uint8)
        bev[row, :, BevChannel.LANE_PAINT] = 255
        np.testing.assert_array_equal(shown_fraction(side, side, bev, GROUND), [shown])


def test_a_vehicle_turns_between_two_frames():
    """From 50 degrees to the right to 50 to the left over 20 m: within 30 degrees on the 12 m in the middle."""
    flow = driving(10.0, 0.0)
    flow.position[0, 1], flow.yaw[0, :2] = flow.position[0, 2], np.radians([-50.0, 50.0])
    flow.valid[0, 2] = False
    along = np.abs(np.linspace(-10.0, 10.0, SAMPLES)) <= 6.0
    np.testing.assert_allclose(driven_fraction(straight_lanes(0.0).points[1:], flow)[0], [along.mean()])


@pytest.mark.parametrize(
    ("y", "expected"),
    [
        (2.7, ["hidden+traffic"]),
        (2.8, []),
        (3.4, []),
        (3.6, ["hidden-traffic"]),
        (6.9, ["hidden-traffic"]),
        (7.1, ["hidden-traffic", "hidden-neighbours"]),
    ],
)
@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_traffic_beside_a_line(y, yaw, expected):
    """A line has the lanes on both its sides, and traffic in either direction."""
    lines = MapLines.empty(2, 5)
    lines.points[:] = np.nan
    lines.points[1], lines.category[1], lines.valid[1] = straight_lanes(0.0).points[1], LineClass.DIVIDER, True
    groups = line_groups(lines, raster(), driving(10.0, y, yaw=yaw), GROUND)
    assert [name for name in LANE_GROUPS if groups[name][0]] == expected


@pytest.mark.parametrize(("kind", "shown"), [(LineClass.DIVIDER, 1.0), (LineClass.CENTERLINE, 2.0)])
def test_a_centerline_is_shown_by_paint_half_a_lane_away(kind, shown):
    """Other lines only by paint within the tolerance."""
    lines = MapLines.empty(1, 5)
    lines.points[0], lines.category[0], lines.valid[0] = straight_lanes(0.0).points[1], kind, True
    for beside in (0.8, 1.8, 2.8):
        bev = raster()
        bev[int((beside + 10.0) / CELL), :, BevChannel.LANE_PAINT] = 255
        groups = line_groups(lines, bev, TrafficFlow.empty(1, 3), GROUND)
        assert groups["visible-traffic"].tolist() == [beside < shown]
