"""Five-leg and staggered junctions, turns onto any lane, driveways and car parks."""

from __future__ import annotations

import collections
import itertools
import math

import numpy as np
import pytest
import shapely

from tests.world.road_networks import CONFIG, heading, turn_between
from tflane_jax.errors import UserError
from tflane_jax.geometry import wrap_angle
from tflane_jax.limits import check_settings
from tflane_jax.world.roads.area import road_rings
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.lane_network import LaneEnd
from tflane_jax.world.roads.movements import LEFT, RIGHT, Approach, plan_movements
from tflane_jax.world.roads.networks import RoadNetwork, build_road_network

NEW = (SceneKind.FIVE_LEGS, SceneKind.STAGGERED)


def networks(kind: SceneKind, count: int, **settings) -> list[RoadNetwork]:
    config = RoadConfig(kinds=((kind, 1.0),), **settings)
    return [build_road_network(np.random.default_rng([21, seed]), config) for seed in range(count)]


def connectors(net: RoadNetwork):
    return {i: s for i, s in net.map.segments.items() if s.is_intersection}


def drivable(net: RoadNetwork) -> shapely.Polygon:
    """The area inside the outer kerbs."""
    return max((shapely.Polygon(ring) for ring in road_rings(net.map.road_boundaries)), key=lambda ring: ring.area)


def exits(net: RoadNetwork) -> dict[float, set[float]]:
    """Directions (degrees) in which arms lead in -> those in which their connectors lead out."""
    seen: list[float] = []

    def one_of(angle: float) -> float:
        known = [a for a in seen if abs(math.remainder(a - angle, 360.0)) < 15.0]
        seen.extend([] if known else [angle])
        return known[0] if known else angle

    found: dict[float, set[float]] = {}
    for s in connectors(net).values():
        if s.vehicle:
            ends = [one_of(math.degrees(heading(s.centerline, end))) for end in (0, 1)]
            found.setdefault(ends[0], set()).add(ends[1])
    return found


@pytest.mark.parametrize("kind", NEW)
def test_every_connector_joins_two_lanes_and_every_lane_is_reached(kind):
    for net in networks(kind, 8, wide_turns=0.5):
        segments, entered = net.map.segments, {j for s in net.map.segments.values() for j in s.successors}
        for i, s in connectors(net).items():
            before = [j for j, t in segments.items() if i in t.successors]
            assert len(before) == len(s.successors) == 1
            assert not segments[before[0]].is_intersection
            assert not segments[s.successors[0]].is_intersection
            assert s.vehicle == segments[before[0]].vehicle
        border = CONFIG.reach - 45.0
        for i, s in segments.items():
            # A lane is entered unless it starts at the border of the map, and goes on unless it ends there.
            if s.vehicle:
                assert i in entered or np.hypot(*s.centerline[0, :2]) > border
                assert s.successors or np.hypot(*s.centerline[-1, :2]) > border


@pytest.mark.parametrize("kind", NEW)
def test_connectors_can_be_driven(kind):
    """They join smoothly, turn by less than a third of a circle a time, and no tighter than a car can."""
    for net in networks(kind, 8, wide_turns=0.5):
        segments = net.map.segments
        for i, s in connectors(net).items():
            assert turn_between(s, segments[s.successors[0]]) < math.radians(8.0)
            step = np.diff(s.centerline[:, :2], axis=0)
            turn = wrap_angle(np.diff(np.arctan2(step[:, 1], step[:, 0])))
            length = np.linalg.norm(step, axis=-1)
            # Over any 3 m: the inner wheels of a car turn on a radius of 3.5 m or more.
            along = np.concatenate([[0.0], np.cumsum(length)])
            total = np.concatenate([[0.0], np.cumsum(turn)])
            middle = 0.5 * (along[1:] + along[:-1])
            spread = np.interp(middle + 1.5, middle, total) - np.interp(middle - 1.5, middle, total)
            assert np.abs(spread).max() < 3.0 / 3.5
            assert abs(total[-1]) < math.radians(140.0)
            assert 2.0 < net.speed_limit[i] <= CONFIG.urban_speed[1]


def test_five_legs_lead_everywhere():
    for net in networks(SceneKind.FIVE_LEGS, 4, turn_restriction=0.0, one_way=0.0):
        found = exits(net)
        assert len(found) == 5
        for arm, ends in found.items():
            assert len(ends) == 4
            # Nobody turns back.
            assert all(abs(math.remainder(end - arm, 360.0)) < 135.0 for end in ends)
        signals = {phase for _, phase in net.signal_phase.values()}
        # The main road, the street across and the fifth arm.
        assert signals in (set(), {0, 1, 2})


def test_no_left_turn_holds_for_all_arms_on_the_left():
    free, banned = (networks(SceneKind.FIVE_LEGS, 4, turn_restriction=fraction, one_way=0.0) for fraction in (0.0, 1.0))
    for net in banned:
        for arm, ends in exits(net).items():
            assert all(math.remainder(end - arm, 360.0) < 50.0 for end in ends)
    assert sum(len(connectors(n)) for n in banned) < sum(len(connectors(n)) for n in free)


def test_staggered_side_streets_lie_apart_on_opposite_sides():
    one, two = 0, 0
    for stagger in (9.0, 15.0, 17.0, 30.0, 60.0):
        (net,) = networks(SceneKind.STAGGERED, 1, stagger=(stagger, stagger), one_way=0.0, turn_restriction=0.0)
        groups = shapely.union_all(
            [shapely.LineString(s.centerline[:, :2]).buffer(2.0) for s in connectors(net).values() if s.vehicle]
        )
        parts = int(shapely.get_num_geometries(groups))
        assert parts == (1 if stagger < 16.0 else 2)
        one, two = one + (parts == 1), two + (parts == 2)
        # Where the side streets meet the main road: ends of the shortest pieces of the roads' center lines.
        ends = np.array([road[0, :2] for road in net.map.roads[1 if parts == 2 else 0 :]])
        spread = max(np.linalg.norm(a - b) for a, b in itertools.combinations(ends, 2))
        assert spread == pytest.approx(stagger, abs=0.5) or (stagger < 60.0 and spread > stagger)
    assert (one, two) == (2, 3)


def test_a_turn_may_end_on_every_lane():
    def lane(segment: int, at: tuple[float, float], toward: float) -> LaneEnd:
        side = 1.5 * np.array([-math.sin(toward), math.cos(toward)])
        return LaneEnd(segment, np.array(at) + side, np.array(at) - side, toward, vehicle=True)

    def arm(number: int, angle: float) -> Approach:
        out, right = np.array([math.cos(angle), math.sin(angle)]), np.array([math.sin(angle), -math.cos(angle)])
        inward = [lane(10 * number + k, tuple(12 * out - (1.5 + 3 * k) * right), angle + math.pi) for k in range(2)]
        outward = [lane(10 * number + 5 + k, tuple(12 * out + (1.5 + 3 * k) * right), angle) for k in range(2)]
        return Approach(angle, tuple(inward), tuple(outward), False, False, 10.0, np.zeros(2), np.zeros(2))

    arms = [arm(k, k * math.pi / 2) for k in range(4)]
    narrow, wide = plan_movements(arms), plan_movements(arms, "any lane")
    assert [m for m in wide if m in narrow] == narrow
    for turn, source in ((LEFT, 0), (RIGHT, 1)):
        ends = [m.sink.segment % 10 for m in wide if m.turn == turn and m.arm == 0]
        assert sorted(ends) == [5, 6]
        assert {m.source.segment for m in wide if m.turn == turn and m.arm == 0} == {source}
    assert len(wide) == len(narrow) + 8


@pytest.mark.parametrize("kind", [SceneKind.T_JUNCTION, SceneKind.FOUR_WAY, SceneKind.TWO_JUNCTIONS, *NEW])
def test_lanes_open_behind_an_intersection_and_close_before_it(kind):
    """There are more forks and merges between intersections than without: turning lanes fork off, too."""
    forks, merges = np.subtract(*(_forks_and_merges(kind, lane_changes) for lane_changes in (1.0, 0.0)))
    assert forks >= 6
    assert merges >= 6


def _forks_and_merges(kind: SceneKind, lane_changes: float) -> tuple[int, int]:
    """Count lanes of six networks that go on as two, and that continue two, away from intersections."""
    forks, merges = 0, 0
    for seed in range(6):
        config = RoadConfig(kinds=((kind, 1.0),), lane_changes=lane_changes, reach=190.0)
        segments = build_road_network(np.random.default_rng([5, seed]), config).map.segments
        entries = collections.Counter(j for s in segments.values() for j in s.successors)
        for number, lane in segments.items():
            if lane.is_intersection or not lane.vehicle:
                continue
            following = [segments[j] for j in lane.successors]
            forks += len(following) == 2 and not any(s.is_intersection for s in following)
            before = [s for s in segments.values() if number in s.successors]
            merges += entries[number] == 2 and not any(s.is_intersection for s in before)
    return forks, merges


@pytest.mark.parametrize("kind", [SceneKind.ROAD, SceneKind.T_JUNCTION, SceneKind.FIVE_LEGS, SceneKind.ROUNDABOUT])
def test_driveways_open_the_edge_of_the_road(kind):
    """The drivable area grows, the kerbs stay simple lines, and no lane, sidewalk or building is in the way."""
    vehicles = 0
    for plain, open_ in zip(networks(kind, 4), networks(kind, 4, driveways=3.0), strict=True):
        assert [s.centerline.tobytes() for s in plain.map.segments.values()] == [
            s.centerline.tobytes() for s in open_.map.segments.values()
        ]
        before, after = (drivable(net) for net in (plain, open_))
        assert after.is_valid
        assert len(plain.map.road_boundaries) == len(open_.map.road_boundaries)
        grown = after.difference(before)
        added = [p for p in open_.parking if p.tolist() not in plain.parking.tolist()]
        for x, y, yaw in added:
            box = shapely.affinity.rotate(
                shapely.box(x - 2.5, y - 1.0, x + 2.5, y + 1.0), yaw, (x, y), use_radians=True
            )
            assert grown.contains(box)
        for x, y, length, width, yaw in open_.map.buildings:
            house = shapely.box(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
            assert shapely.affinity.rotate(house, yaw, (x, y), use_radians=True).distance(after) > 1.0
        assert len(open_.parking) >= len(plain.parking) - 3 * len(added)
        assert [w.tobytes() for w in open_.sidewalks] == [w.tobytes() for w in plain.sidewalks]
        vehicles += len(added)
    assert vehicles > 8


def test_no_driveways_on_fast_roads():
    for plain, open_ in zip(
        networks(SceneKind.EXIT_RAMP, 3), networks(SceneKind.EXIT_RAMP, 3, driveways=3.0), strict=True
    ):
        assert [b.tobytes() for b in plain.map.road_boundaries] == [b.tobytes() for b in open_.map.road_boundaries]


@pytest.mark.parametrize("density", [0.0, 0.01, 50.0])
def test_no_driveway_one_and_more_than_fit(density):
    for net in networks(SceneKind.STAGGERED, 2, driveways=density):
        rings = [np.unique(line, axis=0) for line in net.map.road_boundaries]
        assert all(len(ring) > 2 for ring in rings)
        assert all(shapely.LineString(line[:, :2]).is_simple for line in net.map.road_boundaries)


def box_of(place, length=5.0, width=2.0):
    x, y, yaw = place
    box = shapely.box(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
    return shapely.affinity.rotate(box, yaw, (x, y), use_radians=True)


@pytest.mark.parametrize("kind", [SceneKind.ROAD, SceneKind.T_JUNCTION, SceneKind.FIVE_LEGS, SceneKind.ROUNDABOUT])
@pytest.mark.parametrize("driveways", [0.0, 3.0])
def test_car_parks_stand_off_the_road(kind, driveways):
    """Roads are as without; places are clear of roads, driveways, sidewalks, houses and one another."""
    vehicles = 0
    for plain, other in zip(
        networks(kind, 4, driveways=driveways), networks(kind, 4, driveways=driveways, car_parks=2.0), strict=True
    ):
        assert [b.tobytes() for b in plain.map.road_boundaries] == [b.tobytes() for b in other.map.road_boundaries]
        assert [s.centerline.tobytes() for s in plain.map.segments.values()] == [
            s.centerline.tobytes() for s in other.map.segments.values()
        ]
        assert other.parking[: len(plain.parking)].tolist() == plain.parking.tolist()
        boxes = [box_of(place) for place in other.parking[len(plain.parking) :]]
        houses = [box_of((x, y, yaw), length, width) for x, y, length, width, yaw in other.map.buildings]
        used = [drivable(other), *houses, *(shapely.LineString(walk) for walk in other.sidewalks)]
        assert all(box.distance(thing) > 0.5 for box in boxes for thing in used)
        assert all(a.distance(b) > 0.3 for i, a in enumerate(boxes) for b in boxes[:i])
        vehicles += len(boxes)
    assert vehicles > 40


def test_no_car_parks_on_fast_roads():
    for net in networks(SceneKind.EXIT_RAMP, 3, car_parks=5.0):
        assert not len(net.parking)


@pytest.mark.parametrize("density", [0.001, 50.0])
def test_few_car_parks_and_more_than_fit(density):
    for net in networks(SceneKind.STAGGERED, 2, car_parks=density, parking=0.0):
        boxes = [box_of(place) for place in net.parking]
        assert all(a.distance(b) > 0.3 for i, a in enumerate(boxes) for b in boxes[:i])


def test_least_lanes_of_main_roads():
    for kind in (SceneKind.FIVE_LEGS, SceneKind.T_JUNCTION, SceneKind.TWO_JUNCTIONS):
        for net in networks(kind, 3, least_junction_lanes=2, bike=0.0, one_way=0.0):
            arms = [s for s in net.map.segments.values() if any(j in connectors(net) for j in s.successors)]
            assert len(arms) >= 5


@pytest.mark.parametrize(
    ("settings", "setting"),
    [
        ({"least_junction_lanes": 4}, "least_junction_lanes"),
        ({"least_junction_lanes": 0}, "least_junction_lanes"),
        ({"junction_distance": (40.0, 80.0)}, "junction_distance"),
        ({"wide_turns": 1.5}, "wide_turns"),
        ({"driveways": -1.0}, "driveways"),
        ({"car_parks": -1.0}, "car_parks"),
        ({"stagger": (30.0, 20.0)}, "stagger"),
    ],
)
def test_impossible_settings_are_named(settings, setting):
    with pytest.raises(UserError, match=setting):
        check_settings(RoadConfig(**settings))
