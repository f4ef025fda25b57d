"""Lanes of a segment, joined from the pieces that its frames annotate."""

import numpy as np
import pytest

from tflane_jax.datasets.openlane_lanes import FrameLanes, segment_lanes
from tflane_jax.geometry import invert_pose, transform_points, yaw_pose


def straight(start, end, y=0.0, count=201):
    return np.stack([np.linspace(start, end, count), np.full(count, y), np.zeros(count)], -1)


def seen(x, lanes, yaw=0.0, edges=(), connectors=()):
    """Return a frame at (x, 0) that shows global lines, each as (id, points)."""
    pose = np.asarray(yaw_pose(x, 0.0, yaw))
    successor = np.zeros((len(lanes), len(lanes)), bool)
    for i, j in edges:
        successor[i, j] = True
    lines = [transform_points(invert_pose(pose), line) for _, line in lanes]
    flags = np.array([name in connectors for name, _ in lanes], bool)
    return FrameLanes(pose, [name for name, _ in lanes], lines, flags, successor)


def test_pieces_of_one_lane_are_joined():
    """A lane of 160 m, of which every frame sees 100 m, another part turned by another yaw."""
    frames = [seen(x, [("7", straight(x - 50, x + 50))], yaw=0.1 * x / 60) for x in (0.0, 20.0, 40.0, 60.0)]
    (lane,) = segment_lanes(frames, 3.5).values()
    np.testing.assert_allclose(lane.centerline[[0, -1]], [[-50, 0, 0], [110, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(lane.centerline[:, 1:], 0.0, atol=1e-6)
    assert (np.diff(lane.centerline[:, 0]) > 0).all()
    np.testing.assert_allclose(lane.right[:, 1], -1.75, atol=1e-6)
    np.testing.assert_allclose(lane.left[:, 1], 1.75, atol=1e-6)
    assert not lane.is_intersection


@pytest.mark.parametrize(
    "other",
    [
        straight(60, 90),
        straight(-50, 50, y=3.5),
        straight(50, -50),
        straight(0, 1, y=40.0, count=2),
        np.concatenate([straight(10, 19, y=6.0), straight(20, 40)]),
        np.concatenate([straight(20, 40), straight(41, 50, y=6.0)]),
    ],
    ids=["gap", "beside", "opposite", "far", "merge", "fork"],
)
def test_pieces_that_do_not_overlap_stay_apart(other):
    frames = [seen(0.0, [("7", straight(-50, 50))]), seen(5.0, [("7", other)])]
    lanes = segment_lanes(frames, 3.5)
    assert [len(lane.centerline) > 1 for lane in lanes.values()] == [True, True]
    np.testing.assert_allclose(lanes[1].centerline[[0, -1]], other[[0, -1]], atol=1e-6)


def test_a_piece_that_bridges_a_gap_joins_both():
    pieces = [straight(0, 20), straight(30, 50), straight(15, 35)]
    (lane,) = segment_lanes([seen(0.0, [("7", piece)]) for piece in pieces], 3.5).values()
    np.testing.assert_allclose(lane.centerline[[0, -1], 0], [0, 50])


def test_edges_of_any_frame_join_ends_to_starts():
    """The second frame sees what the first did not; an edge to a lane that begins elsewhere is left out."""
    frames = [
        seen(0.0, [("a", straight(0, 20)), ("far", straight(70, 80))], edges=[(0, 1)]),
        seen(5.0, [("a", straight(0, 20)), ("b", straight(20, 40))], edges=[(0, 1)], connectors=("b",)),
    ]
    lanes = segment_lanes(frames, 3.5)
    assert {number: lane.successors for number, lane in lanes.items()} == {0: (2,), 1: (), 2: ()}
    assert [lane.is_intersection for lane in lanes.values()] == [False, False, True]


def test_nothing_gives_nothing():
    assert segment_lanes([], 3.5) == {}
    assert segment_lanes([seen(0.0, []), seen(1.0, [("a", straight(0, 1, count=1))])], 3.5) == {}
