"""Recorded maps as worlds: lanes for traffic, right of way, roadside, and scenes on a crossroads drawn by hand."""

import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.small_logs import lane_map, segment
from tests.world.small_map import OUT, connector, crossroads, inward, outward, right_of
from tflane_jax.errors import UserError
from tflane_jax.geometry import transform_points
from tflane_jax.scene import RoadUser
from tflane_jax.world.presets import REAL_MAPS
from tflane_jax.world.roads.config import RoadConfig
from tflane_jax.world.roads.map_junctions import find_junctions, merging_lanes
from tflane_jax.world.roads.map_networks import build_map_network, prepare_roads
from tflane_jax.world.roads.map_roads import road_lines_of
from tflane_jax.world.roads.map_roadside import (
    clip_border,
    facing_lanes,
    kerbs_of,
    lane_points,
    parking_places,
    walking_lines,
)
from tflane_jax.world.roads.movements import LEFT, RIGHT, THROUGH
from tflane_jax.world.roads.road_map import RoadMap, traffic_lanes
from tflane_jax.world.simulate import Place, simulate

SHORT = replace(
    REAL_MAPS,
    traffic=replace(REAL_MAPS.traffic, ego_passes_s=3.0, early_s=40.0, variety=0.0, parked_share=0.0),
    duration_s=5.0,
    keyframes=2,
)
SEES = 50.0


def test_lanes_are_joined_up_to_forks_intersections_and_bike_lanes():
    lanes = traffic_lanes(
        lane_map(
            segment(1, [(0, 0), (10, 0)], [2]),
            segment(2, [(10, 0), (20, 0)], [3, 9]),
            segment(9, [(20, 0), (30, 5)], vehicle=False),
            segment(3, [(20, 0), (30, 0)], [4], is_intersection=True),
            segment(4, [(30, 0), (40, 0)], [5], is_intersection=True),
            segment(5, [(40, 0), (50, 0)], [6, 77]),
            segment(6, [(50, 0), (50.1, 0)]),
        ).segments
    )
    assert {i: lane.successors for i, lane in lanes.items()} == {1: (3,), 3: (5,), 5: (), 9: ()}
    np.testing.assert_array_equal(lanes[1].centerline[:, 0], [0, 10, 20])
    assert lanes[3].is_intersection
    assert not lanes[9].vehicle


def test_a_closed_loop_of_lanes_stays_a_loop():
    loop = lane_map(segment(1, [(0, 0), (9, 0)], [2]), segment(2, [(9, 0), (9, 9), (0, 0)], [1]))
    lanes = traffic_lanes(loop.segments)
    assert list(lanes) == [1]
    assert lanes[1].successors == (1,)


@pytest.fixture(scope="module")
def junction():
    segments = crossroads(split=0.5).map.segments
    (found,) = find_junctions(traffic_lanes(segments), segments)
    return found


def test_a_crossroads_has_four_arms_and_three_turns_each(junction):
    turn = dict(zip(junction.connectors, junction.turn, strict=True))
    for arm in range(4):
        ways = [turn[connector(arm, (arm + k) % 4)] for k in (1, 2, 3)]
        assert ways == [RIGHT, THROUGH, LEFT] or ways == [LEFT, THROUGH, RIGHT]
        # The arm to the left of one's way is the next one clockwise around the middle.
        assert turn[connector(arm, (arm - 1) % 4)] == LEFT
    assert len(junction.minor) == 4
    assert sum(junction.minor) == 2
    assert junction.may_have_signals
    arms = dict(junction.incoming)
    assert set(arms) == {inward(k) for k in range(4)}
    assert junction.phase[arms[inward(0)]] == junction.phase[arms[inward(2)]] != junction.phase[arms[inward(1)]]
    assert junction.minor[arms[inward(0)]] == junction.minor[arms[inward(2)]]


@pytest.mark.parametrize("origin", [(4e5, 5.4e6), (-1e6, 0.0)])
def test_a_junction_is_the_same_in_global_coordinates(junction, origin):
    moved = {
        name: replace(one, centerline=one.centerline + np.array([*origin, 0.0]))
        for name, one in crossroads(split=0.5).map.segments.items()
    }
    (found,) = find_junctions(traffic_lanes(moved), moved)
    np.testing.assert_array_equal(found.meet, junction.meet)
    assert (found.turn, found.minor, found.phase) == (junction.turn, junction.minor, junction.phase)


@pytest.mark.parametrize("signals", [False, True])
def test_left_turns_give_way_to_oncoming_traffic_and_nobody_waits_in_a_circle(junction, signals):
    gives_way = junction.gives_way(signals)
    assert connector(2, 0) in gives_way[connector(0, 3)]  # west to east goes before east to south
    if signals:
        phase = dict(zip(junction.connectors, (junction.phase[a] for a in junction.arm), strict=True))
        assert all(phase[i] == phase[j] for i, others in gives_way.items() for j in others)
    waiting = {i: set(others) for i, others in gives_way.items()}
    while waiting:
        free = [i for i, others in waiting.items() if not others & set(waiting)]
        assert free, "a circle"
        waiting = {i: others for i, others in waiting.items() if i not in free}


def test_lights_hang_beyond_the_crossroads_and_face_the_traffic(junction):
    for (lane, arm), (x, y, yaw) in zip(junction.incoming, junction.lights, strict=True):
        out = OUT[lane - inward(0)]
        assert np.array([x, y]) @ out < -10.0
        np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], out, atol=1e-6)
        assert junction.signal_phases()[connector(lane - 10, (lane - 9) % 4)] == junction.phase[arm]


def test_the_longest_of_merging_lanes_goes_first():
    lanes = lane_map(
        segment(1, [(0, 0), (50, 0)], [3]), segment(2, [(30, 5), (50, 0)], [3]), segment(3, [(50, 0), (90, 0)])
    ).segments
    assert merging_lanes(traffic_lanes(lanes)) == {2: (1,)}


def test_borders_are_turned_so_that_the_road_is_on_their_left():
    points = lane_points(crossroads().map.segments.values())
    for line in facing_lanes([line[:, :2] for line in crossroads().map.road_boundaries], points):
        step, to_middle = line[1] - line[0], -line[0]
        assert step[0] * to_middle[1] - step[1] * to_middle[0] != 0.0
        beside = line[0] + 0.5 * step + np.array([-step[1], step[0]]) / np.linalg.norm(step)
        assert np.abs(beside).min() < 6.0  # a metre to the left is nearer to the axis of the road


def test_a_ring_that_leaves_the_box_becomes_pieces_in_its_direction():
    ring = np.array([[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]], float)
    (inside,) = clip_border([ring], np.array([-1.0, -1.0]), np.array([11.0, 11.0]))
    np.testing.assert_array_equal(inside, ring)
    (piece,) = clip_border([ring], np.array([-1.0, -1.0]), np.array([11.0, 5.0]))
    np.testing.assert_array_equal(piece, [[0, 0], [10, 0]])
    assert clip_border([ring], np.array([20.0, 20.0]), np.array([30.0, 30.0])) == []


def test_kerbs_leave_out_what_crosses_a_lane_and_islands():
    lanes = np.stack([np.linspace(0.0, 100.0, 80), np.zeros(80)], -1)
    around = np.array([[0, -5], [100, -5], [100, 5], [0, 5], [0, -5]], float)
    island = np.array([[50, 3], [50, 4], [58, 4], [58, 3], [50, 3]], float)  # the road is on its left
    kerbs = kerbs_of([around, island], lanes)
    assert len(kerbs) >= 2
    assert all(np.abs(kerb[:, 1]).min() > 1.0 for kerb in kerbs)
    assert not any(
        ((kerb[:, 0] > 49) & (kerb[:, 0] < 59) & (kerb[:, 1] < 4.5) & (kerb[:, 1] > 2)).all() for kerb in kerbs
    )


def test_nobody_walks_on_a_narrow_median_or_on_a_lane():
    # Two carriageways with a median of 2.5 m between them, and a wide block to the right of the upper one.
    lanes = np.concatenate([np.stack([np.linspace(0.0, 100.0, 80), np.full(80, y)], -1) for y in (-3.0, 3.0)])
    x = np.linspace(0.0, 100.0, 67)
    median = [np.stack([x, np.full(67, -1.25)], -1)[::-1], np.stack([x, np.full(67, 1.25)], -1)]
    block = np.stack([x, np.full(67, -5.0)], -1)
    (line,) = walking_lines([*median, block], 1.8, lanes)
    np.testing.assert_allclose(line[:, 1], -6.8)
    assert walking_lines([], 1.8, lanes) == []


def test_cars_park_where_there_is_room_and_where_they_were_seen():
    lanes = lane_map(segment(1, [(0, 0), (50, 0), (100, 0)])).segments
    kerb = np.stack([np.linspace(0.0, 100.0, 101), np.full(101, -1.75 - 2.4)], -1)
    crossing = np.array([[50, -4], [50, 4], [53, 4], [53, -4], [50, -4]], float)
    seen = np.array([[30.0, 8.0, 1.0], [60.0, 0.5, 0.0]])  # the second one stands on the lane
    slots = parking_places(lanes, [kerb], [crossing], seen)
    np.testing.assert_array_equal(slots[0], seen[0])
    beside = slots[1:]
    assert len(beside) > 5
    assert np.allclose(beside[:, 1], -1.75 - 2.4 + 1.2, atol=0.06)
    assert np.allclose(beside[:, 2], 0.0)
    assert np.abs(beside[:, 0] - 51.5).min() > 7.0
    assert np.diff(np.sort(beside[:, 0])).min() > 6.0
    assert len(parking_places(lanes, [kerb + np.array([0.0, 1.5])], [], seen[:0])) == 0


def test_a_place_where_two_vehicles_were_seen_one_after_the_other_holds_one():
    lanes = lane_map(segment(1, [(0, 0), (50, 0), (100, 0)])).segments
    seen = np.array([[30.0, 8.0, 1.0], [30.1, 8.0, 1.0 + np.pi], [33.0, 8.0, 1.0]])
    np.testing.assert_array_equal(parking_places(lanes, [], [], seen), seen[[0, 2]])


def test_each_road_is_one_line_that_ends_in_the_middle_of_the_crossroads():
    segments = crossroads(split=0.4).map.segments
    lanes = traffic_lanes(segments)
    roads = road_lines_of(lanes, find_junctions(lanes, segments))
    assert len(roads) == 4
    for road in roads:
        ends = np.linalg.norm(road[[0, -1]], axis=-1)
        assert ends.min() < 0.5
        assert ends.max() == pytest.approx(150.0, abs=1.0)
        assert np.abs(road).min(1).max() < 0.6  # on an axis


@functools.cache
def network(seed):
    return build_map_network(np.random.default_rng(seed), MAP, RoadConfig(), sees=SEES, leads_s=10.0)


MAP = crossroads(split=0.5)


@pytest.mark.parametrize("seed", range(4))
def test_the_ego_vehicle_drives_a_connected_route_past_a_place_where_the_map_is_complete(seed):
    found = network(seed)
    (way,), drive = found.ego_routes, found.drive
    assert all(b in found.lanes[a].successors for a, b in itertools.pairwise(way))
    line = np.concatenate([found.lanes[i].centerline[:, :2] for i in way])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))])
    place = np.array([np.interp(drive.aim, along, line[:, i]) for i in range(2)])
    assert drive.covers(place[None]).all()
    assert drive.top_speed >= 4.0
    assert not drive.covers(np.array([[0.0, 130.0]])).any()


def test_networks_differ_between_scenes_and_repeat_bit_by_bit():
    again = build_map_network(np.random.default_rng(1), MAP, RoadConfig(), sees=SEES, leads_s=10.0)
    np.testing.assert_array_equal(again.map.buildings, network(1).map.buildings)
    assert again.ego_routes == network(1).ego_routes
    assert again.yield_to == network(1).yield_to
    assert len({network(seed).ego_routes for seed in range(4)}) > 1
    limits = [set(network(seed).speed_limit.values()) for seed in range(4)]
    assert all(len(one) == 1 for one in limits)
    assert len(set.union(*limits)) == 4


def test_nothing_stands_on_the_lanes():
    points = prepare_roads(MAP, 1.8).points
    for x, y, length, width, yaw in network(0).map.buildings:
        at = (points - [x, y]) @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        assert ((np.abs(at[:, 0]) > 0.5 * length) | (np.abs(at[:, 1]) > 0.5 * width)).all()


@functools.cache
def scene(seed):
    return simulate(seed, SHORT, 20, Place(MAP, SEES))


def test_key_frames_see_complete_map_and_enough_history():
    for seed in range(3):
        log = scene(seed)
        places = np.stack([moment.global_from_ego[:2, 3] for moment in log.keyframes])
        apart = np.linalg.norm(places[:, None] - MAP.places, axis=-1).min(1)
        assert (apart <= MAP.complete - SEES).all()
        assert all(20 <= moment.track_frame < SHORT.frames for moment in log.keyframes)
        assert len(log.keyframes) == 2
        assert log.name == f"crossroads-{seed:09d}"


def test_no_key_frame_follows_the_end_of_the_route():
    longer = replace(SHORT, duration_s=60.0, traffic=replace(SHORT.traffic, vehicles_per_metre=0.0))
    for seed in range(4):
        log = simulate(seed, longer, 20, Place(MAP, SEES))
        xy = log.global_from_ego[:, :2, 3]
        assert np.hypot(*np.diff(xy, axis=0).T).max() < 2.0
        assert all(np.hypot(*(xy[moment.track_frame] - xy[-1])) > 0.0 for moment in log.keyframes)


def test_vehicles_stay_on_lanes_and_do_not_collide():
    lanes = lane_points(MAP.map.segments.values())
    moving = 0
    for seed in range(3):
        log = scene(seed)
        motor = np.flatnonzero(log.actors.category <= RoadUser.BUS)
        for frame in (20, 40):
            there = motor[log.actors.valid[frame, motor]]
            xy = transform_points(log.global_from_ego[frame], log.actors.position[frame, there])[:, :2]
            assert np.linalg.norm(xy[:, None] - lanes, axis=-1).min(1).max(initial=0.0) < 2.0
            gaps = np.linalg.norm(xy[:, None] - xy, axis=-1) + 99.0 * np.eye(len(xy))
            assert gaps.min(initial=99.0) > 2.0
            moving += len(there)
    assert moving > 10


def test_scenes_repeat_bit_by_bit_and_differ_between_numbers():
    again = simulate(1, SHORT, 20, Place(crossroads(split=0.5), SEES))
    np.testing.assert_array_equal(again.global_from_ego, scene(1).global_from_ego)
    np.testing.assert_array_equal(again.tracks.position, scene(1).tracks.position)
    assert not np.array_equal(scene(0).global_from_ego, scene(1).global_from_ego)


def test_a_map_that_is_nowhere_complete_enough_is_refused():
    far = replace_places(crossroads(), np.array([[0.0, 149.0]]))
    with pytest.raises(UserError, match=r"crossroads is too small a map: .* 400 m of it"):
        simulate(0, SHORT, 20, Place(far, 400.0))


def replace_places(road_map, places):
    return RoadMap(road_map.name, road_map.source, road_map.map, places, road_map.complete)


def test_arms_are_named_by_where_they_lead():
    np.testing.assert_array_equal(right_of(OUT[1]), OUT[0])
    assert outward(3) in MAP.map.segments[connector(0, 3)].successors
