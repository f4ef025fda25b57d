"""Identities of detected lines."""

import numpy as np

from tflane_jax.evaluation.line_tracks import MEMORY, LineTracks
from tflane_jax.geometry import yaw_pose

STILL = np.eye(4)


def along(y, start=-20.0, stop=20.0):
    return np.stack([np.linspace(start, stop, 21), np.full(21, y)], -1)


def steps(*frames, pose=STILL, classes=None):
    tracks = LineTracks()
    found = [np.array(frame, float).reshape(-1, 21, 2) for frame in frames]
    return [
        tracks.step(lines, np.zeros(len(lines), int) if classes is None else classes, pose).tolist() for lines in found
    ]


def test_lines_keep_their_identity_in_any_order():
    assert steps([along(0), along(4)], [along(4.2), along(0.3)], [along(8), along(0), along(4)]) == [
        [0, 1],
        [1, 0],
        [2, 0, 1],
    ]


def test_the_ego_motion_is_taken_out():
    # The vehicle changes to the next lane and turns by 0.1: lines 4 m apart move by one place.
    pose = yaw_pose(np.float64(5.0), np.float64(4.0), np.float64(0.1))
    turn = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    first = [along(y) for y in (0, 4, 8)]
    second = [(line - [5.0, 4.0]) @ turn for line in first[1:]]
    assert steps(first, second, pose=pose)[1] == [1, 2]
    assert steps(first, second)[1] == [0, 1]


def test_a_line_cut_elsewhere_is_the_same_and_one_beside_it_is_not():
    assert steps([along(0)], [along(0, 10.0, 20.0)], [along(0, -20.0, 40.0)]) == [[0], [0], [0]]
    assert steps([along(0)], [along(1.6)]) == [[0], [1]]
    assert steps([along(0)], [along(0)[:, ::-1]]) == [[0], [1]]  # crosses it


def test_lines_of_other_classes_are_others():
    tracks = LineTracks()
    line = along(0)[None]
    assert [tracks.step(line, np.array([kind]), STILL).tolist() for kind in (0, 1, 0)] == [[0], [1], [0]]


def test_a_missing_line_is_remembered_for_some_frames():
    gone = [[]] * MEMORY
    assert steps([along(0)], *gone, [along(0)])[-1] == [0]
    assert steps([along(0)], *gone, [], [along(0)])[-1] == [1]


def test_a_new_scene_has_new_identities():
    tracks = LineTracks()
    first = tracks.step(along(0)[None], np.zeros(1, int), STILL)
    tracks.start()
    assert tracks.step(along(0)[None], np.zeros(1, int), STILL) != first
