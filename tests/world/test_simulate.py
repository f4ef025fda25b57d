"""Whole scenes, generated from their numbers."""

from dataclasses import replace

import numpy as np
import pytest

from tests.world.perfect_tracker import PERFECT
from tflane_jax.errors import UserError
from tflane_jax.geometry import pose_yaw, transform_points
from tflane_jax.scene import RoadUser
from tflane_jax.world.roads.networks import RoadConfig, build_road_network
from tflane_jax.world.simulate import ROOT, Stream, WorldConfig, simulate
from tflane_jax.world.traffic.simulation import TrafficConfig, simulate_traffic
from tflane_jax.world.traffic.tracker import TrackerConfig

EMPTY = TrafficConfig(
    vehicles_per_metre=0.0, bicycles_per_metre=0.0, parked_share=0.0, pedestrians_per_metre=0.0, crossers_per_minute=0.0
)
SMALL = WorldConfig(roads=RoadConfig(reach=100.0, ego_reach=50.0), traffic=EMPTY)


def test_same_number_same_bits():
    first, second = simulate(11), simulate(11)
    assert first.global_from_ego.tobytes() == second.global_from_ego.tobytes()
    for part in ("tracks", "actors"):
        for name in ("position", "yaw", "size", "category", "occluded", "valid"):
            a, b = getattr(getattr(first, part), name), getattr(getattr(second, part), name)
            assert a.tobytes() == b.tobytes(), (part, name)
    assert (first.weather, first.paint_wear, first.name) == (second.weather, second.paint_wear, second.name)
    assert simulate(12).global_from_ego.tobytes() != first.global_from_ego.tobytes()


def test_a_log_is_complete():
    log = simulate(3)
    assert log.source == "procedural"
    assert log.seed == 3
    assert log.timestamps_ns.dtype == np.int64
    assert np.diff(log.timestamps_ns).tolist() == [100_000_000] * 79
    assert log.global_from_ego.shape == (80, 4, 4)
    assert [k.track_frame for k in log.keyframes] == [20, 40, 59, 79]
    for k in log.keyframes:
        assert k.timestamp_ns == log.timestamps_ns[k.track_frame]
        np.testing.assert_array_equal(k.global_from_ego, log.global_from_ego[k.track_frame])
    for tracks in (log.tracks, log.actors):
        frames, count = tracks.valid.shape
        assert frames == 80
        assert tracks.position.shape == (80, count, 3)
        assert tracks.yaw.shape == tracks.occluded.shape == (80, count)
        assert tracks.size.shape == (count, 3)
        assert tracks.category.shape == tracks.uuid.shape == (count,)
        assert len(set(tracks.uuid)) == count
        assert tracks.valid.any(0).all()
        assert np.isfinite(tracks.position).all()


def test_boxes_are_in_the_ego_frame_of_their_frame():
    scene, config = 8, WorldConfig()
    log = simulate(scene, config)
    network = build_road_network(np.random.default_rng([ROOT, scene, Stream.ROADS]), config.roads)
    traffic = simulate_traffic(
        np.random.default_rng([ROOT, scene, Stream.TRAFFIC]), network, config.traffic, frames=80, rate_hz=10.0
    )
    there = log.actors.valid
    in_map = transform_points(log.global_from_ego, log.actors.position)
    np.testing.assert_allclose(in_map[there][:, :2], traffic.xy[there], atol=1e-9)
    np.testing.assert_allclose(in_map[there][:, 2], np.broadcast_to(traffic.size[:, 2] / 2, there.shape)[there])
    yaw = log.actors.yaw + pose_yaw(log.global_from_ego)[:, None]
    np.testing.assert_allclose(np.cos(yaw - traffic.yaw)[there], 1.0, atol=1e-12)
    parked = there.all(0) & (np.ptp(in_map, axis=0) < 1e-9).all(-1)
    assert parked.any()


def test_perfect_tracker_reports_every_actor():
    log = simulate(5, WorldConfig(tracker=PERFECT))
    assert log.tracks.valid.sum() == log.actors.valid.sum()
    np.testing.assert_array_equal(log.tracks.valid.sum(1), log.actors.valid.sum(1))
    for f in range(0, 80, 7):
        reported = log.tracks.position[f][log.tracks.valid[f]]
        true = log.actors.position[f][log.actors.valid[f]]
        assert sorted(map(tuple, reported)) == sorted(map(tuple, true))


def test_tracker_does_not_change_the_world():
    first, second = simulate(6), simulate(6, WorldConfig(tracker=TrackerConfig(drop=0.5)))
    assert first.actors.position.tobytes() == second.actors.position.tobytes()
    assert first.tracks.valid.sum() > second.tracks.valid.sum()


def test_a_world_without_traffic():
    log = simulate(2, WorldConfig(traffic=EMPTY))
    for tracks in (log.tracks, log.actors):
        assert tracks.valid.shape == (80, 0)
        assert tracks.position.shape == (80, 0, 3)
        assert tracks.size.shape == (0, 3)
    assert len(log.keyframes) == 4


def test_severity():
    clear, worst = (simulate(4, WorldConfig(severity=s)) for s in (0.0, 1.0))
    assert (clear.weather, clear.paint_wear) == (0.0, 0.0)
    drawn = [simulate(i, WorldConfig(severity=0.5, traffic=EMPTY)).weather for i in range(20)]
    assert np.mean(drawn) == pytest.approx(0.5, abs=0.15)
    assert max(drawn) <= 1.0
    assert worst.weather > 0.0


def test_lights_show_the_state_at_the_start():
    shown = set()
    for scene in range(12):
        config = WorldConfig()
        log = simulate(scene, config)
        network = build_road_network(np.random.default_rng([ROOT, scene, Stream.ROADS]), config.roads)
        green: dict[int, set[int]] = {}
        for element in log.map.elements:
            assert element.category in (1, 2)
            if element.category == 1 and element.attribute == 2:
                onward = [j for i in element.lanes for j in log.map.segments[i].successors]
                for j in onward:
                    intersection, phase = network.signal_phase[j]
                    green.setdefault(intersection, set()).add(phase)
            if element.category == 1:
                shown.add(element.attribute)
        assert all(len(phases) == 1 for phases in green.values())
    assert {1, 2} <= shown <= {1, 2, 3}


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (WorldConfig(duration_s=2.0), "raise duration_s"),
        (WorldConfig(duration_s=2.3), "raise duration_s"),
        (WorldConfig(severity=1.5), "severity"),
        pytest.param(
            replace(SMALL, duration_s=60.0, keyframes=25, rate_hz=2.0),
            "Raise roads.reach and roads.ego_reach",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_errors_name_the_remedy(config, message):
    with pytest.raises(UserError, match=message):
        simulate(0, config)


@pytest.mark.parametrize("scene", [1, 2, 3])
def test_a_drive_that_is_longer_than_its_roads_ends_with_them(scene):
    log = simulate(scene, replace(WorldConfig(), duration_s=20.0), history=100)
    place = log.global_from_ego[:, :2, 3]
    step = np.hypot(*np.diff(place, axis=0).T)
    assert step.max() < 1.5  # 14 m/s: it never jumps
    assert step[-1] == 0.0  # it is at the end
    moments = np.array([moment.track_frame for moment in log.keyframes])
    assert (np.diff([99, *moments]) > 0).all()
    assert (np.hypot(*(place[moments] - place[-1]).T) > 0.0).all()


def test_other_rates_and_a_single_key_frame():
    log = simulate(1, WorldConfig(duration_s=11.0, rate_hz=2.0, keyframes=1))
    assert len(log.timestamps_ns) == 22
    assert np.diff(log.timestamps_ns).tolist() == [500_000_000] * 21
    assert [k.track_frame for k in log.keyframes] == [20]
    speed = np.hypot(*np.diff(log.global_from_ego[:, :2, 3], axis=0).T) * 2.0
    assert speed.max() < 14.5


@pytest.mark.slow
def test_scenes_are_neither_empty_nor_jammed():
    """Road users within +-50 m x +-25 m of the ego vehicle, over thirty scenes of the real road networks."""
    near, speed, moving_vehicles = [], [], []
    for scene in range(100, 130):
        log = simulate(scene, replace(WorldConfig(), keyframes=1))
        x, y = np.abs(log.actors.position[..., :2]).transpose(2, 0, 1)
        near.append((log.actors.valid & (x < 50.0) & (y < 25.0)).sum(1).mean())
        speed.append(np.hypot(*np.diff(log.global_from_ego[:, :2, 3], axis=0).T).mean() * 10.0)
        world = transform_points(log.global_from_ego, log.actors.position)
        valid = log.actors.valid & (log.actors.category <= RoadUser.MOTORCYCLE)
        step = np.where(valid[1:] & valid[:-1], np.hypot(*np.diff(world, axis=0).transpose(2, 0, 1)[:2]), 0.0)
        moving_vehicles.append((step > 0.1).sum(1).mean())
    assert 8.0 <= np.median(near) <= 35.0
    assert np.quantile(near, 0.1) > 4.0
    assert np.mean(np.array(speed) > 2.0) > 0.6
    assert np.median(moving_vehicles) > 4.0


def test_lights_change_in_the_order_of_a_signal():
    """Green turns yellow, yellow red, red green; signs show the same all the time."""
    followed = set()
    for scene in (5, 20, 27, 32, 35):
        log = simulate(scene, WorldConfig(traffic=EMPTY, duration_s=40.0))
        assert log.element_attribute is not None
        assert log.element_attribute.shape == (400, len(log.map.elements))
        assert [e.attribute for e in log.map.elements] == log.element_attribute[0].tolist()
        for element, shown in zip(log.map.elements, log.element_attribute.T, strict=True):
            changes = np.flatnonzero(np.diff(shown))
            if element.category == 2:
                assert len(changes) == 0
            followed |= {(int(shown[i]), int(shown[i + 1])) for i in changes}
    assert followed == {(2, 3), (3, 1), (1, 2)}
