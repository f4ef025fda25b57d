"""Lane geometry by station, speeds in curves, and where lanes conflict."""

import numpy as np
import pytest

from tests.world.crossroads import LIMIT, REACH, STOP, crossroads
from tflane_jax.world.traffic.lane_table import build_lane_table


@pytest.fixture(scope="module")
def table():
    return build_lane_table(crossroads("yield", turn="right"))


def row(table, number):
    return int(np.flatnonzero(table.ids == number)[0])


def test_places_on_a_straight_lane_and_beyond_its_ends(table):
    lane = np.full(4, row(table, 1))
    xy, heading = table.locate(lane, np.array([0.0, 33.3, REACH - STOP, -10.0]))
    np.testing.assert_allclose(xy, [[-REACH, 0], [-REACH + 33.3, 0], [-STOP, 0], [-REACH - 10, 0]], atol=1e-9)
    np.testing.assert_allclose(heading, 0.0, atol=1e-12)


def test_places_on_an_arc(table):
    lane = row(table, 7)
    assert table.length[lane] == pytest.approx(STOP * np.pi / 2, rel=1e-2)
    s = np.linspace(0.0, table.length[lane], 9)
    xy, heading = table.locate(np.full(9, lane), s)
    angle = np.pi - s / STOP
    np.testing.assert_allclose(xy, STOP * np.stack([1 + np.cos(angle), -1 + np.sin(angle)], -1), atol=0.15)
    np.testing.assert_allclose(heading, angle - np.pi / 2, atol=0.03)


def test_curves_are_driven_at_a_comfortable_speed_and_reached_by_braking(table):
    arc, straight = row(table, 7), row(table, 1)
    assert table.speed_at_start[arc] == pytest.approx(np.sqrt(2.2 * STOP), rel=0.1)
    own = table.first_vertex[straight]
    assert table.speed[own] == LIMIT
    assert table.turn[arc] == pytest.approx(np.pi / 2, abs=0.05)


def test_crossing_lanes_exclude_each_other_until_the_tail_is_clear(table):
    east, north = row(table, 2), row(table, 5)
    assert table.crosses[east, north]
    assert table.crosses[north, east]
    # The lanes cross in their middles, 8 m from the stop lines.
    assert STOP < table.clear_after[north, east] < STOP + 3.5
    assert not table.crosses[row(table, 1)].any()


def test_priority_traffic_does_not_stop_for_yielding_traffic(table):
    assert table.yields[row(table, 7), row(table, 2)]
    assert table.crosses[row(table, 7), row(table, 2)]
    assert table.is_gate[row(table, 7)]
    assert not table.is_gate[row(table, 3)]


def test_a_forking_lane_runs_beside_its_sibling_only_at_first(table):
    turn, straight = row(table, 7), row(table, 5)
    first, count = table.first_vertex[turn], round(table.length[turn] / table.step[turn]) + 1
    partners = table.beside[first : first + count]
    assert (partners[0] == straight).any()
    assert not (partners[-1] == straight).any()
    at = np.argwhere(partners[1] == straight)[0, 0]
    assert table.beside_station[first + 1, at] == pytest.approx(table.step[turn], abs=0.2)


def test_every_pair_on_different_arms_far_away_is_free(table):
    for number in (3, 6):
        lane = row(table, number)
        last = table.first_vertex[lane] + round(table.length[lane] / table.step[lane])
        assert (table.beside[last] == -1).all()
