"""Simulated traffic as a whole: physics, lanes, boxes that stay apart, lights, determinism."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import shapely
from scipy.spatial import KDTree

from tests.world.crossroads import REACH, STOP, crossroads
from tflane_jax.scene import RoadUser
from tflane_jax.world.presets import CITY, REAL_LIKE, STREET
from tflane_jax.world.roads.networks import RoadConfig, SceneKind, build_road_network
from tflane_jax.world.roads.traffic_control import GREEN, RED, YELLOW
from tflane_jax.world.traffic.lane_table import build_lane_table
from tflane_jax.world.traffic.pedestrians import walk_sidewalks
from tflane_jax.world.traffic.signals import Signals, draw_signals
from tflane_jax.world.traffic.simulation import TrafficConfig, simulate_traffic

RATE = 10.0
EMPTY = TrafficConfig(
    vehicles_per_metre=0.0, bicycles_per_metre=0.0, parked_share=0.0, pedestrians_per_metre=0.0, crossers_per_minute=0.0
)
BUSY = replace(TrafficConfig(), vehicles_per_metre=0.05, range=1e3)
PRESETS = {"city": CITY, "street": STREET} | {
    kind.value: replace(REAL_LIKE, roads=replace(REAL_LIKE.roads, kinds=((kind, 1.0),)))
    for kind in (SceneKind.FIVE_LEGS, SceneKind.STAGGERED)
}
HAND_MADE = ["crossroads", "crossroads yield", "turn"]
NETWORKS = [*HAND_MADE, 0, 4, 5, 9, ("city", 1), ("city", 4), ("street", 1), ("street", 2)]
NETWORKS += [(SceneKind.FIVE_LEGS.value, 3), (SceneKind.STAGGERED.value, 3)]


@functools.cache
def scene(which, frames=80):
    hand_made = {
        "crossroads": lambda: crossroads("signals"),
        "crossroads yield": lambda: crossroads("yield"),
        "turn": lambda: crossroads("yield", turn="right"),
    }
    if which in hand_made:
        network, config = hand_made[which](), BUSY
    elif isinstance(which, tuple):
        world = PRESETS[which[0]]
        network, config = build_road_network(np.random.default_rng([which[1]]), world.roads), world.traffic
    else:
        network, config = build_road_network(np.random.default_rng([which]), RoadConfig()), TrafficConfig()
    return network, simulate_traffic(np.random.default_rng([7]), network, config, frames=frames, rate_hz=RATE)


def with_ego(traffic):
    """Return xy, yaw, size, present of all vehicles, the ego vehicle first."""
    vehicle = traffic.category <= RoadUser.BICYCLE
    return (
        np.concatenate([traffic.ego[:, None, :2], traffic.xy[:, vehicle]], 1),
        np.concatenate([traffic.ego[:, 2:], traffic.yaw[:, vehicle]], 1),
        np.concatenate([[[4.5, 1.85, 1.6]], traffic.size[vehicle]]),
        np.concatenate([np.ones((len(traffic.ego), 1), bool), traffic.present[:, vehicle]], 1),
    )


def test_same_seed_same_bits():
    network, first = scene(5)
    second = simulate_traffic(np.random.default_rng([7]), network, TrafficConfig(), frames=80, rate_hz=RATE)
    for name in ("xy", "yaw", "present", "size", "category", "ego"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name


@pytest.mark.parametrize("which", NETWORKS)
def test_motion_is_physical(which):
    _, traffic = scene(which)
    xy, yaw, _, present = with_ego(traffic)
    there = present[1:] & present[:-1]
    speed = np.where(there, np.hypot(*np.diff(xy, axis=0).transpose(2, 0, 1)) * RATE, 0.0)
    assert speed.max() < 35.0
    assert speed[:, 0].max() < 14.5
    change = np.where(there[1:] & there[:-1], np.diff(speed, axis=0) * RATE, 0.0)
    # Braking ends at 7 m/s^2; what moves sideways adds a little.
    assert change.min() > -7.6
    assert change.max() < 6.0
    turn = (np.diff(yaw, axis=0) + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn[there]).max() < 0.25
    # No vehicle turns on the spot.
    assert np.abs(turn[there & (speed < 0.01)]).max(initial=0.0) < 0.01


@pytest.mark.parametrize("which", NETWORKS)
def test_vehicles_keep_to_their_lanes(which):
    network, traffic = scene(which)
    table = build_lane_table(network)
    xy, yaw, size, present = with_ego(traffic)
    bicycle = np.append(False, traffic.category[traffic.category <= RoadUser.BICYCLE] == RoadUser.BICYCLE)
    moved = np.where(present[-1] & present[0], np.hypot(*(xy[-1] - xy[0]).T), 0.0) > 4.0
    short = (size[:, 0] < 7.0) & ~bicycle
    # The middle of a long vehicle cuts corners; cyclists without a lane of their own keep to the right edge.
    for group, farthest in ((moved & short, 0.75), (moved, 1.3)):
        points = xy[:, group].reshape(-1, 2)
        distance, vertex = KDTree(table.xy).query(points)
        across = np.abs(
            (points - table.xy[vertex])[:, 1] * np.cos(table.heading[vertex])
            - (points - table.xy[vertex])[:, 0] * np.sin(table.heading[vertex])
        )
        assert np.quantile(np.where(distance < 2.5, across, 9.0), 0.99) < farthest
    assert moved.sum() > 1
    _, vertex = KDTree(table.xy).query(xy[:, moved].reshape(-1, 2))
    with_lane = np.cos(yaw[:, moved].reshape(-1) - table.heading[vertex])
    assert np.mean(with_lane > 0.8) > 0.9


@pytest.mark.parametrize("which", NETWORKS)
def test_vehicles_hardly_ever_overlap(which):
    _, traffic = scene(which)
    xy, yaw, size, present = with_ego(traffic)
    corner = 0.5 * (size[:, None, :2] - 0.1) * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    cos, sin = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    outline = np.stack([cos * corner[..., 0] - sin * corner[..., 1], sin * corner[..., 0] + cos * corner[..., 1]], -1)
    boxes = np.asarray(shapely.polygons(xy[:, :, None] + outline))
    a, b = np.triu_indices(xy.shape[1], 1)
    near = np.hypot(*(xy[:, a] - xy[:, b]).transpose(2, 0, 1)) < 13.0
    frame, pair = np.nonzero(present[:, a] & present[:, b] & near)
    overlap = shapely.intersects(boxes[frame, a[pair]], boxes[frame, b[pair]])
    assert len(overlap) > 100
    assert overlap.mean() < 0.005


def test_red_lights_are_respected():
    crossings_of_the_line = 0
    for seed in range(6):
        network = crossroads("signals")
        traffic = simulate_traffic(np.random.default_rng([seed]), network, BUSY, frames=120, rate_hz=RATE)
        green = np.array([traffic.signals.green_phase(f / RATE)[0] for f in range(-30, 120)])
        for phase, axis in ((0, 0), (1, 1)):
            on_street = np.abs(traffic.xy[..., 1 - axis]) < 1.75
            front = traffic.xy[..., axis] + traffic.size[:, 0] / 2
            passes = (front[:-1] < -STOP) & (front[1:] >= -STOP) & on_street[1:] & traffic.present[1:]
            frame, _ = np.nonzero(passes & (traffic.category <= RoadUser.BICYCLE))
            for f in frame:
                # A vehicle too near to stop when the light changes may take 12 m/s / (2 * 3.5 m/s^2) s to the line.
                assert (green[f + 30 - 22 : f + 31] == phase).any()
            crossings_of_the_line += len(frame)
    assert crossings_of_the_line > 15


def test_both_streets_are_used_at_the_unsignalised_crossroads():
    traffic = simulate_traffic(np.random.default_rng([3]), crossroads("yield"), BUSY, frames=200, rate_hz=RATE)
    inside = (np.abs(traffic.xy) < STOP).all(-1) & traffic.present & (traffic.category <= RoadUser.BUS)
    east = np.abs(np.sin(traffic.yaw)) < 0.1
    assert (inside & east).any()
    assert (inside & ~east).any()


def test_traffic_is_settled_in_the_first_frame():
    early, late = [], []
    for seed in range(20):
        network = crossroads("yield")
        traffic = simulate_traffic(np.random.default_rng([seed]), network, BUSY, frames=80, rate_hz=RATE)
        moving = traffic.present & (traffic.category <= RoadUser.BUS)
        early.append(moving[0].sum())
        late.append(moving[-1].sum())
    assert np.mean(early) == pytest.approx(np.mean(late), rel=0.25)


@pytest.mark.slow
def test_variety_spreads_the_amounts_and_keeps_the_means():
    network = crossroads("signals")
    counts = {0.0: [], 0.8: []}
    for variety, found in counts.items():
        config = replace(BUSY, variety=variety, vehicles_per_metre=0.02)
        for seed in range(60):
            traffic = simulate_traffic(np.random.default_rng([seed]), network, config, frames=2, rate_hz=RATE)
            found.append((traffic.present[0] & (traffic.category <= RoadUser.MOTORCYCLE)).sum())
    plain, varied = counts.values()
    assert np.mean(varied) == pytest.approx(np.mean(plain), rel=0.25)
    assert np.std(varied) > 1.5 * np.std(plain)


@pytest.mark.parametrize("when", [4.0, 7.0])
def test_the_ego_vehicle_passes_the_middle_of_its_way_in_time(when):
    network, config = crossroads("yield"), replace(EMPTY, ego_passes_s=when, ego_top_speed=6.0)
    for seed in range(5):
        traffic = simulate_traffic(np.random.default_rng([seed]), network, config, frames=90, rate_hz=RATE)
        at = traffic.ego[round(when * RATE), :2]
        # It aims at up to 20 m from the middle, and slows down for the junction there.
        assert np.hypot(*at) < 30.0


def test_no_traffic_leaves_the_ego_vehicle_alone():
    network = crossroads("yield")
    traffic = simulate_traffic(np.random.default_rng([1]), network, EMPTY, frames=30, rate_hz=RATE)
    assert traffic.xy.shape == (30, 0, 2)
    assert traffic.present.shape == (30, 0)
    assert (np.abs(traffic.ego[:, 1]) < 1.0).all()
    assert (np.diff(traffic.ego[:, 0]) > 0.0).all()


def test_steps_are_short_whatever_the_rate_of_frames():
    network, _ = scene("crossroads yield")
    seldom, often = (
        simulate_traffic(np.random.default_rng([7]), network, BUSY, frames=frames, rate_hz=rate)
        for frames, rate in ((8, 0.5), (71, 5.0))
    )
    np.testing.assert_allclose(seldom.ego, often.ego[::10], atol=1e-9)
    assert np.hypot(*np.diff(seldom.ego[:, :2], axis=0).T).max() > 3.0


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_very_short_recordings(frames):
    traffic = simulate_traffic(
        np.random.default_rng([1]), crossroads("signals"), TrafficConfig(), frames=frames, rate_hz=RATE
    )
    assert traffic.ego.shape == (frames, 3)
    assert traffic.xy.shape[:2] == traffic.present.shape


def test_parked_vehicles_stand_in_their_slots():
    config = TrafficConfig(
        parked_share=1.0,
        vehicles_per_metre=0.0,
        bicycles_per_metre=0.0,
        pedestrians_per_metre=0.0,
        crossers_per_minute=0.0,
        range=1e3,
    )
    traffic = simulate_traffic(np.random.default_rng([1]), crossroads("signals"), config, frames=5, rate_hz=RATE)
    np.testing.assert_allclose(traffic.xy, np.broadcast_to([[40.0, 3.5], [46.5, 3.5]], (5, 2, 2)), atol=0.2)
    assert (traffic.xy == traffic.xy[0]).all()


def test_pedestrians_walk_on_the_sidewalk_at_walking_pace():
    line = np.array([[-REACH, -5.0], [0.0, -5.0], [0.0, -50.0]])
    times = np.arange(100) / RATE
    people = walk_sidewalks(np.random.default_rng(3), (line,), times, per_metre=0.2)
    assert people.xy.shape[1] > 20
    speed = np.hypot(*np.diff(people.xy, axis=0).transpose(2, 0, 1)) * RATE
    moving = speed[people.present[1:] & people.present[:-1]]
    assert np.quantile(moving, 0.95) < 1.9
    assert (speed.max(0) == 0.0).any()
    at = people.xy[people.present]
    off = np.minimum(np.abs(at[:, 1] + 5.0), np.abs(at[:, 0]))
    assert off.max() < 0.7


def test_pedestrians_face_where_they_go():
    """In both directions, round a bend of 30 m radius."""
    angle = np.linspace(0.0, np.pi / 2, 60)
    bend = 30.0 * np.stack([np.cos(angle), np.sin(angle)], -1)
    people = walk_sidewalks(np.random.default_rng(3), (bend,), np.arange(50) / RATE, per_metre=1.0)
    step, there = np.diff(people.xy, axis=0), people.present[1:] & people.present[:-1]
    goes = np.arctan2(step[..., 1], step[..., 0])
    walking = there & (np.hypot(step[..., 0], step[..., 1]) > 0.05)
    turned = (people.yaw[1:] - goes + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned[walking]).max() < np.deg2rad(2.0)
    left_round = np.sin(goes[walking] - np.arctan2(people.xy[1:, :, 1], people.xy[1:, :, 0])[walking]) > 0
    assert 0.2 < left_round.mean() < 0.8


def test_signals_against_a_clock():
    signals = Signals(np.array([[10.0, 12.0, 0.0]]), np.array([4.0]))
    for time in np.arange(0.0, 90.0, 0.37):
        at = (time + 4.0) % (10.0 + 3.5 + 12.0 + 3.5)
        expected = 0 if at < 10.0 else -1 if at < 13.5 else 1 if at < 25.5 else -1
        assert signals.green_phase(time)[0] == expected


def test_the_phase_that_was_green_shows_yellow_before_all_are_red():
    signals = Signals(np.array([[10.0, 12.0]]), np.array([0.0]))
    expected = {
        9.9: [GREEN, RED],
        10.1: [YELLOW, RED],
        12.4: [YELLOW, RED],
        12.6: [RED, RED],
        13.4: [RED, RED],
        13.6: [RED, GREEN],
        25.6: [RED, YELLOW],
        28.9: [RED, RED],
        29.1: [GREEN, RED],
    }
    for time, states in expected.items():
        assert signals.shown(time)[0].tolist() == states, time
    np.testing.assert_array_equal(signals.shown(np.array(list(expected)))[:, 0], list(expected.values()))


def test_networks_without_lights_have_no_red():
    table = build_lane_table(crossroads("yield"))
    signals = draw_signals(np.random.default_rng(0), table)
    assert not signals.red(table, 3.0).any()


def test_more_bicycles_than_a_lane_takes_enter_at_its_capacity():
    network = build_road_network(np.random.default_rng([0]), RoadConfig(bike=1.0))
    crowded = replace(EMPTY, bicycles_per_metre=0.5)
    traffic = simulate_traffic(np.random.default_rng([7]), network, crowded, frames=10, rate_hz=RATE)
    assert (traffic.category == RoadUser.BICYCLE).any()
