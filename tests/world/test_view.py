"""Frames that do not point where the vehicle drives: the same world, seen from a turned frame."""

from dataclasses import replace

import numpy as np
import pytest

from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example
from tflane_jax.geometry import pose_yaw, transform_points, yaw_pose
from tflane_jax.world.simulate import WorldConfig, simulate
from tflane_jax.world.view import turned_view

SCENE, TURN = 4, 0.4
WORLD = WorldConfig(duration_s=4.0, keyframes=2)


@pytest.fixture(scope="module")
def scene():
    return simulate(SCENE, WORLD)


@pytest.mark.parametrize("name", ["tracks", "actors"])
def test_everything_stays_where_it_is(scene, name):
    there = turned_view(scene, TURN)
    assert there.map is scene.map
    at, now = (transform_points(log.global_from_ego, getattr(log, name).position) for log in (scene, there))
    valid = getattr(scene, name).valid
    np.testing.assert_allclose(now[valid], at[valid], atol=1e-9)
    yaw = [getattr(log, name).yaw + pose_yaw(log.global_from_ego)[:, None] for log in (scene, there)]
    np.testing.assert_allclose(np.sin(yaw[0] - yaw[1])[valid], 0.0, atol=1e-9)
    np.testing.assert_allclose(there.keyframes[1].global_from_ego, there.global_from_ego[-1], atol=1e-12)


def test_examples_are_turned(scene):
    here, there = (make_example(log, 1, ExampleConfig(lanes=64)) for log in (scene, turned_view(scene, TURN)))
    frame = yaw_pose(np.asarray(0.0), np.asarray(0.0), np.asarray(TURN))
    flow = here.traffic_flow.valid & there.traffic_flow.valid
    assert flow.any()
    for k, f in zip(*np.nonzero(flow), strict=True):
        # Slots of road users are the same in both: they are in the order of the tracks.
        back = transform_points(frame, np.asarray(there.traffic_flow.position[k, f], float)[None])[0]
        np.testing.assert_allclose(back, here.traffic_flow.position[k, f], atol=1e-3)
    # Lanes end elsewhere, at the border of a box that is turned, too.
    near = here.lanes.points[here.lanes.valid]
    near = near[np.linalg.norm(near, axis=-1) < 20.0]
    found = transform_points(frame, np.asarray(there.lanes.points[there.lanes.valid], float))
    steps = np.linspace(0.0, 1.0, 50)[:, None, None, None]
    found = (found[:, :-1] + steps * np.diff(found, axis=1)).reshape(-1, 3)
    assert len(near) > 5
    assert np.linalg.norm(found - near[:, None], axis=-1).min(1).max() < 0.5


def test_each_scene_has_its_own_angle_within_the_limit(scene):
    turns = []
    for number in range(6):
        world = replace(WORLD, duration_s=2.2, keyframes=1, traffic=replace(WORLD.traffic, warm_up_s=0.0))
        straight, turned = (simulate(number, w) for w in (world, replace(world, view_turn=30.0)))
        turn = pose_yaw(turned.global_from_ego) - pose_yaw(straight.global_from_ego)
        np.testing.assert_allclose(np.sin(turn - turn[0]), 0.0, atol=1e-9)
        turns.append(np.degrees(np.arctan2(np.sin(turn[0]), np.cos(turn[0]))))
    assert np.abs(turns).max() <= 30.0
    assert np.ptp(turns) > 10.0


def test_some_scenes_are_turned_as_all_would_be():
    """A fraction leaves the others as they are without."""
    world = replace(WORLD, duration_s=2.2, keyframes=1, traffic=replace(WORLD.traffic, warm_up_s=0.0))
    kept = 0
    for number in range(8):
        straight, turned, some, none = (
            pose_yaw(simulate(number, replace(world, view_turn=turn, view_turned=fraction)).global_from_ego)
            for turn, fraction in ((0.0, 1.0), (30.0, 1.0), (30.0, 0.5), (30.0, 0.0))
        )
        np.testing.assert_array_equal(none, straight)
        kept += np.array_equal(some, straight)
        assert np.array_equal(some, straight) or np.array_equal(some, turned)
    assert 1 <= kept <= 7
