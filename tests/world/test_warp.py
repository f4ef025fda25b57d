"""Bent ground plans: a smooth map without folds, and scenes in which everything moves with the ground."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.world.lane_following import fractions_on_lanes
from tests.world.small_map import ON_MAP, crossroads
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example
from tflane_jax.errors import UserError
from tflane_jax.geometry import transform_points
from tflane_jax.limits import check_settings
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.simulate import Place, Stream, WorldConfig, _stream, simulate
from tflane_jax.world.warp import Warp, WarpConfig, warped

SCENE = 4
WORLD = WorldConfig(duration_s=4.0, keyframes=2, markers=PlacementConfig(side="both"))
BENT = replace(WORLD, warp=WarpConfig())
POINTS = np.random.default_rng(0).uniform(-200.0, 200.0, (500, 2))


@pytest.fixture(scope="module")
def scenes():
    """The same scene, straight and bent, and how it was bent."""
    return simulate(SCENE, WORLD), simulate(SCENE, BENT), BENT.warp.draw(_stream(SCENE, Stream.WARP))


def test_the_jacobian_is_the_derivative():
    warp = WarpConfig().draw(np.random.default_rng(1))
    for axis, step in enumerate(np.eye(2) * 1e-4):
        change = (warp.moved(POINTS + step) - warp.moved(POINTS - step)) / 2e-4
        np.testing.assert_allclose(warp.jacobian(POINTS)[..., axis], change, atol=1e-7)


def test_headings_turn_with_the_ground():
    warp, yaw = WarpConfig().draw(np.random.default_rng(2)), np.linspace(-3.0, 3.0, len(POINTS))
    step = 1e-4 * np.stack([np.cos(yaw), np.sin(yaw)], -1)
    there = warp.moved(POINTS + step) - warp.moved(POINTS - step)
    np.testing.assert_allclose(warp.turned(POINTS, yaw), np.arctan2(there[:, 1], there[:, 0]), atol=1e-6)


@settings(max_examples=40)
@given(
    st.tuples(st.floats(0.6, 1.0), st.floats(1.0, 1.6)),
    st.floats(0.0, 0.5),
    st.floats(0.0, 0.2),
    st.integers(1, 8),
    st.integers(0, 2**32),
)
def test_the_ground_never_folds_and_shrinks_no_more_than_the_bound(stretch, shear, strain, waves, seed):
    config = WarpConfig(stretch, shear, strain, waves=waves)
    assume(all(holds for _, holds, _ in config.limits()))
    warp = config.draw(np.random.default_rng(seed))
    assert warp.least_scale > 0.2
    assert (np.linalg.det(warp.jacobian(POINTS)) > 0.0).all()
    apart, there = (np.linalg.norm(np.diff(p, axis=0), axis=-1) for p in (POINTS, warp.moved(POINTS)))
    assert (there >= warp.least_scale * apart - 1e-9).all()


def test_the_wildest_settings_are_refused():
    check_settings(WarpConfig())
    with pytest.raises(UserError, match="fold"):
        check_settings(WarpConfig(strain=0.4))


def test_a_level_plane_changes_nothing(scenes):
    straight, _, _ = scenes
    none = Warp(np.eye(2), np.ones((1, 2)), np.zeros(1), np.zeros((1, 2)))
    same = warped(straight, none)
    np.testing.assert_allclose(same.actors.position, straight.actors.position, atol=1e-9)
    np.testing.assert_allclose(np.sin(same.actors.yaw - straight.actors.yaw), 0.0, atol=1e-9)
    np.testing.assert_allclose(same.global_from_ego, straight.global_from_ego, atol=1e-12)
    np.testing.assert_allclose(same.map.buildings, straight.map.buildings, atol=1e-9)
    np.testing.assert_allclose(same.markers.pose, straight.markers.pose, atol=1e-9)
    examples = [make_example(log, 1, ExampleConfig()) for log in (straight, same)]
    np.testing.assert_allclose(examples[0].lanes.points, examples[1].lanes.points, atol=1e-3)


def test_everything_moves_with_the_ground(scenes):
    straight, bent, warp = scenes
    for number, lane in straight.map.segments.items():
        for side in ("centerline", "left", "right"):
            there = {tuple(p) for p in getattr(bent.map.segments[number], side)}
            assert {tuple(p) for p in warp.moved(getattr(lane, side))} <= there
    for old, new in zip(straight.map.elements, bent.map.elements, strict=True):
        np.testing.assert_array_equal(new.position, warp.moved(old.position))
    for name in ("tracks", "actors"):
        boxes, there = getattr(straight, name), getattr(bent, name)
        np.testing.assert_array_equal(there.valid, boxes.valid)
        at = [transform_points(log.global_from_ego, getattr(log, name).position) for log in (straight, bent)]
        np.testing.assert_allclose(at[1][boxes.valid], warp.moved(at[0])[boxes.valid], atol=1e-9)
    np.testing.assert_array_equal(bent.keyframes[1].global_from_ego, bent.global_from_ego[-1])


def test_boards_stay_upright_and_face_as_the_ground_turns(scenes):
    straight, bent, warp = scenes
    old, new = straight.markers.pose, bent.markers.pose
    assert len(old) > 0
    np.testing.assert_allclose(np.linalg.det(new[:, :3, :3]), 1.0, atol=1e-9)
    np.testing.assert_allclose(new[:, 2, :3], old[:, 2, :3], atol=1e-12)
    facing = np.arctan2(old[:, 1, 2], old[:, 0, 2])
    turned = warp.turned(old[:, :2, 3], facing)
    np.testing.assert_allclose(np.sin(np.arctan2(new[:, 1, 2], new[:, 0, 2]) - turned), 0.0, atol=1e-9)


def test_vehicles_drive_along_the_lanes_of_a_bent_scene(scenes):
    found = fractions_on_lanes(scenes[1])
    assert len(found) >= 3
    assert found.min() > 0.9


def test_scenes_are_bent_in_their_own_way_and_repeat(scenes):
    _, bent, warp = scenes
    assert simulate(SCENE, BENT).global_from_ego.tobytes() == bent.global_from_ego.tobytes()
    other = BENT.warp.draw(_stream(SCENE + 1, Stream.WARP))
    assert np.abs(other.matrix - warp.matrix).max() > 0.01
    assert np.abs(other.phase - warp.phase).max() > 0.1


def test_a_recorded_map_is_bent():
    """Its lanes and vehicles move together, and the map's own places are asked for more room."""
    world = replace(ON_MAP, warp=WarpConfig())
    log = simulate(3, world, place=Place(crossroads(), 40.0))
    found = fractions_on_lanes(log)
    assert len(found) >= 2
    assert found.min() > 0.9
    tiny = replace(crossroads(), complete=1.0, places=crossroads().places[:1] + 500.0)
    with pytest.raises(UserError, match=r"is too small a map: .* or bend it less \(world.warp\)"):
        simulate(3, world, place=Place(tiny, 40.0))
