"""Simulated detections of markers: the numbers of the marker paper, section IV-A."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.small_logs import lane_map, log, segment, tracks
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.leaves import example_leaves
from tflane_jax.datasets.marker_observations import marker_observations
from tflane_jax.geometry import PerceptionRange, invert_pose, relative_pose, yaw_pose
from tflane_jax.markers.simulation import (
    PERFECT,
    MarkerConfig,
    MarkerSimulationConfig,
    moment_before,
    simulate_detections,
    visible,
)
from tflane_jax.scene.logs import MapElement, PlacedMarkers
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING
from tflane_jax.world.roads.markers import marker_pose
from tflane_jax.world.simulate import simulate

NOISY = MarkerSimulationConfig(detection_sigma=float("inf"), jump=0.0)
MAP = lane_map(segment(1, [(-60, 0), (40, 0)], [2]), segment(2, [(40, 0), (90, 0)], is_intersection=True))


def markers_at(*distances, facing=np.pi):
    place = np.array([(d, 0.0, 3.0) for d in distances]).reshape(-1, 3)
    return PlacedMarkers(np.arange(len(place)), marker_pose(place, np.full(len(place), facing)))


def standing(frames=1, *, boxes=((-30.0, 0.0, 0.75),), vector_map=MAP, **other):
    """A log of a static vehicle at the map's origin; every frame is a key frame."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    recorded = tracks(np.tile(np.array(boxes, float).reshape(1, -1, 3), (frames, 1, 1)))
    return log(vector_map, recorded, poses, list(enumerate(poses)), **other)


def copies(distance, count):
    """Return markers with distinct ids at one place, so that their random draws are independent."""
    return PlacedMarkers(np.arange(count), np.repeat(markers_at(distance).pose, count, 0))


def errors(distance, config, count=3000):
    """Return the pose errors in x, y, z (metres), yaw and pitch (degrees) of many sightings, and which jumped."""
    scene, placed = standing(1, seed=3), copies(distance, count)
    drawn = simulate_detections(scene, scene.keyframes[0], placed, config)
    change = drawn.pose[:, :3, :3] @ placed.pose[:, :3, :3].swapaxes(1, 2)
    yaw, pitch = np.arctan2(change[:, 1, 0], change[:, 0, 0]), -np.arcsin(change[:, 2, 0])
    return np.column_stack([(drawn.pose - placed.pose)[:, :3, 3], np.rad2deg(yaw), np.rad2deg(pitch), drawn.jump])


CLEAR = replace(NOISY, occlusion="none")


@pytest.mark.parametrize(
    ("distance", "growth", "fraction"), [(60.0, "linear", 1.0), (15.0, "linear", 0.25), (30.0, "quadratic", 0.25)]
)
def test_errors_grow_with_the_distance(distance, growth, fraction):
    found = errors(distance, replace(CLEAR, growth=growth))
    np.testing.assert_allclose(found[:, [0, 3, 4]].std(0), fraction * np.array([3.0, 2.0, 2.0]), rtol=0.05)
    np.testing.assert_allclose(found[:, [0, 3, 4]].mean(0), 0.0, atol=0.2 * fraction)
    np.testing.assert_allclose(found[:, 1:3], 0.0, atol=1e-9)  # along the ego axis only
    assert not found[:, 5].any()
    # The three are drawn independently.
    assert np.abs(np.corrcoef(found[:, [0, 3, 4]].T) - np.eye(3)).max() < 0.07


def test_every_error_has_a_spread_of_its_own():
    found = errors(60.0, replace(CLEAR, forward_sigma=1.0, yaw_sigma=4.0, pitch_sigma=0.5))
    np.testing.assert_allclose(found[:, [0, 3, 4]].std(0), [1.0, 4.0, 0.5], rtol=0.05)


def test_jumps():
    found = errors(10.0, replace(MarkerSimulationConfig(detection_sigma=np.inf), occlusion="none"), count=4000)
    jumped = found[:, 5].astype(bool)
    assert jumped.mean() == pytest.approx(0.05, abs=0.012)
    far = np.hypot(*found[jumped, :2].T)
    assert far.mean() == pytest.approx(25.0, abs=0.8)
    assert 15.0 < far.min() < far.max() < 35.0
    assert np.abs(found[jumped, 3]).mean() == pytest.approx(90.0, abs=3.0)
    assert (found[jumped, 3] > 0).mean() == pytest.approx(0.5, abs=0.12)
    quadrant = np.floor(np.arctan2(found[jumped, 1], found[jumped, 0]) / (np.pi / 2))
    assert np.bincount((quadrant + 2).astype(int)).min() > 0.12 * jumped.sum()
    # The side of the turn does not follow from the direction of the jump.
    left = (found[jumped, 1] > 0) == (found[jumped, 3] > 0)
    assert left.mean() == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("distance", [20.0, 55.0])
def test_detection_probability(distance):
    scene, config = standing(1, seed=5), replace(MarkerSimulationConfig(), occlusion="none")
    hits = simulate_detections(scene, scene.keyframes[0], copies(distance, 1500), config).valid
    assert np.mean(hits) == pytest.approx(np.exp(-(distance**2) / (2 * 40.0**2)), abs=0.04)


def test_without_noise_the_pose_is_the_truth_and_all_that_is_visible_is_detected():
    scene = simulate(200_000_034)
    assert scene.markers is not None
    for moment in scene.keyframes:
        true = relative_pose(moment.global_from_ego, scene.markers.pose)
        found = simulate_detections(scene, moment, scene.markers, replace(PERFECT, occlusion="none"))
        np.testing.assert_array_equal(found.valid, visible(true, PERFECT))
        np.testing.assert_allclose(found.pose[found.valid], true[found.valid], atol=1e-9)
        np.testing.assert_array_equal(found.score, found.valid.astype(float))
    assert found.valid.any()


@pytest.mark.parametrize(
    ("x", "y", "facing", "seen"),
    [
        (30.0, -4.0, 180.0, True),
        (61.0, 0.0, 180.0, False),  # too far
        (-30.0, -4.0, 180.0, False),  # passed
        (30.0, -4.0, 0.0, False),  # its back
        (30.0, -4.0, 245.0, False),  # the vehicle drives past its face
        (30.0, -4.0, 230.0, True),
        (10.0, -20.0, 180.0, False),  # too far to the side
        (0.0, 0.0, 180.0, False),
    ],
)
def test_a_marker_is_visible_to_a_vehicle_that_approaches_its_face(x, y, facing, seen):
    pose = marker_pose(np.array([[x, y, 3.0]]), np.deg2rad([facing]))
    assert visible(pose, MarkerSimulationConfig()).tolist() == [seen]


def test_road_users_and_buildings_hide_markers():
    placed, config = markers_at(20.0, 40.0), PERFECT
    truck = standing(1, boxes=[(30.0, 0.0, 2.0)])
    tall = tracks(np.array([[[30.0, 0.0, 2.0]]]), size=(8.0, 2.5, 4.0))
    truck = replace(truck, tracks=tall, actors=tall)
    assert simulate_detections(truck, truck.keyframes[0], placed, config).valid.tolist() == [True, False]
    clear = replace(config, occlusion="none")
    assert simulate_detections(truck, truck.keyframes[0], placed, clear).valid.tolist() == [True, True]
    # A car is lower than the line to a marker 3 m up.
    car = standing(1, boxes=[(30.0, 0.0, 0.75)])
    assert simulate_detections(car, car.keyframes[0], placed, config).valid.tolist() == [True, True]
    house = standing(1, vector_map=replace(MAP, buildings=np.array([[30.0, 0.0, 5.0, 5.0, 0.3]])))
    assert simulate_detections(house, house.keyframes[0], placed, config).valid.tolist() == [True, False]


def test_markers_must_be_in_the_image_and_clear_of_bodies():
    placed = markers_at(4.0, 20.0)
    scene, wide = replace(standing(1), markers=placed), replace(PERFECT, cameras=ARGOVERSE2_RING)

    def seen(config, log=scene):
        return simulate_detections(log, log.keyframes[0], placed, config).valid.tolist()

    assert seen(PERFECT) == [True, True]
    assert seen(wide) == [False, True]  # the near one is above the image
    # A sign before the second one.
    sign = MapElement(np.array([19.0, 0.0, 3.0]), np.pi, 2, 4, ())
    signed = replace(scene, map=replace(MAP, elements=(sign,)))
    assert seen(wide, signed) == [False, True]
    assert seen(replace(wide, occlusion="bodies"), signed) == [False, False]
    assert seen(replace(wide, occlusion="bodies", least_seen=0.1), signed) == [False, True]
    assert seen(replace(wide, occlusion="bodies", least_seen=0.0), signed) == [False, True]
    assert seen(replace(PERFECT, occlusion="bodies"), signed) == [True, False]
    # A real log, without boards, has no scenery.
    assert seen(replace(wide, occlusion="bodies"), replace(signed, markers=None)) == [False, True]


def test_random_draws_depend_on_seed_frame_and_id_only():
    placed, config = markers_at(10.0, 20.0, 30.0, 40.0), NOISY
    scene = standing(3, seed=9)
    together = simulate_detections(scene, scene.keyframes[1], placed, config)
    assert together.valid.all()
    chosen = [2, 0]
    fewer = PlacedMarkers(placed.marker_id[chosen], placed.pose[chosen])
    simulate_detections(scene, scene.keyframes[2], placed, config)
    alone = simulate_detections(scene, scene.keyframes[1], fewer, config)
    assert alone.pose.tobytes() == together.pose[chosen].tobytes()
    others = (
        simulate_detections(replace(scene, seed=10), scene.keyframes[1], placed, config),
        simulate_detections(scene, scene.keyframes[2], placed, config),
        simulate_detections(scene, scene.keyframes[1], replace(placed, marker_id=placed.marker_id + 4), config),
    )
    for other in others:
        assert (other.pose[:, 0, 3] != together.pose[:, 0, 3]).all()


def test_logs_without_markers():
    scene = standing(2)
    none = simulate_detections(scene, scene.keyframes[0], markers_at(), NOISY)
    assert none.pose.shape == (0, 4, 4)
    assert none.valid.shape == none.score.shape == (0,)


def test_scores_come_from_their_range():
    scene, config = standing(1, seed=2), replace(CLEAR, score=(0.4, 0.7))
    drawn = simulate_detections(scene, scene.keyframes[0], copies(10.0, 300), config).score
    assert 0.4 <= drawn.min() < 0.42
    assert 0.68 < drawn.max() <= 0.7


def test_the_residual_compares_with_the_configured_moment():
    scene = standing(20)  # frames 0.1 s apart, each a key frame
    assert moment_before(scene, 12, 0.5).track_frame == 7
    assert moment_before(scene, 12, None).track_frame == 11
    assert moment_before(scene, 5, 0.5).track_frame == 0
    assert moment_before(scene, 1, 0.5) is None
    assert moment_before(scene, 0, 0.5) is None
    assert moment_before(scene, 0, None) is None


def test_the_first_key_frame_compares_with_the_record_before_it():
    scene = replace(standing(10, seed=4), markers=markers_at(40.0))
    config = MarkerConfig(simulation=replace(NOISY, first_residual=50.0))
    late = replace(scene, keyframes=scene.keyframes[8:9])
    observed = marker_observations(late, 0, config, PerceptionRange(), bike_lanes=True)
    now, before = (simulate_detections(scene, scene.keyframes[f], scene.markers, config.simulation) for f in (8, 3))
    assert observed.valid.tolist() == [True, False]
    assert 0.0 < observed.residual[0] < 20.0
    assert now.pose.tobytes() != before.pose.tobytes()
    first = replace(config, simulation=replace(config.simulation, residual_interval=None))
    assert marker_observations(late, 0, first, PerceptionRange(), bike_lanes=True).residual[0] == 50.0


@functools.cache
def town():
    """Return a scene in which the vehicle sees a marker at three of its key frames or more."""
    return simulate(200_000_044)


def test_markers_change_no_other_part_of_an_example():
    plain = example_leaves(make_example(town(), 1, ExampleConfig()))
    full = example_leaves(make_example(town(), 1, ExampleConfig(markers=MarkerConfig())))
    assert not any(name.startswith("markers") for name in plain)
    assert {name for name in full if not name.startswith("markers.")} == set(plain)
    for name, leaf in plain.items():
        assert full[name].tobytes() == leaf.tobytes(), name
    again = example_leaves(make_example(simulate(200_000_044), 1, ExampleConfig(markers=MarkerConfig())))
    for name, leaf in full.items():
        assert again[name].tobytes() == leaf.tobytes(), name


def test_without_noise_observed_lanes_lie_on_the_true_ones():
    config = ExampleConfig(markers=MarkerConfig(simulation=PERFECT, radius=200.0), sensor=None)
    seen = 0
    for keyframe in range(4):
        example = make_example(town(), keyframe, config)
        markers, lanes = example.markers, example.lanes
        markers.validate()
        for m in np.flatnonzero(markers.valid):
            seen += 1
            np.testing.assert_allclose(markers.residual[m], 0.0, atol=1e-4)
            # With so large a radius the marker knows every lane in range, and the pieces are the same.
            n = lanes.valid.sum()
            assert markers.lane_valid[m].sum() == n
            off = np.linalg.norm(markers.lanes[m, :n] - lanes.points[:n], axis=-1)
            assert off.max() < 0.3  # both are sampled coarsely, at different places
            assert np.median(off) < 0.02
            np.testing.assert_array_equal(markers.successor[m, :n, :n], lanes.successor[:n, :n])
    assert seen >= 3


def test_a_log_of_real_data_gets_virtual_markers():
    scene = standing(3, seed=1)
    assert scene.markers is None
    config = MarkerConfig(simulation=PERFECT)
    observed = marker_observations(scene, 2, config, PerceptionRange(), bike_lanes=True)
    (row,) = np.flatnonzero(observed.valid)
    pose = observed.pose[row]
    assert pose[0, 3] == pytest.approx(40.0, abs=0.1)
    assert invert_pose(pose)[2, 3] > 0.0  # the vehicle stands before its face
    # Both segments are one merged centerline, from the range's border, or 50 m before the marker, to the other border.
    assert observed.lane_valid[row].sum() == 1
    np.testing.assert_allclose(observed.lanes[row, 0, [0, -1], 0], [40.0 - np.sqrt(50.0**2 - 3.05**2), 50.0], atol=0.1)
    turned = replace(
        scene,
        seed=2,
        keyframes=(
            replace(
                scene.keyframes[0], global_from_ego=yaw_pose(np.array([0.0]), np.array([0.0]), np.array([np.pi]))[0]
            ),
        ),
    )
    assert not marker_observations(turned, 0, config, PerceptionRange(), bike_lanes=True).valid.any()
