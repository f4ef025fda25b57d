"""Boards in the image and behind bodies."""

import numpy as np
import pytest

from tests.markers.test_simulation import markers_at, standing
from tflane_jax.markers.visibility import hidden_from, in_image, seen_fraction
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


def test_no_boards():
    scene = standing()
    nothing = seen_fraction(scene, scene.keyframes[0], np.zeros((0, 4, 4)), 1.0, FRONT, np.zeros((0, 7)))
    assert nothing.shape == (0,)
