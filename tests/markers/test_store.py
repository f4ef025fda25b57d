"""The on-board store of markers."""

import datetime
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.geometry import transform_points
from tflane_jax.markers.store import (
    MarkerStore,
    StaleMarkerWarning,
    StoredMarker,
    UnknownMarkerWarning,
    look_up,
    store_of,
)
from tflane_jax.scene.logs import PlacedMarkers
from tflane_jax.world.roads.markers import marker_pose

DAY = datetime.date(2025, 7, 11)


def placed(*places, ids=None):
    place = np.array(places, float).reshape(-1, 3)
    ids = np.arange(len(place)) if ids is None else np.array(ids)
    return PlacedMarkers(ids, marker_pose(place, np.full(len(place), 2.0)))


def in_map(marker: StoredMarker):
    return transform_points(marker.global_from_marker, marker.lanes)


def fork():
    """A lane along x that forks at x = 0; its left branch leaves the circle around the origin and comes back."""
    return lane_map(
        segment(1, [(-80, 0), (-40, 0), (0, 0)], [2, 3]),
        segment(2, [(0, 0), (60, 0)]),
        segment(3, [(0, 0), (0, 60), (10, 60), (10, 0)], [5]),
        segment(4, [(0, 200), (10, 200)]),
        segment(5, [(10, 0), (20, 0)]),
    ).segments


def test_lanes_within_the_radius_are_cut_at_the_circle():
    marker = store_of(fork(), placed((0, 0, 3)), radius=50.0, points=5).markers[0]
    assert marker.lanes.shape == (5, 5, 3)
    lines = in_map(marker)
    np.testing.assert_allclose(lines[0, :, 0], [-50.0, -37.5, -25.0, -12.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(lines[1, [0, -1], 0], [0.0, 50.0], atol=1e-9)
    back = np.sqrt(50.0**2 - 10.0**2)
    np.testing.assert_allclose(lines[2, [0, -1], 1], [0.0, 50.0], atol=1e-9)
    np.testing.assert_allclose(lines[3, [0, -1], 1], [back, 0.0], atol=1e-9)
    np.testing.assert_allclose(lines[..., 2], 0.0, atol=1e-9)
    # The lane that was cut in two is entered by its first piece and left by its last.
    assert np.argwhere(marker.successor).tolist() == [[0, 1], [0, 2], [3, 4]]


def test_lanes_are_in_the_frame_of_the_marker():
    """+z points out of the marker, +x to the right seen from the front, and the road lies below (-y)."""
    facing_x = PlacedMarkers(np.array([3]), marker_pose(np.array([[10.0, 5.0, 3.0]]), np.array([0.0])))
    lanes = lane_map(segment(1, [(12, 5), (30, 8)])).segments
    (line,) = store_of(lanes, facing_x, points=2).markers[3].lanes
    np.testing.assert_allclose(line, [[0.0, -3.0, 2.0], [3.0, -3.0, 20.0]], atol=1e-12)


@given(st.floats(5.0, 120.0), st.floats(-60.0, 60.0), st.floats(-30.0, 30.0))
@settings(max_examples=60)
def test_no_stored_point_lies_outside_the_circle(radius, x, y):
    marker = store_of(fork(), placed((x, y, 3)), radius=radius, points=9).markers[0]
    distance = np.linalg.norm(in_map(marker)[..., :2] - [x, y], axis=-1)
    assert (distance <= radius + 1e-6).all()
    for i, j in np.argwhere(marker.successor):
        np.testing.assert_allclose(marker.lanes[i, -1], marker.lanes[j, 0], atol=1e-9)


def test_empty_stores():
    assert store_of(fork(), placed()).markers == {}
    empty = store_of({}, placed((0, 0, 3))).markers[0]
    assert empty.lanes.shape[0] == 0
    assert empty.successor.shape == (0, 0)
    far = store_of(fork(), placed((1000, 0, 3))).markers[0]
    assert far.lanes.shape[0] == 0


def test_sizes_are_those_of_the_boards():
    assert store_of(fork(), placed((0, 0, 3), (9, 0, 3), ids=[7, 2])).sizes == {7: 1.0, 2: 1.0}
    assert MarkerStore({}).sizes == {}


def dated(number, surveyed=None, expires=None):
    return StoredMarker(number, np.eye(4), np.zeros((0, 2, 3)), np.zeros((0, 0), bool), 1.0, surveyed, expires)


def test_unknown_ids_give_no_prior_and_are_counted():
    store = MarkerStore({3: dated(3)}, "town.json")
    with pytest.warns(UnknownMarkerWarning, match=r"town\.json does not hold") as caught:
        looked = look_up(store, [9, 3, 4])
    assert len(caught) == 1
    assert looked.found == (None, store.markers[3], None)
    assert (looked.unknown, looked.stale) == (2, 0)
    # No warning if all ids are known; Python shows the warning once.
    look_up(store, [3])
    assert look_up(store, []).found == ()
    with warnings.catch_warnings(record=True) as shown:
        warnings.resetwarnings()
        for _ in range(3):
            look_up(store, [9])
    assert len(shown) == 1


def test_entries_out_of_date_give_no_prior():
    store = MarkerStore(
        {
            1: dated(1),
            2: dated(2, DAY),
            3: dated(3, DAY, DAY + datetime.timedelta(10)),
            4: dated(4, None, DAY),
        }
    )
    with pytest.warns(StaleMarkerWarning, match="survey them again"):
        looked = look_up(store, [1, 2, 3, 4], today=DAY)
    assert [m is not None for m in looked.found] == [True, True, True, False]
    assert (looked.unknown, looked.stale) == (0, 1)
    later = DAY + datetime.timedelta(10)
    with pytest.warns(StaleMarkerWarning):
        assert [m is not None for m in look_up(store, [1, 2, 3, 4], today=later).found] == [True, True, False, False]
    # A limit of age: an entry without a date of survey is too old.
    with pytest.warns(StaleMarkerWarning):
        aged = look_up(store, [1, 2, 3], today=DAY + datetime.timedelta(5), max_age_days=5)
    assert [m is not None for m in aged.found] == [False, True, True]
    with pytest.warns(StaleMarkerWarning):
        assert look_up(store, [2], today=DAY + datetime.timedelta(6), max_age_days=5).stale == 1
    assert look_up(store, [2], today=DAY, max_age_days=10**12).stale == 0
    assert look_up(store, [1, 2, 3, 4]).stale == 0
    with pytest.raises(ValueError, match="give today"):
        look_up(store, [1], max_age_days=5)
