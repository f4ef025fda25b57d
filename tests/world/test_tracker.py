"""The tracker on hand-made actors: detection, loss and confusion of identities."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.world.perfect_tracker import PERFECT
from tflane_jax.geometry import transform_points, yaw_pose
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import Tracks
from tflane_jax.world.traffic.tracker import TrackerConfig, track, visible_share, wrap_outside

NO_BUILDINGS = np.zeros((0, 5))
CAR, TRUCK = (4.5, 1.9, 1.5), (9.0, 2.4, 3.5)
RATE = 10.0


def actors_at(xy, sizes, yaw: float | np.ndarray = 0.0, valid=None):
    """Return actors from (F, K, 2) positions in the ego frames."""
    xy, size = np.asarray(xy, float), np.asarray(sizes, float).reshape(-1, 3)
    frames, count = xy.shape[:2]
    return Tracks(
        position=np.concatenate([xy, np.broadcast_to(size[:, 2] / 2, (frames, count))[..., None]], -1),
        yaw=np.broadcast_to(np.asarray(yaw, float), (frames, count)).copy(),
        size=size,
        category=np.full(count, RoadUser.CAR, np.int32),
        occluded=np.zeros((frames, count), bool),
        valid=np.ones((frames, count), bool) if valid is None else np.asarray(valid, bool),
        uuid=np.array([f"a{i}" for i in range(count)], dtype="<U16"),
    )


def standing_ego(frames):
    return np.broadcast_to(np.eye(4), (frames, 4, 4)).copy()


def run(actors, config, seed=0, ego=None, buildings=NO_BUILDINGS):
    ego = standing_ego(actors.frames) if ego is None else ego
    return track(np.random.default_rng(seed), actors, ego, buildings, config, rate_hz=RATE)


def still(positions, frames):
    return np.broadcast_to(np.asarray(positions, float), (frames, len(positions), 2)).copy()


def test_perfect_tracker_reports_the_truth_exactly():
    rng = np.random.default_rng(4)
    actors = actors_at(rng.uniform(-80, 80, (30, 7, 2)), [CAR] * 7, rng.uniform(-3.1, 3.1, (30, 7)))
    reported = run(actors, PERFECT)
    for name in ("position", "yaw", "size", "category", "valid"):
        np.testing.assert_array_equal(getattr(reported, name), getattr(actors, name), err_msg=name)
    assert not reported.occluded.any()
    assert len(set(reported.uuid)) == 7


@pytest.mark.parametrize(("frames", "count"), [(0, 0), (0, 2), (1, 0), (1, 1), (25, 0), (2, 3)])
def test_small_sizes(frames, count):
    actors = actors_at(np.full((frames, count, 2), 9.0) + np.arange(count)[:, None], [CAR] * count)
    reported = run(actors, TrackerConfig(view_needed=0.0, drop=0.0, switch_rate=0.0))
    assert reported.valid.shape == (frames, count if frames else 0)
    assert reported.position.shape == (*reported.valid.shape, 3)
    assert reported.valid.all()


def test_no_size_is_negative():
    """However large the noise: boxes are turned round and drawn, and their sizes are tokens."""
    actors = actors_at(still([(9.0, 3.0 * k) for k in range(20)], 20), [CAR] * 20)
    sizes = run(actors, replace(TrackerConfig(), size_noise=1.0, drop=0.5, coast=0)).size
    assert (sizes >= 0.1 * np.array(CAR) * (1 - 1e-9)).all()
    assert (sizes < 0.2 * np.array(CAR)).any()


def test_same_stream_same_bits():
    rng = np.random.default_rng(1)
    actors = actors_at(rng.uniform(-60, 60, (40, 12, 2)), [CAR] * 12)
    first, second = run(actors, TrackerConfig()), run(actors, TrackerConfig())
    for name in ("position", "yaw", "size", "valid", "occluded"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name


def test_hidden_actor_coasts_then_vanishes_and_comes_back_as_another():
    frames, passing = 60, slice(20, 40)
    xy = np.zeros((frames, 2, 2))
    xy[:, 0] = [30.0, 0.0]
    xy[:, 1] = [12.0, 20.0]
    xy[passing, 1] = [12.0, 0.0]  # a truck stands between
    config = replace(PERFECT, view_needed=0.3, coast=4)
    reported = track(
        np.random.default_rng(0), actors_at(xy, [CAR, TRUCK]), standing_ego(frames), NO_BUILDINGS, config, rate_hz=5.0
    )
    car = np.flatnonzero(reported.size[:, 2] == CAR[2])
    assert len(car) == 2
    before, after = reported.valid[:, car].T
    assert np.flatnonzero(before).tolist() == list(range(24))
    assert np.flatnonzero(reported.occluded[:, car[0]]).tolist() == [20, 21, 22, 23]
    assert np.flatnonzero(after).tolist() == list(range(40, 60))
    assert not reported.occluded[:, car[1]].any()


def test_coasting_is_straight_on_in_the_world_while_the_ego_turns():
    frames = 20
    t = np.arange(frames) / RATE
    ego = yaw_pose(5.0 * t, np.zeros(frames), 0.4 * t)
    world = np.stack([30.0 - 6.0 * t, 4.0 + 1.0 * t], -1)
    inside = transform_points(np.linalg.inv(ego), np.concatenate([world, np.zeros((frames, 1))], 1)[:, None])[..., :2]
    valid = np.ones((frames, 1), bool)
    valid[12:] = False
    actors = actors_at(inside, [CAR], (2.9 - 0.4 * t)[:, None], valid)
    reported = run(actors, replace(PERFECT, coast=5), ego=ego)
    assert np.flatnonzero(reported.valid[:, 0]).tolist() == list(range(17))
    assert reported.occluded[12:17, 0].all()
    seen = transform_points(ego, reported.position)[:17, 0]
    np.testing.assert_allclose(seen[:, :2], world[:17], atol=1e-9)
    np.testing.assert_allclose(reported.yaw[12:17, 0], 2.9 - 0.4 * t[12:17], atol=1e-12)


def row_of_cars(count):
    """Return places abreast of each other, 20 m to the left."""
    return np.stack([np.linspace(-40.0, 40.0, count), np.full(count, 20.0)], -1)


def test_a_coasting_track_drifts_by_the_error_of_its_velocity():
    """In m/s per axis: the error of the place grows by a tenth of it in every frame at 10 Hz."""
    places, valid = row_of_cars(400), np.ones((9, 400), bool)
    valid[4:] = False
    reported = run(actors_at(still(places, 9), [CAR] * 400, valid=valid), replace(PERFECT, coast=5, velocity_noise=0.5))
    error = reported.position[..., :2] - places
    frames_lost = np.array([0, 0, 0, 0, 1, 2, 3, 4, 5])
    np.testing.assert_allclose(error.std(1), np.tile(0.05 * frames_lost[:, None], (1, 2)), rtol=0.1)


def test_sizes_are_wrong_by_a_fraction_of_their_own_on_each_axis():
    """Constant for a track, and drawn independently for length, width and height."""
    actors = actors_at(still(row_of_cars(400), 2), [CAR] * 400)
    ratio = run(actors, replace(PERFECT, size_noise=0.05)).size / np.array(CAR)
    np.testing.assert_allclose(ratio.std(0), 0.05, rtol=0.15)
    np.testing.assert_allclose(ratio.mean(0), 1.0, atol=0.01)
    assert np.abs(np.corrcoef(ratio.T) - np.eye(3)).max() < 0.2


def test_scaled_noise_scales_misses_errors_and_switches():
    tracker = TrackerConfig()
    halved = tracker.with_noise(0.5)
    for name in ("drop", "position_noise", "position_noise_growth", "yaw_noise", "velocity_noise", "switch_rate"):
        assert getattr(halved, name) == 0.5 * getattr(tracker, name), name
    assert tracker.with_noise(100.0).drop == 1.0


def test_short_gap_keeps_the_identity_and_long_gap_does_not():
    frames = 30
    valid = np.ones((frames, 1), bool)
    valid[10:13] = False
    actors = actors_at(still([[10.0, 0.0]], frames), [CAR], valid=valid)
    assert run(actors, replace(PERFECT, coast=3)).valid.shape[1] == 1
    assert run(actors, replace(PERFECT, coast=2)).valid.shape[1] == 2


def test_identity_switches_swap_neighbours_and_leave_others_alone():
    frames = 12
    actors = actors_at(still([[10.0, 0.0], [12.5, 0.0], [10.0, 30.0]], frames), [CAR] * 3)
    # One switch in every frame but the first: 10 Hz at a rate of 10 per second.
    reported = run(actors, replace(PERFECT, switch_rate=10.0))
    x = reported.position[:, :2, 0]
    expected = np.where(np.arange(frames)[:, None] % 2 == np.arange(2), 10.0, 12.5)
    np.testing.assert_array_equal(x, expected)
    assert (reported.position[:, 2, 1] == 30.0).all()
    apart = actors_at(still([[10.0, 0.0], [14.5, 0.0]], frames), [CAR] * 2)
    assert (run(apart, replace(PERFECT, switch_rate=10.0)).position == apart.position).all()


def test_tracks_that_have_just_begun_do_not_switch():
    """Both must have been there in the frame before: a new track has no identity to lose."""
    frames = 9
    valid = np.ones((frames, 2), bool)
    valid[:4, 1] = False
    actors = actors_at(still([[10.0, 0.0], [12.5, 0.0]], frames), [CAR] * 2, valid=valid)
    reported = run(actors, replace(PERFECT, switch_rate=10.0))
    swapped = (np.arange(frames) > 4) & (np.arange(frames) % 2 == 1)
    np.testing.assert_array_equal(reported.position[:, 0, 0], np.where(swapped, 12.5, 10.0))
    np.testing.assert_array_equal(reported.position[4:, 1, 0], np.where(swapped, 10.0, 12.5)[4:])


def test_rate_of_identity_switches():
    frames, pairs = 400, 20
    xy = still([[10.0 + d, 8.0 * k] for k in range(pairs) for d in (0.0, 2.0)], frames)
    reported = run(actors_at(xy, [CAR] * 2 * pairs), replace(PERFECT, switch_rate=0.25))
    switches = (np.diff(reported.position[:, ::2, 0], axis=0) != 0).sum()
    assert switches == pytest.approx(0.25 / RATE * (frames - 1) * pairs, rel=0.25)


def test_detection_falls_off_with_distance():
    frames = 1500
    actors = actors_at(still([[40.0, 0.0], [0.0, 70.0], [-90.0, 0.0]], frames), [CAR] * 3)
    config = replace(PERFECT, range=60.0, falloff=20.0, drop=0.1)
    reported = run(actors, config)
    near = np.linalg.norm(reported.position, axis=-1)
    fraction = [(reported.valid & (abs(near - d) < 5.0)).sum() / frames for d in (40.0, 70.0, 90.0)]
    np.testing.assert_allclose(fraction, [0.9, 0.45, 0.0], atol=0.05)


def test_noise_grows_with_distance_and_is_correlated():
    frames = 4000
    actors = actors_at(still([[10.0, 0.0], [0.0, 50.0]], frames), [CAR] * 2)
    config = replace(PERFECT, position_noise=0.1, position_noise_growth=0.01, yaw_noise=0.05, correlation=0.7)
    reported = run(actors, config)
    error = reported.position[..., :2] - actors.position[..., :2]
    np.testing.assert_allclose(error.std((0, 2)), [0.2, 0.6], rtol=0.1)
    np.testing.assert_allclose((reported.yaw - actors.yaw).std(0), 0.05, rtol=0.1)
    np.testing.assert_array_equal(reported.position[..., 2], actors.position[..., 2])
    one = error[:, 0, 0]
    assert np.corrcoef(one[1:], one[:-1])[0, 1] == pytest.approx(0.7, abs=0.06)


def test_a_building_hides_in_global_coordinates():
    frames = 6
    ego = np.broadcast_to(yaw_pose(*np.array([100.0, 50.0, np.pi / 2])), (frames, 4, 4)).copy()
    actors = actors_at(still([[30.0, 0.0], [0.0, 30.0]], frames), [CAR] * 2)
    # 15 m ahead of the ego vehicle, which looks along global y.
    building = np.array([[100.0, 65.0, 8.0, 6.0, 0.0]])
    fraction = visible_share(actors, ego, building, stride=1)
    np.testing.assert_array_equal(fraction, np.tile([0.0, 1.0], (frames, 1)))
    assert run(actors, replace(PERFECT, view_needed=0.3), ego=ego, buildings=building).valid.shape[1] == 1


def test_interpolated_line_of_sight_is_exact_where_it_is_computed():
    rng = np.random.default_rng(2)
    paths = np.cumsum(rng.normal(0, 0.5, (21, 15, 2)), 0) + rng.uniform(-40, 40, (15, 2))
    actors = actors_at(paths, [TRUCK] * 15)
    every = visible_share(actors, standing_ego(21), NO_BUILDINGS, stride=1)
    some = visible_share(actors, standing_ego(21), NO_BUILDINGS, stride=4)
    np.testing.assert_array_equal(some[::4], every[::4])
    np.testing.assert_allclose(some[2], 0.5 * (every[0] + every[4]), atol=1e-12)
    assert (every < 1.0).any()


def test_an_actor_that_appears_between_two_looks_is_seen_as_at_the_next_one():
    valid = np.ones((9, 1), bool)
    valid[:2] = valid[7:] = False
    actors = actors_at(still([[20.0, 0.0]], 9), [CAR], valid=valid)
    fraction = visible_share(actors, standing_ego(9), NO_BUILDINGS, stride=4)
    np.testing.assert_array_equal(fraction[:, 0], valid[:, 0])


def test_padding_is_never_read():
    rng = np.random.default_rng(3)
    valid = rng.random((30, 6)) < 0.7
    clean = actors_at(rng.uniform(-30, 30, (30, 6, 2)), [CAR] * 6, valid=valid)
    dirty = replace(
        clean, position=np.where(valid[..., None], clean.position, np.nan), yaw=np.where(valid, clean.yaw, np.nan)
    )
    config = TrackerConfig(switch_rate=2.0)
    first, second = run(clean, config), run(dirty, config)
    for name in ("position", "yaw", "valid", "occluded", "size"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    assert np.isfinite(first.position).all()


@settings(max_examples=50)
@given(st.floats(-50.0, 50.0))
def test_wrapped_angles_point_the_same_way(angle):
    wrapped = float(wrap_outside(np.array(angle)))
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-9)
    if -math.pi < angle <= math.pi:
        assert wrapped == angle
