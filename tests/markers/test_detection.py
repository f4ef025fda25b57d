"""Detection in rendered images: poses, scores, and independence of padding."""

from dataclasses import replace

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.markers.corner_refinement import refine_corners
from tflane_jax.markers.detection import detect, detection_score
from tflane_jax.markers.image_search import DetectorConfig, find_markers
from tflane_jax.markers.square_pose import marker_outline
from tflane_jax.scene import CameraViews
from tflane_jax.scene.marker_patterns import (
    MarkerFamily,
    board_cells,
    board_size,
    cells_across,
    correctable_bits,
    marker_cells,
    marker_count,
)
from tflane_jax.world.cameras.pictures import paint_picture
from tflane_jax.world.render.camera import PinholeCamera, camera_pose

cv2 = pytest.importorskip("cv2")

ARUCO, APRILTAG = MarkerFamily.ARUCO_5X5_100, MarkerFamily.APRILTAG_36H11
INTRINSICS = np.array([[900.0, 0.0, 480.0], [0.0, 900.0, 270.0], [0.0, 0.0, 1.0]])
AHEAD = PinholeCamera(960, 540, INTRINSICS, camera_pose(1.5, 0.0))
# A second one a metre to the left and turned to the right.
ASIDE = replace(
    AHEAD,
    camera_from_ego=camera_pose(1.5, 0.0, np.deg2rad(-8.0))
    @ np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, -1.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]),
)


def pose(x, y, z, turn=0.0):
    """Return the pose of an upright marker that faces against x, turned by `turn` (degrees)."""
    turn = np.deg2rad(turn)
    face, up = np.array([-np.cos(turn), -np.sin(turn), 0.0]), np.array([0.0, 0.0, 1.0])
    result = np.eye(4)
    result[:3] = np.stack([np.cross(up, face), up, face, [x, y, z]], -1)
    return result


def photo(camera, places, family=ARUCO, cells=None, noise=3.0):
    """Return what a camera sees of boards {id: ego_from_marker}."""
    rng = np.random.default_rng(5)
    image = np.full((camera.height, camera.width, 3), 110, np.uint8)
    half = 0.5 * board_size(family, 1.0)
    square = half * np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
    for marker_id, place in places.items():
        corners = square @ place[:3, :3].T + place[:3, 3]
        shown = board_cells(family, marker_id) if cells is None else np.pad(cells, 1, constant_values=True)
        paint_picture(image, corners, shown.astype(float), camera, np.array([[25.0] * 3, [215.0] * 3]))
    image = cv2.GaussianBlur(image, (0, 0), 0.5)
    return np.clip(image + noise * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)


def views(*cameras_and_images):
    cameras, images = zip(*cameras_and_images, strict=True)
    return CameraViews(
        image=np.stack(images),
        size=np.array([[camera.width, camera.height] for camera in cameras], np.int32),
        intrinsics=np.stack([camera.intrinsics for camera in cameras]).astype(np.float32),
        camera_from_ego=np.stack([camera.camera_from_ego for camera in cameras]).astype(np.float32),
        valid=np.ones(len(cameras), bool),
    )


def degrees_between(a, b):
    return np.rad2deg(np.arccos(np.clip(0.5 * (np.trace(a[:3, :3].T @ b[:3, :3]) - 1.0), -1.0, 1.0)))


def test_an_image_too_large_to_enlarge_is_refused():
    with pytest.raises(UserError, match=r"an image of 4000 x 3000 pixels enlarged 5 times .* enlarge it less"):
        find_markers(np.zeros((3000, 4000), np.uint8), DetectorConfig(enlarge=5))
    with pytest.raises(UserError, match="enlarge is 17"):
        find_markers(np.zeros((9, 9), np.uint8), DetectorConfig(enlarge=17))


@pytest.mark.parametrize("family", MarkerFamily)
def test_patterns_have_a_black_border_and_differ(family):
    assert cells_across(family) == len(marker_cells(family, 0))
    last = marker_count(family) - 1
    cells = marker_cells(family, last)
    assert not np.concatenate([cells[0], cells[-1], cells[:, 0], cells[:, -1]]).any()
    board = board_cells(family, last)
    assert board[0].all()
    assert board[:, -1].all()
    np.testing.assert_array_equal(board[1:-1, 1:-1], cells)
    assert (cells != marker_cells(family, 0)).any()
    assert board_size(family, 2.0) == pytest.approx(2.0 * len(board) / len(cells))


@pytest.mark.parametrize("marker_id", [-1, 100])
def test_an_id_outside_the_family_is_refused(marker_id):
    with pytest.raises(UserError, match="0 to 99"):
        marker_cells(ARUCO, marker_id)


@pytest.mark.parametrize("family", [ARUCO, APRILTAG])
@pytest.mark.parametrize("place", [(6.0, -1.5, 2.4, 0.0), (12.0, 2.0, 3.0, 30.0), (20.0, -3.0, 3.0, -50.0)])
def test_a_marker_is_found_at_its_pose(family, place):
    truth = pose(*place)
    found = detect(views((AHEAD, photo(AHEAD, {42: truth}, family))), DetectorConfig(family=family, capacity=3))
    assert found.valid.tolist() == [True, False, False]
    assert found.marker_id[0] == 42
    assert np.linalg.norm(found.pose[0, :3, 3] - truth[:3, 3]) < 0.004 * place[0]
    assert degrees_between(found.pose[0], truth) < 1.0
    assert found.reprojection[0] < 0.2
    assert 0.8 < found.score[0] <= 1.0
    assert [column.dtype for column in found] == [np.int32, *[np.float32] * 4, np.int32, np.float32, bool, bool]


@pytest.mark.parametrize("corners", ["subpixel", "none"])
def test_corners_of_the_pattern_are_closer_than_those_found_alone(corners):
    truth = pose(18.0, -1.0, 2.5, 20.0)
    image = photo(AHEAD, {3: truth})
    expected = marker_outline(truth, 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
    best, other = (
        np.abs(find_markers(image, DetectorConfig(corners=how)).corners[0] - expected).max()
        for how in ("pattern", corners)
    )
    assert best < 0.1 < other < 1.5


def test_one_marker_in_two_cameras_is_one():
    truth = pose(9.0, -0.5, 2.0, 15.0)
    images = [photo(camera, {8: truth}) for camera in (AHEAD, ASIDE)]
    both = detect(views((AHEAD, images[0]), (ASIDE, images[1])))
    swapped = detect(views((ASIDE, images[1]), (AHEAD, images[0])))
    alone = [detect(views(pair)) for pair in ((AHEAD, images[0]), (ASIDE, images[1]))]
    scores = [float(found.score[0]) for found in alone]
    assert both.valid.sum() == 1
    assert both.camera[0] == np.argmax(scores)
    assert swapped.camera[0] == 1 - both.camera[0]
    assert both.score[0] == max(scores)
    np.testing.assert_array_equal(both.pose[0], swapped.pose[0])
    for found in alone:
        np.testing.assert_allclose(found.pose[0, :3, 3], truth[:3, 3], atol=0.04)


def test_padding_and_missing_views_change_nothing():
    shown, other = photo(AHEAD, {8: pose(9.0, -0.5, 2.0)}), photo(AHEAD, {9: pose(9.0, 0.5, 2.0)})
    plain = views((AHEAD, shown))
    image = np.full((2, 900, 1400, 3), 255, np.uint8)
    image[0, :540, :960] = shown
    image[0, 100:640, 200:1160][:, 760:] = other[:, 300:500]  # a marker in the padding
    image[1, :540, :960] = other
    padded = CameraViews(
        image=image,
        size=np.array([[960, 540], [960, 540]]),
        intrinsics=np.stack([plain.intrinsics[0], np.full((3, 3), np.nan)]),
        camera_from_ego=np.stack([plain.camera_from_ego[0], np.full((4, 4), np.nan)]),
        valid=np.array([True, False]),
    )
    for a, b in zip(detect(plain), detect(padded), strict=True):
        np.testing.assert_array_equal(a, b)
    assert set(find_markers(image[0]).marker_id) == {8, 9}


def test_the_best_scores_stay_when_capacity_is_short():
    places = {5: pose(30.0, 4.0, 2.5), 6: pose(8.0, -2.0, 2.5), 7: pose(18.0, 0.0, 2.0)}
    frame = views((AHEAD, photo(AHEAD, places)))
    whole, short = detect(frame), detect(frame, DetectorConfig(capacity=2))
    assert set(whole.marker_id[whole.valid]) == {5, 6, 7}
    assert (np.diff(whole.score[whole.valid]) <= 0.0).all()
    for a, b in zip(whole, short, strict=True):
        np.testing.assert_array_equal(a[:2], b)


@pytest.mark.parametrize("shape", [(0, 0, 3), (1, 1, 3), (7, 900, 3), (60, 60, 3), (60, 60)])
def test_images_without_markers_give_no_detections(shape):
    found = find_markers(np.full(shape, 90, np.uint8))
    assert [len(column) for column in found] == [0, 0, 0]
    assert found.corners.shape == (0, 4, 2)


def test_no_views_hold_no_markers():
    found = detect(
        CameraViews(
            np.zeros((0, 4, 4, 3), np.uint8),
            np.zeros((0, 2)),
            np.zeros((0, 3, 3)),
            np.zeros((0, 4, 4)),
            np.zeros(0, bool),
        )
    )
    assert not found.valid.any()


def test_a_damaged_cell_costs_score_and_not_the_id():
    truth = pose(8.0, 0.0, 2.0)
    cells = marker_cells(ARUCO, 11).copy()
    whole = find_markers(photo(AHEAD, {11: truth}))
    cells[3, 3] ^= True
    damaged = find_markers(photo(AHEAD, {11: truth}, cells=cells))
    assert (whole.marker_id.tolist(), whole.wrong_bits.tolist()) == ([11], [0])
    assert (damaged.marker_id.tolist(), damaged.wrong_bits.tolist()) == ([11], [1])


def test_score_is_the_stated_formula():
    square = 70.0 * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])  # 10 pixels a cell
    bits, size, fit = 1.0 - 2.0 / (correctable_bits(ARUCO) + 1.0), 1.0 - np.exp(-5.0), np.exp(-0.5 * 0.3**2)
    assert detection_score(square, 2, 0.3, ARUCO) == pytest.approx(bits * size * fit)
    assert detection_score(square, 9, 0.0, ARUCO) == 0.0
    assert detection_score(square, 0, 0.0, ARUCO) > detection_score(square / 4.0, 0, 0.0, ARUCO) > 0.0


def test_refinement_corrects_moved_corners_and_stays_without_a_pattern():
    truth = pose(12.0, 0.3, 2.0, 25.0)
    grey = photo(AHEAD, {21: truth}).mean(-1).astype(np.uint8)
    expected = marker_outline(truth, 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
    guess = expected + np.array([(1.5, -1.0), (-1.2, 0.8), (0.5, 1.4), (-1.0, -1.0)])
    cells = marker_cells(ARUCO, 21)
    assert np.abs(refine_corners(grey, guess, cells) - expected).max() < 0.1
    np.testing.assert_array_equal(refine_corners(np.full_like(grey, 90), guess, cells), guess)
    noise = np.random.default_rng(0).integers(0, 255, grey.shape).astype(np.uint8)
    assert np.abs(refine_corners(noise, guess, cells) - guess).max() < 0.6 * 10.5  # cells, pixels of a cell


def test_the_surveyed_size_scales_the_distance():
    """A board of half a metre at 6 m looks like one of a metre at 12 m."""
    truth, image = pose(6.0, -0.5, 1.9), photo(AHEAD, {42: pose(12.0, -1.0, 2.3), 7: pose(9.0, 3.0, 2.0)})
    found = detect(views((AHEAD, image)), sizes={42: 0.5, 3: 2.0})
    rows = {int(number): k for k, number in enumerate(found.marker_id) if found.valid[k]}
    assert rows.keys() == {42, 7}
    np.testing.assert_allclose(found.pose[rows[42], :3, 3], truth[:3, 3], atol=0.03)
    assert found.size[rows[42]] == 0.5
    # An id without a surveyed size has the detector's.
    assert found.size[rows[7]] == 1.0
    np.testing.assert_allclose(found.pose[rows[7], :3, 3], [9.0, 3.0, 2.0], atol=0.04)


def test_two_boards_with_one_id_are_reported():
    near, far, other = pose(9.0, -2.0, 2.0), pose(15.0, 2.0, 2.0), pose(11.0, 0.0, 2.0)
    image = np.minimum(photo(AHEAD, {42: near}), photo(AHEAD, {5: other}))
    second = photo(AHEAD, {42: far})
    columns = slice(300, 430)  # of the second board
    image[:, columns] = second[:, columns]
    found = detect(views((AHEAD, image)))
    assert sorted(found.marker_id[found.valid].tolist()) == [5, 42, 42]
    assert (found.contradictory[:3] == (found.marker_id[:3] == 42)).all()
    both = found.pose[found.valid & found.contradictory, 0, 3]
    np.testing.assert_allclose(sorted(both), [9.0, 15.0], atol=0.1)
    # In two cameras: one board is one, two boards are a contradiction.
    alone = detect(views((AHEAD, photo(AHEAD, {42: near})), (ASIDE, photo(ASIDE, {42: near}))))
    assert not alone.contradictory.any()
    apart = detect(views((AHEAD, photo(AHEAD, {42: near})), (ASIDE, photo(ASIDE, {42: far}))))
    assert apart.contradictory.tolist() == [True, True, *[False] * 14]
