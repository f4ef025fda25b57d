"""Car-following against a scalar IDM, stop lines, priority and pedestrians, on the hand-made crossroads."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.world.crossroads import LIMIT, REACH, STOP, crossroads
from tflane_jax.world.traffic.demand import _routes
from tflane_jax.world.traffic.driving import Convoy, _merging_leader, acceleration, crossings_busy, footing
from tflane_jax.world.traffic.lane_table import build_lane_table
from tflane_jax.world.traffic.pedestrians import Crossers, CrossingPlaces, crossing_places, draw_crossers

NOBODY = (np.zeros(0, np.intp), np.zeros(0))
EAST, NORTH = (0, 1, 2), (3, 4, 5)
TO_LINE = REACH - STOP


def convoy(table, ways, position, speed, half=2.25):
    n = len(ways)
    return Convoy(
        _routes(list(ways), table),
        np.full(n, half),
        np.ones(n),
        np.full(n, 30.0),
        np.full(n, 1.5),
        np.full(n, 1.2),
        np.asarray(position, float),
        np.asarray(speed, float),
    )


def chosen(table, cars, red=(), walked_over=NOBODY):
    barred = np.isin(table.ids, red)
    return acceleration(cars, footing(cars), table, barred, walked_over)


def idm(v, gap, dv, a=1.5, b=2.0, rest=2.0, headway=1.2):
    wish = rest + max(0.0, v * headway + v * dv / (2 * math.sqrt(a * b)))
    return a * (1 - (v / LIMIT) ** 4) - a * (wish / gap) ** 2


@pytest.fixture(scope="module")
def table():
    return build_lane_table(crossroads("signals"))


@pytest.fixture(scope="module")
def priority_table():
    return build_lane_table(crossroads("yield", turn="right"))


@pytest.mark.parametrize(("v", "gap", "leader"), [(8.0, 15.0, 8.0), (5.0, 30.0, 9.0), (11.0, 40.0, 6.0)])
def test_following_is_idm(table, v, gap, leader):
    # On the exit lane, where no stop line is ahead; lengths are 4.5 m.
    start = TO_LINE + 2 * STOP + 20.0
    cars = convoy(table, [EAST, EAST], [start, start + gap + 4.5], [v, leader])
    assert chosen(table, cars)[0] == pytest.approx(idm(v, gap, v - leader), rel=1e-9)


def test_a_leader_is_seen_across_segments_and_other_lanes_are_not(table):
    cars = convoy(table, [EAST, EAST, NORTH], [TO_LINE - 20.0, TO_LINE + 1.0, 20.0], [8.0, 8.0, 8.0])
    alone = convoy(table, [EAST], [TO_LINE - 20.0], [8.0])
    assert chosen(table, cars)[0] == pytest.approx(idm(8.0, 21.0 - 4.5, 0.0), rel=1e-9)
    assert chosen(table, alone)[0] == pytest.approx(idm(8.0, 1e9, 0.0), rel=1e-6)


def test_free_acceleration_vanishes_at_the_limit(table):
    assert chosen(table, convoy(table, [EAST], [20.0], [LIMIT]))[0] == pytest.approx(0.0, abs=1e-6)


def test_red_light_stops_and_green_does_not(table):
    cars = convoy(table, [EAST], [TO_LINE - 25.0], [10.0])
    assert chosen(table, cars, red=(2,))[0] < -1.0
    assert chosen(table, cars)[0] > 0.0


def test_a_driver_who_cannot_stop_any_more_goes_on(table):
    cars = convoy(table, [EAST], [TO_LINE - 2.25 - 3.0], [12.0])
    assert chosen(table, cars, red=(2,))[0] > -0.5


@pytest.mark.parametrize(("main", "waits"), [(TO_LINE - 15.0, True), (20.0, False), (TO_LINE + 2 * STOP + 30.0, False)])
def test_minor_traffic_lets_priority_traffic_pass(priority_table, main, waits):
    cars = convoy(priority_table, [EAST, NORTH], [main, TO_LINE - 12.0], [10.0, 5.0])
    assert (chosen(priority_table, cars)[1] < 0.0) == waits


def test_nobody_enters_while_crossing_traffic_is_inside(table):
    cars = convoy(table, [EAST, NORTH], [TO_LINE + 6.0, TO_LINE - 10.0], [1.0, 5.0])
    assert chosen(table, cars)[1] < 0.0


def test_a_forking_lane_blocks_its_neighbour(priority_table):
    # The leader turns off and has its middle 3 m into the connector; the follower goes straight on.
    cars = convoy(priority_table, [(3, 4, 5), (3, 6, 2)], [TO_LINE - 10.0, TO_LINE + 3.0], [8.0, 0.5])
    assert chosen(priority_table, cars)[0] < -2.0


def test_a_merging_driver_follows_the_next_vehicle_on_the_main_lane(priority_table):
    """Both lanes end at one point, so the gap is what is left to it from the front, less what is left from the rear."""
    main, merging = 1, 6  # segment 2, and the bend, segment 7
    merges_into = np.where(np.arange(len(priority_table.ids)) == merging, main, -1)
    table = replace(priority_table, merges_into=merges_into)
    cars = convoy(table, [(3, merging, 2), EAST, EAST], TO_LINE + np.array([2.0, 12.0, 4.0]), [5.0, 7.0, 6.0])
    gap, speed = _merging_leader(cars, footing(cars), table)
    left, left_to_leader = table.length[merging] - 2.0 - 2.25, 2 * STOP - 12.0 + 2.25
    np.testing.assert_allclose(gap, [left - left_to_leader, np.inf, np.inf])
    assert speed[0] == 7.0
    first = replace(cars, position=TO_LINE + np.array([11.0, 12.0, 4.0]))
    assert _merging_leader(first, footing(first), table)[0][0] == np.inf


def test_drivers_stop_for_someone_on_a_crossing(table):
    places = crossing_places(crossroads().walk_across, table)
    np.testing.assert_allclose(places.station, 4.0, atol=0.1)
    np.testing.assert_allclose(places.along, 5.0, atol=1e-9)
    cars = convoy(table, [EAST], [TO_LINE + 6.0], [6.0])
    assert chosen(table, cars, walked_over=(places.segment, places.station))[0] < -0.5
    cars = convoy(table, [EAST], [TO_LINE - 20.0], [6.0])
    assert crossings_busy(cars, footing(cars), places, 1).tolist() == [False]
    near = convoy(table, [EAST], [TO_LINE + 2 * STOP - 6.0], [6.0])
    assert crossings_busy(near, footing(near), places, 1).tolist() == [True]


@pytest.mark.parametrize(("gap", "stops"), [(8.0, True), (6.5, False)])
def test_drivers_brake_twice_as_hard_for_a_pedestrian_as_for_a_red_light(table, gap, stops):
    """From 10 m/s, 7 m/s^2 takes 7.1 m to a place 1.2 m before the crossing; 3.5 m/s^2 takes 14.3 m."""
    place = np.array([2]), np.array([20.0])
    cars = convoy(table, [EAST], [TO_LINE + 2 * STOP + 20.0 - 1.2 - gap - 2.25], [10.0])
    assert (chosen(table, cars, walked_over=place)[0] < -3.5) == stops
    before_the_line = convoy(table, [EAST], [TO_LINE - gap - 2.25], [10.0])
    assert chosen(table, before_the_line, red=(2,))[0] > 0.0


@pytest.mark.parametrize("forward", [True, False])
def test_a_pedestrian_is_in_the_way_from_4_metres_before_a_lane_to_2_behind_it(forward):
    """In both directions of the crossing, which is 10 m long and has the lane in its middle."""
    places = CrossingPlaces(np.array([0]), np.array([0.0]), np.array([0]), np.array([5.0]))

    def in_the_way(progress, along=places):
        walker = Crossers(
            start=np.zeros((1, 2)),
            ahead=np.array([[1.0, 0.0]]),
            length=np.array([10.0]),
            crossing=np.array([0]),
            forward=np.array([forward]),
            pace=np.ones(1),
            progress=np.array([progress]),
            side=np.zeros(1),
        )
        return walker.in_the_way(along).tolist()

    seen = [in_the_way(progress)[0] for progress in (-0.5, 0.4, 1.0, 5.0, 7.0, 7.5, 10.5)]
    assert seen == [False, False, True, True, True, False, False]
    two = CrossingPlaces(np.zeros(2, int), np.zeros(2), np.zeros(2, int), np.array([1.0, 9.0]))
    assert in_the_way(6.0, two) == ([False, True] if forward else [True, False])


def test_pedestrians_wait_at_the_kerb_of_a_busy_crossing():
    walks = crossroads().walk_across
    people = draw_crossers(np.random.default_rng(0), walks, start=0.0, stop=60.0, per_minute=20.0)
    assert len(people.pace) > 5
    for _ in range(700):
        people.advance(0.1, np.array([True]))
    assert (people.progress <= 0.0).all()
    for _ in range(20):
        people.advance(0.1, np.array([False]))
    assert (people.progress > 0.0).all()


def test_a_platoon_behind_a_red_light_never_touches(table):
    gaps = np.array([0.0, 30.0, 60.0, 85.0])
    cars = convoy(table, [EAST] * 4, gaps + 20.0, [11.0, 10.0, 11.0, 9.0])
    for _ in range(400):
        speed = np.maximum(cars.speed + 0.1 * chosen(table, cars, red=(2,)), 0.0)
        cars.position = cars.position + 0.05 * (cars.speed + speed)
        cars.speed = speed
    assert (cars.speed < 0.2).all()
    assert (np.diff(cars.position) > 4.5 + 1.0).all()
    assert TO_LINE - 4.0 < cars.position[-1] + 2.25 <= TO_LINE
