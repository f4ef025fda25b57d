"""Procedural road networks hold the promises that traffic, examples and pictures build on."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
import pytest

from tflane_jax.geometry.polylines import arc_length, resample
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.roads.networks import RoadConfig, RoadNetwork, SceneKind, build_road_network

CONFIG = RoadConfig()
SEEDS = range(20)


def _only(kind: SceneKind) -> RoadConfig:
    return RoadConfig(kinds=((kind, 1.0),))


@functools.cache
def network(seed: int, kind: SceneKind | None = None) -> RoadNetwork:
    return build_road_network(np.random.default_rng([11, seed]), CONFIG if kind is None else _only(kind))


def case_networks() -> list[RoadNetwork]:
    """Twenty draws of the usual mix, and two of each kind."""
    return [network(s) for s in SEEDS] + [network(s, kind) for kind in SceneKind for s in range(2)]


def heading(line: np.ndarray, end: int) -> float:
    a, b = (line[-2], line[-1]) if end else (line[0], line[1])
    return math.atan2(b[1] - a[1], b[0] - a[0])


def turn_between(a: LaneSegment, b: LaneSegment) -> float:
    difference = heading(b.centerline, 0) - heading(a.centerline, 1)
    return abs(math.remainder(difference, 2 * math.pi))


def inside_boxes(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(B, P) which points lie in which (x, y, length, width, yaw) boxes."""
    hits = []
    for x, y, length, width, yaw in boxes:
        c, s = math.cos(yaw), math.sin(yaw)
        local = (points - [x, y]) @ np.array([[c, -s], [s, c]])
        hits.append((np.abs(local[:, 0]) < length / 2) & (np.abs(local[:, 1]) < width / 2))
    return np.array(hits).reshape(len(boxes), len(points))


def crossings_of(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n - 1, m - 1) which steps of one polyline properly cross which steps of another."""

    def side(p, q, r):
        area = (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        return np.where(np.abs(area) > 1e-9, np.sign(area), 0.0)  # steps of one straight line touch, not cross

    if (a.min(0)[:2] > b.max(0)[:2]).any() or (b.min(0)[:2] > a.max(0)[:2]).any():
        return np.zeros((len(a) - 1, len(b) - 1), bool)
    p, q = a[:-1, None, :2], a[1:, None, :2]
    u, v = b[None, :-1, :2], b[None, 1:, :2]
    return (side(p, q, u) * side(p, q, v) < 0) & (side(u, v, p) * side(u, v, q) < 0)


def test_successors_exist_and_start_where_their_predecessor_ends():
    joints = 0
    for net in case_networks():
        segments = net.map.segments
        predecessors = {i: [j for j, s in segments.items() if i in s.successors] for i in segments}
        for i, segment in segments.items():
            assert segment.id == i
            assert len(set(segment.successors)) == len(segment.successors)
            for j in segment.successors:
                after = segments[j]
                np.testing.assert_array_equal(segment.centerline[-1], after.centerline[0])
                if len(segment.successors) == 1 and len(predecessors[j]) == 1:
                    np.testing.assert_array_equal(segment.left[-1], after.left[0])
                    np.testing.assert_array_equal(segment.right[-1], after.right[0])
                joints += 1
    assert joints > 500


def test_joints_are_smooth():
    worst = max(
        turn_between(s, net.map.segments[j])
        for net in case_networks()
        for s in net.map.segments.values()
        for j in s.successors
    )
    assert worst < math.radians(8.0)


def test_lanes_do_not_fold_or_kink():
    for net in case_networks():
        for segment in net.map.segments.values():
            for line in (segment.centerline, segment.left, segment.right):
                step = np.diff(line[:, :2], axis=0)
                length = np.linalg.norm(step, axis=-1)
                assert length.min() > 1e-4
                turn = np.abs((np.diff(np.arctan2(step[:, 1], step[:, 0])) + np.pi) % (2 * np.pi) - np.pi)
                assert turn.max(initial=0.0) < math.radians(35.0)


def test_lines_are_float64_on_the_plane_with_close_vertices():
    for net in case_networks():
        lines = [line for s in net.map.segments.values() for line in (s.centerline, s.left, s.right)]
        for line in lines + list(net.map.road_boundaries) + list(net.map.crossings):
            assert line.dtype == np.float64
            assert line.shape[1] == 3
            assert np.isfinite(line).all()
            assert (line[:, 2] == 0).all()
        assert max(np.linalg.norm(np.diff(line, axis=0), axis=-1).max() for line in lines) < 2.5


def test_boundaries_lie_on_their_sides_one_lane_width_apart():
    for net in case_networks():
        for segment in net.map.segments.values():
            left, right, middle = segment.left[:, :2], segment.right[:, :2], segment.centerline[:, :2]
            np.testing.assert_allclose(middle, (left + right) / 2, atol=1e-12)
            step = np.gradient(middle, axis=0)
            for line, sign in ((left, 1), (right, -1)):
                offset = line - middle
                assert (sign * (step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0]) > 0).all()
            width = np.linalg.norm(left - right, axis=-1)
            low, high = (2.85, 5.3) if segment.vehicle else CONFIG.bike_width
            assert low - 1e-6 <= width.min()
            assert width.max() <= high + 1e-6


def test_markings():
    for net in case_networks():
        for segment in net.map.segments.values():
            kinds = {LineType(segment.left_type), LineType(segment.right_type)}
            on_ring = net.kind is SceneKind.ROUNDABOUT and segment.left_type == LineType.SOLID
            if segment.is_intersection and not on_ring:
                assert kinds == {LineType.NONE}


def test_neighbours_agree_on_the_line_between_them():
    """A line that two lanes share has one marking; dashed only between lanes that drive the same way."""
    shared = 0
    for net in case_networks():
        by_left = {s.left.tobytes(): s for s in net.map.segments.values() if not s.is_intersection}
        for segment in net.map.segments.values():
            neighbour = by_left.get(segment.right.tobytes())
            if neighbour is not None and not segment.is_intersection:
                assert neighbour.left_type == segment.right_type
                shared += 1
            elif segment.right_type == LineType.DASHED:
                pytest.fail("a dashed line that no lane continues beside")
    assert shared > 100


def test_ego_routes_are_connected_and_long():
    for net in case_networks():
        assert net.ego_routes
        for route in net.ego_routes:
            segments = [net.map.segments[i] for i in route]
            assert all(b.id in a.successors for a, b in itertools.pairwise(segments))
            assert all(s.vehicle for s in segments)
            assert sum(arc_length(s.centerline)[-1] for s in segments) >= 120.0


def test_no_lane_ends_inside_the_perceived_window():
    for net in case_networks():
        segments = net.map.segments
        entered = {j for s in segments.values() for j in s.successors}
        loose = [s.centerline[0, :2] for i, s in segments.items() if s.vehicle and i not in entered]
        loose += [s.centerline[-1, :2] for s in segments.values() if s.vehicle and not s.successors]
        for route in net.ego_routes:
            for i in route:
                line = segments[i].centerline
                for k in range(0, len(line) - 1, 4):
                    step = line[k + 1, :2] - line[k, :2]
                    u = step / np.linalg.norm(step)
                    delta = np.array(loose) - line[k, :2]
                    ahead, beside = np.abs(delta @ u), np.abs(delta @ np.array([-u[1], u[0]]))
                    assert not ((ahead < 51.2) & (beside < 25.6)).any()


def test_kerbs_never_cross_a_vehicle_lane():
    for net in case_networks():
        for segment in net.map.segments.values():
            for boundary in net.map.road_boundaries:
                assert not crossings_of(segment.centerline, boundary).any()
                if segment.vehicle and not segment.is_intersection:
                    assert not crossings_of(segment.left, boundary).any()
                    assert not crossings_of(segment.right, boundary).any()


def test_kerbs_do_not_cross_themselves_or_each_other():
    for net in case_networks():
        kerbs = net.map.road_boundaries
        for k, a in enumerate(kerbs):
            for b in kerbs[: k + 1]:
                assert not crossings_of(a, b).any()


def test_pedestrians_walk_behind_the_kerbs():
    for net in case_networks():
        for walk in net.sidewalks:
            assert walk.shape[1] == 2
            for segment in net.map.segments.values():
                assert not crossings_of(walk, segment.centerline).any()


def test_a_kerb_follows_every_road_edge():
    """Between the rightmost vehicle lane and the kerb lie at most a bike lane, a parking strip and the gutter."""
    edges = 0
    for net in case_networks():
        kerbs = np.concatenate([resample(b, int(arc_length(b)[-1]) + 2)[:, :2] for b in net.map.road_boundaries])
        lanes = [s for s in net.map.segments.values() if s.vehicle and not s.is_intersection]
        shared = {s.left.tobytes() for s in lanes}
        for segment in lanes:
            if segment.right_type == LineType.SOLID and segment.right.tobytes() not in shared:
                middle = segment.right[len(segment.right) // 2, :2]
                assert 0.2 < np.linalg.norm(kerbs - middle, axis=-1).min() < 5.2
                edges += 1
    assert edges > 200


def test_parked_vehicles_stand_outside_the_lanes_along_the_kerb():
    slots = 0
    for net in case_networks():
        lanes = [s for s in net.map.segments.values() if s.vehicle]
        points = np.concatenate([s.centerline[:, :2] for s in lanes] + [s.right[:, :2] for s in lanes])
        boxes = np.column_stack(
            [net.parking[:, :2], np.full(len(net.parking), 4.6), np.full(len(net.parking), 1.9), net.parking[:, 2]]
        )
        assert net.parking.shape[1] == 3
        assert not inside_boxes(boxes, points).any()
        slots += len(boxes)
    assert slots > 100


def test_buildings_stand_off_the_road():
    standing = 0
    for net in case_networks():
        boxes = net.map.buildings
        grown = boxes + np.array([0, 0, 4.0, 4.0, 0])
        on_road = np.concatenate(
            [line[:, :2] for s in net.map.segments.values() for line in (s.centerline, s.left, s.right)]
            + [resample(b, int(arc_length(b)[-1]) + 2)[:, :2] for b in net.map.road_boundaries]
        )
        assert boxes.shape[1:] == (5,)
        assert not inside_boxes(grown, on_road).any()
        standing += len(boxes)
    assert standing > 300


def test_crossings_are_closed_quadrilaterals_that_cross_lanes_with_a_walk_each():
    rings = 0
    for net in case_networks():
        assert len(net.walk_across) == len(net.map.crossings)
        for ring, walk in zip(net.map.crossings, net.walk_across, strict=True):
            assert ring.shape == (5, 3)
            np.testing.assert_array_equal(ring[0], ring[-1])
            assert walk.shape == (2, 2)
            lines = [s.centerline for s in net.map.segments.values() if s.vehicle]
            assert any(crossings_of(line, walk).any() for line in lines)
            rings += 1
    assert rings > 40


def test_a_turning_lane_only_turns():
    """A lane that forks off before a junction leads there by one connector, to a turn."""
    pockets = 0
    for net in (network(s, SceneKind.FOUR_WAY) for s in range(8)):
        segments = net.map.segments
        for segment in segments.values():
            if segment.is_intersection or len(segment.successors) != 2:
                continue
            lanes = [segments[j] for j in segment.successors]
            if not any(LineType.NONE in (s.left_type, s.right_type) and not s.is_intersection for s in lanes):
                continue
            ends = []
            for lane in lanes:
                while len(lane.successors) == 1 and not segments[lane.successors[0]].is_intersection:
                    lane = segments[lane.successors[0]]
                ends.append([segments[j] for j in lane.successors])
            if all(c.is_intersection for end in ends for c in end):
                turns = [
                    [abs(math.remainder(heading(c.centerline, 1) - heading(c.centerline, 0), 2 * math.pi)) for c in e]
                    for e in ends
                ]
                assert any(len(t) == 1 and t[0] > math.radians(30) for t in turns)
                pockets += 1
    assert pockets > 3


def test_priorities_name_existing_segments_and_have_no_circles():
    ruled = 0
    for net in case_networks():
        segments = net.map.segments
        assert set(net.yield_to) <= set(segments)
        assert set(net.speed_limit) == set(segments)
        assert all(2.0 < v < 40.0 for v in net.speed_limit.values())
        done: set[int] = set()

        def visit(i: int, path: tuple[int, ...], net: RoadNetwork = net, done: set[int] = done) -> None:
            assert i not in path
            if i not in done:
                for j in net.yield_to.get(i, ()):
                    visit(j, (*path, i))
                done.add(i)

        for i, others in net.yield_to.items():
            assert set(others) <= set(segments)
            visit(i, ())
            ruled += 1
    assert ruled > 50


def test_crossing_traffic_is_ruled_by_priority_or_by_signals():
    """Of two connectors that cross, one yields, or signals keep them apart."""
    pairs = 0
    for net in (network(s, k) for k in (SceneKind.FOUR_WAY, SceneKind.T_JUNCTION) for s in range(5)):
        connectors = [s for s in net.map.segments.values() if s.is_intersection]
        for k, a in enumerate(connectors):
            for b in connectors[:k]:
                if not crossings_of(a.centerline, b.centerline).any():
                    continue
                if a.vehicle and b.vehicle and abs(heading(a.centerline, 0) - heading(b.centerline, 0)) < 0.02:
                    continue  # two lanes of one approach
                yields = b.id in net.yield_to.get(a.id, ()) or a.id in net.yield_to.get(b.id, ())
                apart = net.signal_phase.get(a.id) != net.signal_phase.get(b.id)
                assert yields or apart
                pairs += 1
    assert pairs > 20


def test_lights_hang_over_the_lanes_that_lead_to_signalised_connectors():
    lights = 0
    for net in case_networks():
        governed = set()
        for element in net.map.elements:
            assert element.position.shape == (3,)
            assert element.lanes
            assert set(element.lanes) <= set(net.map.segments)
            assert (element.category, element.attribute) in {(1, 1), (1, 2)} | {(2, a) for a in range(4, 13)}
            if element.category == 1:
                lights += 1
                governed |= set(element.lanes)
                lane = net.map.segments[element.lanes[0]]
                assert math.cos(element.yaw - heading(lane.centerline, 1)) < -0.99
        for i, segment in net.map.segments.items():
            if segment.vehicle and not segment.is_intersection:
                signalised = any(j in net.signal_phase for j in segment.successors)
                assert signalised == (i in governed)
        # At the start some lights are green and others red.
        states = {e.attribute for e in net.map.elements if e.category == 1}
        assert not states or states == {1, 2}
    assert lights > 10


def test_same_stream_same_bits():
    for seed in range(6):
        a = build_road_network(np.random.default_rng([11, seed]), CONFIG)
        b = network(seed)
        assert a.ego_routes == b.ego_routes
        assert a.yield_to == b.yield_to
        for i, segment in a.map.segments.items():
            assert segment.left.tobytes() == b.map.segments[i].left.tobytes()
        assert a.map.buildings.tobytes() == b.map.buildings.tobytes()
        assert a.parking.tobytes() == b.parking.tobytes()


def test_every_kind_of_scene_is_drawn():
    drawn = [build_road_network(np.random.default_rng([12, s]), CONFIG) for s in range(120)]
    assert {net.kind for net in drawn} == set(SceneKind)
    lane_counts = {sum(s.vehicle for s in net.map.segments.values()) for net in drawn}
    assert len(lane_counts) > 20


def merged_centerlines(net: RoadNetwork) -> list[np.ndarray]:
    """Chains over one-to-one joints, as the OpenLane-V2 ground truth forms them."""
    segments = net.map.segments
    before: dict[int, list[int]] = {i: [] for i in segments}
    for i, s in segments.items():
        for j in s.successors:
            before[j].append(i)

    def joined(i: int, j: int) -> bool:
        return len(segments[i].successors) == 1 and len(before[j]) == 1

    chains = []
    for i in segments:
        if len(before[i]) == 1 and joined(before[i][0], i):
            continue
        chain = [i]
        while segments[chain[-1]].successors and joined(chain[-1], segments[chain[-1]].successors[0]):
            chain.append(segments[chain[-1]].successors[0])
        chains.append(np.concatenate([segments[k].centerline[:, :2] for k in chain]))
    return chains


def test_windows_hold_a_fitting_number_of_centerlines():
    counts = []
    for seed in range(200):
        net = build_road_network(np.random.default_rng([13, seed]), CONFIG)
        chains = merged_centerlines(net)
        points = np.concatenate(chains)
        owner = np.repeat(np.arange(len(chains)), [len(c) for c in chains])
        route = net.ego_routes[seed % len(net.ego_routes)]
        path = np.concatenate([net.map.segments[i].centerline[:, :2] for i in route])
        for k in np.linspace(0, len(path) - 3, 6).astype(int):
            u = (path[k + 2] - path[k]) / np.linalg.norm(path[k + 2] - path[k])
            delta = points - path[k]
            inside = (np.abs(delta @ u) < 50.0) & (np.abs(delta @ np.array([-u[1], u[0]])) < 25.0)
            counts.append(len(np.unique(owner[inside])))
    assert 6 <= np.median(counts) <= 16
    assert max(counts) <= 44
    assert min(counts) >= 1
