"""Properties of procedural road networks that traffic, examples and pictures rely on."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import shapely

from tests.world.road_networks import CONFIG, WIDE, case_networks, changing_network, network, turn_between
from tflane_jax.geometry.polylines import arc_length
from tflane_jax.scene import LineType
from tflane_jax.world.roads.networks import RoadConfig, RoadNetwork, SceneKind, build_road_network


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
    wide = [changing_network(s) for s in range(8)]
    for net in case_networks():
        widest = WIDE[1] if any(net is one for one in wide) else 5.3
        for segment in net.map.segments.values():
            left, right, middle = segment.left[:, :2], segment.right[:, :2], segment.centerline[:, :2]
            np.testing.assert_allclose(middle, (left + right) / 2, atol=1e-12)
            step = np.gradient(middle, axis=0)
            for line, sign in ((left, 1), (right, -1)):
                offset = line - middle
                assert (sign * (step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0]) > 0).all()
            width = np.linalg.norm(left - right, axis=-1)
            low, high = (2.85, widest) if segment.vehicle else CONFIG.bike_width
            assert low - 1e-6 <= width.min()
            assert width.max() <= high + 1e-6


def test_markings():
    for net in case_networks():
        for segment in net.map.segments.values():
            kinds = {LineType(segment.left_type), LineType(segment.right_type)}
            on_ring = net.kind is SceneKind.ROUNDABOUT and segment.left_type == LineType.SOLID
            if segment.is_intersection and not on_ring:
                assert kinds == {LineType.NONE}


@pytest.mark.parametrize("kind", [SceneKind.ROAD, SceneKind.FOUR_WAY, SceneKind.ON_RAMP])
def test_streets_without_paint(kind):
    """Lanes of vehicles have no marking, bicycles keep their lines; geometry is that of the same streets with paint."""
    none = ((LineType.NONE, 1.0),)
    unpainted = {"inner_marking": none, "outer_marking": none, "divider_marking": none}
    configs = (RoadConfig(kinds=((kind, 1.0),), bike=1.0, **markings) for markings in ({}, unpainted))
    painted, bare = (build_road_network(np.random.default_rng(3), config).map.segments for config in configs)
    assert painted.keys() == bare.keys()
    for one, other in zip(painted.values(), bare.values(), strict=True):
        assert one.centerline.tobytes() == other.centerline.tobytes()
        types = LineType.NONE if other.vehicle or other.is_intersection else LineType.SOLID
        assert (other.left_type, other.right_type) == (types, types)
    assert any(s.left_type != LineType.NONE for s in painted.values() if s.vehicle)


def test_markings_are_drawn_for_each_street():
    """One street in four has no line at the kerb, the others have a solid one; lines between lanes are dashed."""
    config = RoadConfig(
        kinds=((SceneKind.ROAD, 1.0),), outer_marking=((LineType.NONE, 1.0), (LineType.SOLID, 3.0)), bike=0.0
    )
    bare = 0
    for seed in range(40):
        segments = build_road_network(np.random.default_rng([9, seed]), config).map.segments
        outer = {s.right_type for s in segments.values() if not any(_beside(s, other) for other in segments.values())}
        assert outer in ({LineType.NONE}, {LineType.SOLID})
        bare += outer == {LineType.NONE}
    assert 4 <= bare <= 18


@pytest.mark.parametrize(
    ("kind", "parking"),
    [(SceneKind.ROAD, 0.0), (SceneKind.ROAD, 1.0), (SceneKind.FOUR_WAY, 0.0), (SceneKind.EXIT_RAMP, 0.0)],
)
def test_lines_at_kerbs_and_medians_have_their_own_marking(kind, parking):
    """Sides of lanes at the road's edge are unpainted; all others have their lines, but for tapers."""
    at_edge, painted = [], []
    for seed in range(6):
        unpainted = ((LineType.NONE, 1.0),)
        config = RoadConfig(
            kinds=((kind, 1.0),), kerb_marking=unpainted, bike=0.0, parking=parking, gutter=(0.1, 0.2), median=1.0
        )
        found = build_road_network(np.random.default_rng([4, seed]), config).map
        edges = shapely.union_all([shapely.LineString(line[:, :2]) for line in found.road_boundaries])
        for lane in (s for s in found.segments.values() if not s.is_intersection):
            for side, marking in ((lane.left, lane.left_type), (lane.right, lane.right_type)):
                at_edge.append(np.median(shapely.distance(shapely.points(side[:, :2]), edges)) < 0.5)
                painted.append(marking != LineType.NONE)
    assert not np.any(np.array(at_edge) & painted)
    assert np.mean(np.array(painted)[~np.array(at_edge)]) > (0.999 if kind is SceneKind.ROAD else 0.8)
    assert np.sum(at_edge) > 6


def _beside(lane, other) -> bool:
    """Whether a lane's right line is the left line of another."""
    return other is not lane and np.array_equal(lane.right, other.left)


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
    assert {net.kind for net in drawn} == {kind for kind, _ in CONFIG.kinds}
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
