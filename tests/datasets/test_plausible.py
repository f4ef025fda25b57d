"""Drives that cannot be true."""

import numpy as np
import pytest

from tflane_jax.datasets.plausible import (
    FAR,
    check_distance,
    check_headings,
    check_interval,
    check_motion,
    check_place,
    check_steps,
)
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, transform_points, wrap_angle, yaw_pose
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import Tracks

TIMES = np.arange(3) * 500_000_000


def test_speed():
    check_motion(np.array([[0.0, 0.0], [34.0, 0.0], [68.0, 0.0]]), TIMES, "abc")  # 245 km/h
    check_motion(np.zeros((1, 2)), TIMES[:1], "a")
    with pytest.raises(UserError, match=r"c: the vehicle is 40 m from its place 0\.5 s before"):
        check_motion(np.array([[0.0, 0.0], [0.0, 0.0], [40.0, 0.0]]), TIMES, "abc")


def test_interval():
    check_interval(TIMES, "nanoseconds", "a")
    check_interval(TIMES[:1], "nanoseconds", "a")
    for factor, text in ((1000, "5e+02"), (1e-3, "0.0005")):
        with pytest.raises(UserError) as error:
            check_interval((TIMES * factor).astype(np.int64), "nanoseconds", "a")
        assert str(error.value) == f"a: its frames are {text} s apart: are its times in nanoseconds?"


def test_place():
    path = np.array([[0.0, 0.0], [9.0, 0.0]])
    lane = np.array([[0.0, FAR - 1.0, 0.0], [0.0, 2 * FAR, 0.0]])
    check_place([lane + 1e6, lane], path, "x")
    for lanes in ([], [lane + np.array([0.0, 2.0, 0.0])]):
        with pytest.raises(UserError, match="x: the vehicle never comes within 200 m of a lane"):
            check_place(lanes, path, "x")


def test_distance():
    check_distance(np.array([[499.0, 0.0, 0.0]]), "a")
    check_distance(np.zeros((0, 3)), "")
    with pytest.raises(UserError, match="b: the box is 600 m from the vehicle"):
        check_distance(np.array([[1.0, 0.0, 0.0], [0.0, -600.0, 0.0]]), "ab")


def test_steps():
    check_steps(np.array([[0.0, 0.0, 9e9], [9999.0, 0.0, 0.0], [9999.0, 5.0, 0.0]]), "a")
    check_steps(np.zeros((1, 2)), "a")
    for far, text in ((3e7, "30000"), (1e300, "inf")):
        with pytest.raises(UserError, match=f"a: points 1 and 2 are {text} km apart"):
            check_steps(np.array([[0.0, 0.0], [1.0, 0.0], [far, 0.0]]), "a")


def drive(headings, speed=5.0, category=RoadUser.CAR, frames=4):
    """Return tracks of vehicles that move in the directions `headings`, seen from one that turns, and its poses."""
    time, along = np.arange(frames) / 2, np.stack([np.cos(headings), np.sin(headings)], -1)
    poses = yaw_pose(3.0 * time, -time, time)
    tracks = Tracks.empty(frames, [str(k) for k in range(len(headings))])
    center = np.concatenate([speed * time[:, None, None] * along, np.ones((frames, len(headings), 1))], -1)
    tracks.position[:] = transform_points(invert_pose(poses), center)
    tracks.yaw[:] = wrap_angle(headings - time[:, None])
    tracks.category[:], tracks.valid[:] = category, True
    return tracks, poses, (time * 1e9).astype(np.int64)


@pytest.mark.parametrize("turned", [np.pi / 2, np.pi, -1.0])
def test_headings(turned):
    headings = np.array([0.3, 2.0, 3.1, -3.0])
    tracks, poses, times = drive(headings)
    check_headings(tracks, poses, times, "a")
    tracks.yaw[:, :2] += turned  # half of them, which may reverse
    check_headings(tracks, poses, times, "a")
    tracks.yaw[:, 2] += turned
    with pytest.raises(UserError, match="a: 3 of 4 moving vehicles do not head where they move"):
        check_headings(tracks, poses, times, "a")
    tracks.position[1:3, :2], tracks.yaw[1:3, :2], tracks.valid[1:3, :2] = np.nan, np.nan, False
    check_headings(tracks, poses, times, "a")  # two vehicles are too few


@pytest.mark.parametrize(("speed", "category"), [(2.0, RoadUser.CAR), (5.0, RoadUser.PEDESTRIAN)])
def test_headings_of_the_slow_and_of_walkers_may_be_any(speed, category):
    tracks, poses, times = drive(np.zeros(5), speed, category)
    tracks.yaw[:] += 2.0
    check_headings(tracks, poses, times, "a")


@pytest.mark.parametrize(("vehicles", "frames"), [(0, 4), (3, 1), (0, 0)])
def test_headings_of_nothing(vehicles, frames):
    tracks, poses, times = drive(np.zeros(vehicles), frames=frames)
    check_headings(tracks, poses, times, "a")
