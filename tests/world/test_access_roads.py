"""Access roads, and where a map cuts lanes: the map changes, what vehicles drive on does not."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.world.road_networks import heading
from tflane_jax.errors import UserError
from tflane_jax.geometry import wrap_angle
from tflane_jax.limits import check_settings
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.presets import REAL_LIKE
from tflane_jax.world.roads.area import road_rings
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.cuts import SHORTEST, cut_lane, part_of, set_back
from tflane_jax.world.roads.networks import RoadNetwork, build_road_network
from tflane_jax.world.simulate import simulate

KINDS = (SceneKind.ROAD, SceneKind.T_JUNCTION, SceneKind.FOUR_WAY, SceneKind.STAGGERED, SceneKind.ROUNDABOUT)
LINES = ("centerline", "left", "right")


def networks(kind: SceneKind, count: int = 4, **changes) -> list[RoadNetwork]:
    config = RoadConfig(kinds=((kind, 1.0),), **changes)
    return [build_road_network(np.random.default_rng([23, seed]), config) for seed in range(count)]


def with_access(kind: SceneKind, **changes) -> list[RoadNetwork]:
    return networks(kind, **({"driveways": 3.0, "access_share": 1.0, "cut_setback": 1.0} | changes))


def length(lane: LaneSegment) -> float:
    return float(np.linalg.norm(np.diff(lane.centerline, axis=0), axis=-1).sum())


def entries(segments: dict[int, LaneSegment]) -> dict[int, list[int]]:
    found: dict[int, list[int]] = {i: [] for i in segments}
    for i, lane in segments.items():
        for j in lane.successors:
            found[j].append(i)
    return found


def access_lanes(net: RoadNetwork) -> tuple[list[LaneSegment], list[LaneSegment]]:
    """Lanes of the map that traffic does not know, and that lead nowhere or from nowhere into turns."""
    before = entries(net.map.segments)
    new = [lane for i, lane in net.map.segments.items() if i not in net.traffic_lanes]
    outs = [lane for lane in new if lane.successors and not before[lane.id]]
    outs = [lane for lane in outs if turn(net.map.segments[lane.successors[0]]) < -np.pi / 4]
    return [lane for lane in new if not lane.successors], outs


def turn(lane: LaneSegment) -> float:
    return float(wrap_angle(heading(lane.centerline, 1) - heading(lane.centerline, 0)))


@pytest.mark.parametrize("kind", KINDS)
def test_vehicles_drive_on_the_lanes_that_they_had(kind):
    for plain, net in zip(networks(kind), with_access(kind), strict=True):
        assert list(net.traffic_lanes) == list(plain.map.segments)
        for i, lane in plain.map.segments.items():
            other = net.traffic_lanes[i]
            assert other.successors == lane.successors
            assert [getattr(other, name).tobytes() for name in LINES] == [
                getattr(lane, name).tobytes() for name in LINES
            ]
        assert net.ego_routes == plain.ego_routes
        assert net.speed_limit == plain.speed_limit
        assert len(net.map.segments) > len(plain.map.segments)
        assert set(net.map.segments) >= set(net.traffic_lanes)


@pytest.mark.parametrize("kind", KINDS)
def test_successors_start_where_lanes_end(kind):
    for net in with_access(kind, cut_setback=3.0):
        segments = net.map.segments
        for number, lane in segments.items():
            assert lane.id == number
            assert len(lane.centerline) == len(lane.left) == len(lane.right) >= 2
            assert np.linalg.norm(np.diff(lane.centerline, axis=0), axis=-1).min() > 1e-6
            for j in lane.successors:
                for name in LINES:
                    np.testing.assert_allclose(getattr(lane, name)[-1], getattr(segments[j], name)[0], atol=1e-9)
                kink = wrap_angle(heading(lane.centerline, 1) - heading(segments[j].centerline, 0))
                assert abs(kink) < np.deg2rad(12.0)


@pytest.mark.parametrize("kind", KINDS[:4])
def test_an_access_road_has_a_lane_in_and_one_out(kind):
    """All may turn right; left turns come in pairs, and none leads over a median."""
    roads, left_turns = 0, 0
    for net in with_access(kind, median=0.5, turn_restriction=0.3):
        segments, before = net.map.segments, entries(net.map.segments)
        ins, outs = access_lanes(net)
        assert len(ins) == len(outs)
        islands = [shapely.Polygon(r) for r in road_rings(net.map.road_boundaries)]
        road = max(islands, key=lambda ring: ring.area)
        islands.remove(road)
        for entry, leaving in zip(ins, outs, strict=True):
            turns_in, turns_out = before[entry.id], leaving.successors
            assert len(turns_in) == len(turns_out) in (1, 2)
            for number in (*turns_in, *turns_out):
                way = segments[number]
                assert way.is_intersection
                assert (way.left_type, way.right_type) == (LineType.NONE, LineType.NONE)
                line = shapely.LineString(way.centerline[:, :2])
                assert road.contains(line)
                assert not any(line.intersects(island) for island in islands)
            for turns in (turns_in, turns_out):
                assert turn(segments[turns[0]]) < -np.pi / 4
                assert all(turn(segments[k]) > np.pi / 4 for k in turns[1:])
            # Traffic keeps to the right: seen from the road, vehicles go in on the right.
            aside = leaving.centerline[-1] - entry.centerline[0]
            into = entry.centerline[-1] - entry.centerline[0]
            assert into[0] * aside[1] - into[1] * aside[0] > 0
            roads += 1
            left_turns += len(turns_in) - 1
    assert roads > 8
    assert left_turns > 0


@pytest.mark.parametrize("kind", KINDS)
def test_lanes_across_are_cut_side_by_side_and_stay_long_enough(kind):
    """No lane runs past the mouth of an access road: what lies beside it is inside the junction."""
    cuts = 0
    for net in with_access(kind, cut_setback=0.0):
        segments = net.map.segments
        for number, lane in segments.items():
            through = [segments[j] for j in lane.successors if number not in net.traffic_lanes]
            for middle in through:
                if middle.is_intersection and middle.successors and middle.successors[0] in net.traffic_lanes:
                    cuts += 1
                    assert length(lane) > SHORTEST - 1e-6
                    assert length(segments[middle.successors[0]]) > SHORTEST - 1e-6
        for lane in segments.values():
            assert lane.vehicle or lane.is_intersection or lane.id in net.traffic_lanes  # bike lanes are not cut
    assert cuts > 10


def test_no_share_and_no_setback_draw_nothing():
    for kind in KINDS:
        for net in networks(kind, driveways=3.0):
            assert net.lanes is None
            assert net.traffic_lanes is net.map.segments


def test_signs_and_lights_govern_lanes_of_the_map_that_lead_to_their_junction():
    elements = 0
    for net in with_access(SceneKind.FOUR_WAY, signals=1.0, cut_setback=3.0):
        for element in net.map.elements:
            for number in element.lanes:
                lane = net.map.segments[number]
                elements += 1
                if not lane.is_intersection:
                    assert any(net.map.segments[j].is_intersection for j in lane.successors)
                    assert np.linalg.norm(lane.centerline[-1, :2] - element.position[:2]) < 80.0
    assert elements


def straight(number: int, at: float, reach: tuple[float, float], successors: tuple[int, ...], *, inside: bool):
    x = np.linspace(*reach, 9)
    lines = [np.stack([x, np.full(9, at + side), np.zeros(9)], -1) for side in (0.0, 1.75, -1.75)]
    return LaneSegment(number, *lines, LineType.DASHED, LineType.SOLID, is_intersection=inside, successors=successors)


def junction() -> dict[int, LaneSegment]:
    """Two lanes side by side, each through a junction of 20 m."""
    lanes = [
        [
            straight(10 * k + 1, 3.5 * k, (0.0, 40.0), (10 * k + 2,), inside=False),
            straight(10 * k + 2, 3.5 * k, (40.0, 60.0), (10 * k + 3,), inside=True),
            straight(10 * k + 3, 3.5 * k, (60.0, 100.0), (), inside=False),
        ]
        for k in range(2)
    ]
    return {lane.id: lane for lane in itertools.chain(*lanes)}


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), mean=st.floats(0.01, 200.0))
def test_connectors_grow_by_what_lanes_lose(seed, mean):
    before = junction()
    after = set_back(np.random.default_rng(seed), before, mean)
    assert list(after) == list(before)
    for k in (0, 10):
        path = [after[k + i] for i in (1, 2, 3)]
        assert sum(map(length, path)) == pytest.approx(100.0)
        assert min(length(path[0]), length(path[2])) >= SHORTEST - 1e-6
        assert length(path[1]) >= 20.0 - 1e-6
        for a, b in itertools.pairwise(path):
            for name in LINES:
                np.testing.assert_allclose(getattr(a, name)[-1], getattr(b, name)[0], atol=1e-9)
    # Side by side: cut at the same place, before and behind.
    for i in (1, 3):
        assert after[i].centerline[-1, 0] == pytest.approx(after[10 + i].centerline[-1, 0])
        assert after[i].centerline[0, 0] == pytest.approx(after[10 + i].centerline[0, 0])


def test_lanes_that_cannot_lose_anything_stay():
    short = {i: replace(lane, **_scaled(lane, 0.05)) for i, lane in junction().items()}
    after = set_back(np.random.default_rng(0), short, 5.0)
    assert all(after[i] is short[i] for i in short)
    assert set_back(np.random.default_rng(0), {}, 5.0) == {}


def _scaled(lane: LaneSegment, factor: float) -> dict[str, np.ndarray]:
    return {name: getattr(lane, name) * [factor, 1.0, 1.0] for name in LINES}


@settings(max_examples=40)
@given(start=st.floats(1.0, 19.0), size=st.floats(0.5, 20.0))
def test_the_pieces_of_a_cut_lane_are_the_lane(start, size):
    found = {7: straight(7, 0.0, (0.0, 40.0), (9,), inside=False), 8: straight(8, 0.0, (-9.0, 0.0), (7,), inside=False)}
    found[9] = straight(9, 0.0, (40.0, 50.0), (), inside=False)
    first = cut_lane(found, itertools.count(100), 7, start, start + size)
    middle = found[found[first].successors[0]]
    assert found[8].successors == (first,)
    assert (middle.successors, found[7].successors) == ((7,), (9,))
    assert [found[first].is_intersection, middle.is_intersection, found[7].is_intersection] == [False, True, False]
    assert [length(found[first]), length(middle), length(found[7])] == pytest.approx([start, size, 40.0 - start - size])
    assert (middle.left_type, found[7].left_type) == (LineType.NONE, LineType.DASHED)


def test_a_part_of_a_bent_lane_ends_where_its_length_says():
    angle = np.linspace(0.0, 1.5, 20)
    arc = [np.stack([r * np.sin(angle), 30.0 - r * np.cos(angle), 0.1 * angle], -1) for r in (30.0, 28.2, 31.8)]
    lane = LaneSegment(1, *arc, LineType.NONE, LineType.NONE, is_intersection=False, successors=())
    part = part_of(lane, 5.0, 20.0)
    plane = np.linalg.norm(np.diff(part.centerline[:, :2], axis=0), axis=-1).sum()
    assert plane == pytest.approx(15.0, abs=1e-9)
    across = part.left - part.right
    assert np.linalg.norm(across, axis=-1) == pytest.approx(3.6, abs=0.01)


@pytest.mark.slow
def test_scenes_of_real_like_have_them_and_their_mirror_images_too():
    found = 0
    for scene in range(8):
        plain = simulate(scene, replace(REAL_LIKE, mirrored=0.0)).map
        other = simulate(scene, replace(REAL_LIKE, mirrored=1.0)).map
        assert list(other.segments) == list(plain.segments)
        for i, lane in plain.segments.items():
            np.testing.assert_array_equal(other.segments[i].centerline, lane.centerline * [1.0, -1.0, 1.0])
        before = entries(plain.segments)
        found += sum(not lane.successors and not before[i] for i, lane in plain.segments.items())
        found += sum(
            len(lane.successors) == 1 and plain.segments[lane.successors[0]].is_intersection and len(before[i]) == 0
            for i, lane in plain.segments.items()
        )
    assert found > 4, "a fifth of the driveways are access roads, each with a lane in and a lane out"


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"access_share": 1.5}, "access_share"),
        ({"access_width": (-1.0, 1.0)}, "access_width"),
        ({"access_rounding": (6.0, 2.0)}, "access_rounding"),
        ({"cut_setback": -1.0}, "cut_setback"),
        ({"cut_setback": float("nan")}, "cut_setback"),
    ],
)
def test_settings_out_of_range_are_refused(change, name):
    with pytest.raises(UserError, match=name):
        check_settings(RoadConfig(**change))
