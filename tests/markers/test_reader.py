"""From images of a drive to the prior: the reader equals the composition of its parts."""

import datetime
import warnings
from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.small_logs import lane_map, segment
from tests.markers.test_detection import AHEAD, photo, pose, views
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, relative_pose, yaw_pose
from tflane_jax.markers.detection import detect
from tflane_jax.markers.image_search import DetectorConfig, find_markers
from tflane_jax.markers.observe import observe
from tflane_jax.markers.reader import MarkerReader, ReaderConfig
from tflane_jax.markers.store import MarkerStore, StaleMarkerWarning, UnknownMarkerWarning, store_of
from tflane_jax.scene.logs import PlacedMarkers

pytest.importorskip("cv2")

LANES = lane_map(segment(1, [(-60, -2), (20, -2)], [2]), segment(2, [(20, -2), (60, -2)])).segments
BOARDS = {3: pose(20.0, -5.0, 2.5), 8: pose(24.0, 4.0, 2.5, 10.0)}
HALF = PlacedMarkers(np.array([3, 8]), np.stack(list(BOARDS.values())))
STORE = store_of(LANES, HALF)
SECOND = 10**9


def ego(x):
    return yaw_pose(np.array([x]), np.zeros(1), np.zeros(1))[0]


def seen_from(x, boards=None):
    """Return the images of a vehicle at (x, 0)."""
    boards = BOARDS if boards is None else boards
    here = {number: relative_pose(ego(x), place[None])[0] for number, place in boards.items()}
    return views((AHEAD, photo(AHEAD, here)))


def test_a_drive_is_the_composition_of_its_parts():
    reader, config = MarkerReader(STORE), ReaderConfig()
    frames = [(0.0, 0), (2.0, SECOND // 4), (4.0, SECOND // 2), (8.0, SECOND)]
    readings = [reader.read(seen_from(x), time, ego(x)) for x, time in frames]
    detected = [detect(seen_from(x), config.detector, STORE.sizes) for x, _ in frames]
    for number, before in ((0, None), (1, 0), (2, 0), (3, 2)):
        expected = observe(
            detected[number],
            STORE,
            config.range,
            markers=2,
            lanes=48,
            points=11,
            previous=None if before is None else detected[before],
            now_from_previous=None if before is None else relative_pose(ego(frames[number][0]), ego(frames[before][0])),
        )
        found = readings[number].observed
        assert found.markers.valid.tolist() == [True, True]
        for name in ("marker_id", "pose", "residual", "lanes", "lane_valid", "successor"):
            np.testing.assert_array_equal(getattr(found.markers, name), getattr(expected.markers, name), name)
        assert found.outcomes == {3: "used", 8: "used"}
    # The lanes lie where the map has them.
    last = readings[3].observed.markers
    np.testing.assert_allclose(last.lanes[last.lane_valid][:, :, 1], -2.0, atol=0.4)  # 60 m away
    assert (last.residual < 0.3).all()


def test_what_was_found_before_is_not_searched_again():
    searched = [find_markers(np.asarray(seen_from(0.0).image[0]), DetectorConfig())]
    blind = seen_from(0.0, {})
    found = MarkerReader(STORE).read(blind, 0, ego(0.0), searched)
    assert sorted(found.detected.marker_id[found.detected.valid].tolist()) == [3, 8]
    assert not MarkerReader(STORE).read(blind, 0, ego(0.0)).detected.valid.any()


def test_the_size_of_the_store_counts():
    half = MarkerStore({3: replace(STORE.markers[3], size=0.5)})
    found = MarkerReader(half).read(seen_from(0.0, {3: BOARDS[3]}), 0, ego(0.0))
    whole = MarkerReader(STORE).read(seen_from(0.0, {3: BOARDS[3]}), 0, ego(0.0))
    height = invert_pose(AHEAD.camera_from_ego)[2, 3]
    np.testing.assert_allclose(
        found.detected.pose[0, :3, 3] - [0.0, 0.0, height],
        0.5 * (whole.detected.pose[0, :3, 3] - [0.0, 0.0, height]),
        atol=1e-3,
    )


def test_what_became_of_each_board():
    day = datetime.date(2026, 7, 1)
    old = store_of(LANES, HALF, expires=day).markers[8]
    store = MarkerStore({3: STORE.markers[3], 8: old})
    boards = {**BOARDS, 40: pose(18.0, 0.5, 3.0)}
    reader = MarkerReader(store, ReaderConfig(today=day))
    with pytest.warns(UnknownMarkerWarning), pytest.warns(StaleMarkerWarning):
        observed = reader.read(seen_from(0.0, boards), 0, ego(0.0)).observed
    assert observed.outcomes == {3: "used", 8: "stale", 40: "unknown"}
    assert (observed.unknown, observed.stale, observed.contradictory) == (1, 1, 0)
    # Two boards with the id 3: neither is known to be the surveyed one.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        twice = MarkerReader(STORE).read(_twice(), 0, ego(0.0)).observed
    assert twice.outcomes == {3: "contradictory"}
    assert twice.contradictory == 1
    assert not twice.markers.valid.any()


def _twice():
    left, right = seen_from(0.0, {3: pose(15.0, 3.0, 2.0)}), seen_from(0.0, {3: pose(20.0, -5.0, 2.5)})
    image = left.image.copy()
    image[:, :, 480:] = right.image[:, :, 480:]
    return left.replace(image=image)


def test_too_many_boards_and_frames_out_of_order():
    reader = MarkerReader(STORE, ReaderConfig(markers=1))
    assert reader.read(seen_from(0.0), 5, ego(0.0)).observed.outcomes == {3: "used", 8: "dropped"}
    for time in (5, 4):
        with pytest.raises(UserError, match="put frames in order"):
            reader.read(seen_from(0.0), time, ego(0.0))


@pytest.mark.parametrize(("interval", "residual"), [(None, 1.0), (0.5, 2.0)])
def test_the_residual_compares_with_the_frame_that_training_compared_with(interval, residual):
    """The vehicle claims to stand, but a board comes nearer by 1 m every quarter of a second."""
    reader = MarkerReader(STORE, ReaderConfig(residual_interval=interval))
    for number in range(3):
        nearer = BOARDS[3].copy()
        nearer[0, 3] -= number
        found = reader.read(seen_from(0.0, {3: nearer}), number * SECOND // 4, ego(0.0)).observed.markers
    assert found.residual[0] == pytest.approx(residual, abs=0.25)
