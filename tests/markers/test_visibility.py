"""Boards in the image and behind bodies."""

from dataclasses import replace

import numpy as np
import pytest

from tests.markers.test_simulation import markers_at, standing
from tflane_jax.geometry import invert_pose, yaw_pose
from tflane_jax.markers.visibility import fraction_in_sight, hidden_from, in_image, seen_fraction
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING, CameraRigConfig, draw_rig
from tflane_jax.world.roads.markers import marker_pose

FRONT = ARGOVERSE2_RING[:1]


@pytest.mark.parametrize(
    ("mounts", "distance", "expected"),
    [
        (ARGOVERSE2_RING[:1], 10.0, True),
        (ARGOVERSE2_RING[:1], 4.0, False),  # above the image
        (NUSCENES_RING[:1], 10.0, True),
        (NUSCENES_RING[:1], 6.5, False),
        (ARGOVERSE2_RING[3:5], 10.0, False),  # the rear cameras
    ],
)
def test_a_board_must_lie_in_an_image_as_a_whole(mounts, distance, expected):
    camera = draw_rig(3, CameraRigConfig(cameras=mounts, scale=1.0))[0]
    assert in_image(markers_at(distance).pose, 1.0, camera).tolist() == [expected]
    scene = standing()
    seen = seen_fraction(scene, scene.keyframes[0], markers_at(distance).pose, 1.0, mounts, None)
    assert seen.tolist() == [float(expected)]


@pytest.mark.parametrize(("depth", "expected"), [(0.95, False), (1.05, True)])
def test_a_board_of_half_a_metre_is_too_near_within_a_metre(depth, expected):
    camera = draw_rig(3, CameraRigConfig(cameras=FRONT, scale=1.0))[0]
    pose = marker_pose(np.array([[FRONT[0].x + depth, 0.0, FRONT[0].z]]), np.array([np.pi]))
    assert in_image(pose, 0.5, camera).tolist() == [expected]


def test_of_several_cameras_the_one_that_sees_most_counts():
    """A mast hides the board from the first camera, and not from one 3 m beside it."""
    scene, board = standing(), markers_at(20.0).pose
    mast = np.array([[10.0, 0.0, 2.0, 2.0, 0.0, 0.0, 8.0]])
    pair = (*FRONT, replace(FRONT[0], name="beside", y=3.0))
    for mounts, expected in ((FRONT, 0.0), (pair, 1.0), (pair[::-1], 1.0)):
        assert seen_fraction(scene, scene.keyframes[0], board, 1.0, mounts, mast).tolist() == [expected]


def test_bodies_hide_the_part_behind_them():
    """A wall that ends at the middle of a board, a mast before it, and a house behind it."""
    eye, points = np.array([0.0, 0.0, 1.4]), np.array([[20.0, y, 3.0] for y in (-0.4, -0.1, 0.1, 0.4)])
    wall = np.array([[10.0, 5.0, 0.2, 10.0, 0.0, 0.0, 9.0]])
    assert hidden_from(eye, points, wall).tolist() == [False, False, True, True]
    mast = np.array([[19.0, -0.1, 0.1, 0.1, 0.0, 0.0, 7.0]])
    assert hidden_from(eye, points, mast).tolist() == [False, True, False, False]
    low, behind = wall * [1, 1, 1, 1, 1, 1, 0.1], wall + np.array([15, 0, 0, 0, 0, 0, 0])
    assert not hidden_from(eye, points, np.concatenate([low, behind])).any()


@pytest.mark.parametrize(("width", "low", "high"), [(0.14, 0.7, 0.95), (2.0, 0.0, 0.0)])
def test_a_mast_hides_a_stripe_of_a_board(width, low, high):
    scene = standing()
    place = np.array([[18.0, 0.0, width, width, 0.0, 0.0, 8.0]])
    seen = seen_fraction(scene, scene.keyframes[0], markers_at(20.0).pose, 1.0, FRONT, place)
    assert low <= seen[0] <= high


def test_road_users_hide_boards_too():
    scene = standing(boxes=[(10.0, 0.0, 2.0)])
    scene.actors.size[:] = (8.0, 2.5, 4.0)
    none = np.zeros((0, 7))
    pose = marker_pose(np.array([[20.0, 0.0, 3.0], [20.0, -6.0, 3.0]]), np.full(2, np.pi))
    seen = seen_fraction(scene, scene.keyframes[0], pose, 1.0, FRONT, none)
    assert seen[0] < 0.2
    assert seen[1] == 1.0
    np.testing.assert_array_equal(seen_fraction(scene, scene.keyframes[0], pose, 1.0, FRONT, None), 1.0)


def test_road_users_keep_their_heading_on_the_ground():
    """The vehicle has turned to the left since their frame: it looks along a long lorry, and past it."""
    scene = standing(boxes=[(10.0, 0.0, 2.0)])
    scene.actors.size[:] = (8.0, 0.5, 4.0)
    turned = yaw_pose(*np.array([[0.0], [0.0], [np.pi / 2]]))[0]
    moment = replace(scene.keyframes[0], global_from_ego=turned)
    board = invert_pose(turned) @ marker_pose(np.array([[20.0, 0.0, 3.0]]), np.array([np.pi]))
    seen = fraction_in_sight(scene, moment, board, 1.0, FRONT, np.zeros((0, 7)))
    assert seen[0] > 0.8


def test_no_boards():
    scene = standing()
    nothing = seen_fraction(scene, scene.keyframes[0], np.zeros((0, 4, 4)), 1.0, FRONT, np.zeros((0, 7)))
    assert nothing.shape == (0,)
