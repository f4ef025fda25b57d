"""From detected markers to lanes in the ego frame."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, invert_pose, yaw_pose
from tflane_jax.markers.observe import frame_before, observe
from tflane_jax.markers.simulation import SimulatedMarkers
from tflane_jax.markers.store import MarkerStore, StoredMarker, UnknownMarkerWarning, store_of
from tflane_jax.scene.logs import PlacedMarkers
from tflane_jax.world.roads.markers import marker_pose

RANGE = PerceptionRange()
SIZES = {"markers": 3, "lanes": 6, "points": 5}
# Two lanes along x that join a third, which bends out of the range and comes back.
LANES = lane_map(
    segment(1, [(-60, 0), (20, 0)], [3]),
    segment(2, [(-60, 4), (0, 4), (20, 0)], [3]),
    segment(3, [(20, 0), (30, 0), (30, 40), (35, 40), (35, 0)]),
).segments
PLACED = PlacedMarkers(
    np.array([5, 8, 2]), marker_pose(np.array([[20, -5, 3], [40, -5, 3], [-10, -5, 3.0]]), np.full(3, np.pi))
)
STORE = store_of(LANES, PLACED, radius=100.0)


def detect(pose, ids=(5, 8, 2), *, score=None, valid=None):
    """Return detections; the rows that are not valid hold garbage."""
    pose, ids = np.array(pose, float), np.array(ids)
    valid = np.ones(len(ids), bool) if valid is None else np.array(valid)
    pose[~valid] = np.nan
    score = np.ones(len(ids)) if score is None else np.where(valid, score, np.nan)
    return SimulatedMarkers(ids, pose, score, np.zeros(len(ids), bool), valid)


def rows_of(markers):
    return {int(i): row for row, i in enumerate(markers.marker_id) if markers.valid[row]}


def test_lanes_are_placed_by_the_pose():
    """The vehicle at the map's origin, and one that is elsewhere and sees the same."""
    here = observe(detect(PLACED.pose), STORE, RANGE, **SIZES).markers
    here.validate()
    assert here.marker_id.tolist() == [2, 5, 8]  # nearest first
    assert here.valid.all()
    assert here.lanes.dtype == np.float32
    np.testing.assert_allclose(here.pose, PLACED.pose[[2, 0, 1]], atol=1e-5)
    for row in range(3):
        assert here.lane_valid[row].tolist() == [True] * 4 + [False] * 2
        lines = here.lanes[row]
        np.testing.assert_allclose(lines[0], [(x, 0, 0) for x in np.linspace(-50, 20, 5)], atol=1e-4)
        np.testing.assert_allclose(lines[1, [0, -1]], [(-50, 4, 0), (20, 0, 0)], atol=1e-4)
        np.testing.assert_allclose(lines[2, [0, -1]], [(20, 0, 0), (30, 25, 0)], atol=1e-4)
        np.testing.assert_allclose(lines[3, [0, -1]], [(35, 25, 0), (35, 0, 0)], atol=1e-4)
        assert np.argwhere(here.successor[row]).tolist() == [[0, 2], [1, 2]]
    ego = yaw_pose(*np.array([[700.0], [-40.0], [2.0]]))[0]
    there = observe(detect(ego @ PLACED.pose), STORE, RANGE, **SIZES).markers
    # Far away nothing is in range: the marker stays, without lanes.
    assert there.valid.all()
    assert not there.lane_valid.any()
    assert not there.successor.any()


def test_a_successor_needs_the_joint_in_range():
    shifted = observe(detect(yaw_pose(*np.array([[45.0], [0], [0]])) @ PLACED.pose), STORE, RANGE, **SIZES).markers
    assert shifted.lane_valid[0].sum() == 2  # lanes 1 and 2 join 3 at x = 65
    assert not shifted.successor.any()


def test_beyond_capacity_the_farthest_are_dropped():
    detected = detect(PLACED.pose)
    all_ = observe(detected, STORE, RANGE, **SIZES)
    assert (all_.markers_dropped, all_.lanes_dropped) == (0, 0)
    fewer = observe(detected, STORE, RANGE, markers=2, lanes=3, points=5)
    assert fewer.markers.marker_id.tolist() == [2, 5]
    assert (fewer.markers_dropped, fewer.lanes_dropped) == (1, 2)
    # Marker 2 stands at x = -10, and the piece of lane 3 that comes back is the farthest from it.
    np.testing.assert_array_equal(fewer.markers.lanes, all_.markers.lanes[:2, :3])
    np.testing.assert_array_equal(fewer.markers.successor, all_.markers.successor[:2, :3, :3])
    none = observe(detected, STORE, RANGE, markers=0, lanes=0, points=2)
    none.markers.validate()
    assert none.markers_dropped == 3


def test_distances_are_to_lanes_and_not_to_their_vertices():
    """A long lane past the marker, and a short one 20 m aside; stores of other origin may have so few points."""
    lanes = np.array([[[-40.0, 0, 0], [40, 0, 0]], [[-5, 20, 0], [5, 20, 0]]])
    store = MarkerStore({5: StoredMarker(5, np.eye(4), lanes, np.zeros((2, 2), bool))}, "survey")
    found = observe(detect(np.eye(4)[None], (5,)), store, RANGE, markers=1, lanes=1, points=5)
    np.testing.assert_allclose(found.markers.lanes[0, 0, :, 1], 0.0)


def test_beyond_capacity_the_lanes_nearest_to_the_marker_are_kept():
    """Not those nearest to the vehicle: it stands on the first, the marker beside the second."""
    lanes = np.array([[[-5.0, -15, 0], [5, -15, 0]], [[-5, 2, 0], [5, 2, 0]]])
    store = MarkerStore({5: StoredMarker(5, np.eye(4), lanes, np.zeros((2, 2), bool))}, "survey")
    pose = yaw_pose(*np.array([[0.0], [15.0], [0.0]]))
    found = observe(detect(pose, (5,)), store, RANGE, markers=1, lanes=1, points=5)
    np.testing.assert_allclose(found.markers.lanes[0, 0, :, 1], 17.0)


def test_padding_and_nothing_detected():
    padded = detect(PLACED.pose, valid=[True, False, True])
    unpadded = detect(PLACED.pose[[0, 2]], (5, 2))
    a, b = (observe(d, STORE, RANGE, **SIZES).markers for d in (padded, unpadded))
    for name in ("marker_id", "pose", "score", "residual", "lanes", "lane_valid", "successor", "valid"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    for detected in (detect(np.zeros((0, 4, 4)), ()), detect(PLACED.pose, valid=[False] * 3)):
        empty = observe(detected, STORE, RANGE, **SIZES).markers
        empty.validate()
        assert not empty.valid.any()
        assert np.isfinite(empty.lanes).all()
        np.testing.assert_array_equal(empty.pose, np.tile(np.eye(4, dtype=np.float32), (3, 1, 1)))


def test_unknown_ids_are_left_out_and_counted():
    with pytest.warns(UnknownMarkerWarning):
        observed = observe(detect(PLACED.pose, (5, 77, 2)), STORE, RANGE, **SIZES)
    assert (observed.unknown, observed.stale, observed.markers_dropped) == (1, 0, 0)
    assert observed.markers.marker_id[observed.markers.valid].tolist() == [2, 5]
    with pytest.warns(UnknownMarkerWarning):
        assert not observe(detect(PLACED.pose), MarkerStore({}), RANGE, **SIZES).markers.valid.any()


def test_the_better_of_two_detections_of_one_id_counts():
    poses = np.stack([PLACED.pose[0], PLACED.pose[1], PLACED.pose[0]])
    observed = observe(detect(poses, (5, 5, 5), score=[0.2, 0.9, 0.3]), STORE, RANGE, **SIZES).markers
    assert observed.valid.tolist() == [True, False, False]
    assert observed.score[0] == np.float32(0.9)
    np.testing.assert_allclose(observed.pose[0], PLACED.pose[1], atol=1e-5)


def test_the_residual_takes_out_the_vehicles_motion():
    now, before = (yaw_pose(*np.array(p)[:, None])[0] for p in ((3.0, 1.0, 0.2), (-4.0, 0.5, 0.1)))
    motion = invert_pose(now) @ before
    seen_now, seen_before = (detect(invert_pose(ego) @ PLACED.pose) for ego in (now, before))
    still = observe(seen_now, STORE, RANGE, previous=seen_before, now_from_previous=motion, **SIZES).markers
    np.testing.assert_allclose(still.residual, 0.0, atol=1e-5)
    # The pose that was seen before lay 3 m further left: so did every lane point.
    aside = seen_before.pose.copy()
    aside[0, :3, 3] += invert_pose(motion)[:3, :3] @ [0.0, 3.0, 0.0]
    moved = observe(
        seen_now, STORE, RANGE, previous=seen_before._replace(pose=aside), now_from_previous=motion, **SIZES
    ).markers
    rows = rows_of(moved)
    assert moved.residual[rows[5]] == pytest.approx(3.0, abs=1e-4)
    assert moved.residual[rows[8]] == pytest.approx(0.0, abs=1e-4)


def test_the_residual_of_a_turn_is_that_of_the_lane_points():
    pose = PLACED.pose[:1].copy()
    pose[0, :3, :3] = yaw_pose(*np.zeros((2, 1)), np.array([0.1]))[0, :3, :3] @ pose[0, :3, :3]
    markers = observe(
        detect(PLACED.pose[:1], (5,)), STORE, RANGE, previous=detect(pose, (5,)), now_from_previous=np.eye(4), **SIZES
    ).markers
    points = np.einsum("ij,lpj->lpi", PLACED.pose[0, :3, :3], STORE.markers[5].lanes)
    expected = np.hypot(points[..., 0], points[..., 1]).mean() * 2 * np.sin(0.05)
    assert markers.residual[0] == pytest.approx(expected, rel=1e-5)


def test_the_residual_of_a_first_sighting():
    detected, before = detect(PLACED.pose), detect(PLACED.pose, valid=[False, True, False])
    markers = observe(
        detected, STORE, RANGE, previous=before, now_from_previous=np.eye(4), first_residual=7.0, **SIZES
    ).markers
    rows = rows_of(markers)
    assert [markers.residual[rows[i]] for i in (5, 8, 2)] == [7.0, 0.0, 7.0]
    assert observe(detected, STORE, RANGE, **SIZES).markers.residual.tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="now_from_previous"):
        observe(detected, STORE, RANGE, previous=before, **SIZES)


def test_an_id_that_was_at_two_places_before_is_compared_with_both():
    """Whichever of the two boards is seen next, it may be the wrong one."""
    stands, copy = PLACED.pose[0], PLACED.pose[0].copy()
    copy[0, 3] -= 8.0
    twice = detect([stands, copy], (5, 5), score=[0.5, 0.9])
    for flags, of_stands, of_copy in (([True, True], 8.0, 8.0), ([False, False], 8.0, 0.0)):
        before = SimpleNamespace(**twice._asdict(), contradictory=np.array(flags))
        seen = [
            observe(detect([pose], (5,)), STORE, RANGE, previous=before, now_from_previous=np.eye(4), **SIZES)
            for pose in (stands, copy)
        ]
        found = [float(each.markers.residual[0]) for each in seen]
        np.testing.assert_allclose(found, [of_stands, of_copy], atol=1e-4)


def test_boards_without_lanes_take_no_place_of_one_that_has_them():
    """They are nearer, and the prior has room for two."""
    bare = {i: StoredMarker(i, np.eye(4), np.zeros((0, 2, 3)), np.zeros((0, 0), bool)) for i in (1, 4)}
    store = MarkerStore({**bare, 5: STORE.markers[5]}, "survey")
    poses = [yaw_pose(*np.array(place)[:, None])[0] for place in ((5.0, 0, 0), (6.0, 0, 0), (20.0, 0, 0))]
    found = observe(detect(poses, (1, 4, 5)), store, RANGE, **SIZES | {"markers": 2})
    assert found.outcomes == {5: "used", 1: "no lanes", 4: "dropped"}
    assert found.markers.marker_id.tolist() == [5, 1]
    assert found.markers.lane_valid[0].any()


def test_a_marker_without_lanes_has_the_residual_of_its_place():
    store = store_of({}, PLACED)
    before = detect(PLACED.pose)
    before.pose[:, :2, 3] += [3.0, 4.0]
    markers = observe(detect(PLACED.pose), store, RANGE, previous=before, now_from_previous=np.eye(4), **SIZES).markers
    np.testing.assert_allclose(markers.residual, 5.0, atol=1e-5)


@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(-np.pi, np.pi))
@settings(max_examples=40)
def test_lanes_stay_in_range_for_any_pose(x, y, yaw):
    move = yaw_pose(np.array([x]), np.array([y]), np.array([yaw]))
    markers = observe(detect(move @ PLACED.pose), STORE, RANGE, **SIZES).markers
    markers.validate()
    inside = markers.lanes[markers.lane_valid]
    assert np.isfinite(inside).all()
    assert RANGE.contains(inside).all()
    assert not (markers.successor & ~(markers.lane_valid[:, :, None] & markers.lane_valid[:, None])).any()
    for m, i, j in np.argwhere(markers.successor):
        np.testing.assert_allclose(markers.lanes[m, i, -1], markers.lanes[m, j, 0], atol=1e-4)


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(-np.pi, np.pi))
@settings(max_examples=40)
def test_lanes_move_with_the_frame_and_residuals_do_not(x, y, yaw):
    """The same detections from another place of the vehicle: nothing but the frame changes."""
    move, wide = yaw_pose(*np.array([[x], [y], [yaw]]))[0], PerceptionRange((-500, 500), (-500, 500))
    shift = yaw_pose(*np.array([[2.0], [0.5], [0.1]]))[0]

    def seen_from(ego):
        before, motion = detect(shift @ PLACED.pose), ego
        return observe(
            detect(ego @ PLACED.pose), STORE, wide, previous=before, now_from_previous=motion, **SIZES
        ).markers

    here, there = seen_from(np.eye(4)), seen_from(move)
    rows, others = rows_of(here), rows_of(there)
    for number in (5, 8, 2):
        a, b = rows[number], others[number]
        np.testing.assert_array_equal(here.lane_valid[a], there.lane_valid[b])
        np.testing.assert_array_equal(here.successor[a], there.successor[b])
        used = here.lane_valid[a]
        moved = here.lanes[a][used] @ move[:3, :3].T + move[:3, 3]
        np.testing.assert_allclose(there.lanes[b][used], moved, atol=1e-3)
        assert there.residual[b] == pytest.approx(here.residual[a], abs=1e-3)
        assert here.residual[a] > 0.1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_named(value):
    """Regression: it became a valid marker with lanes of NaN."""
    pose = PLACED.pose.copy()
    pose[1, 0, 3] = value
    with pytest.raises(UserError, match="the detected pose of marker 8 is not finite: mark such a row invalid"):
        observe(detect(pose), STORE, RANGE, **SIZES)
    used = observe(detect(pose, valid=[True, False, True]), STORE, RANGE, **SIZES)
    assert sorted(rows_of(used.markers)) == [2, 5]


@pytest.mark.parametrize(("now", "expected"), [(0.2, None), (0.7, 0), (1.0, 1), (1.25, 1), (1.26, None)])
def test_the_frame_before_is_the_interval_ago_up_to_half_of_it(now, expected):
    assert frame_before([0, 500_000_000], int(now * 1e9), 0.5) == expected
    assert frame_before([], int(now * 1e9), 0.5) is None
