"""Boards that are partly hidden or in the shadow, which OpenCV's search does not find."""

import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, photo, pose
from tflane_jax.markers.image_search import DetectorConfig, find_markers
from tflane_jax.markers.occluded_search import find_occluded
from tflane_jax.markers.square_pose import marker_outline
from tflane_jax.scene.marker_patterns import MarkerFamily
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig
from tflane_jax.world.cameras.sensor import render_cameras
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.simulate import WorldConfig, simulate

cv2 = pytest.importorskip("cv2")

ARUCO = MarkerFamily.ARUCO_5X5_100
TRUTH = pose(9.0, -0.2, 1.8, 20.0)
CORNERS = marker_outline(TRUTH, 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
# Part of the image around the board, whose square is about 97 pixels wide.
LEFT, TOP, RIGHT, BOTTOM = (int(v) for v in (*CORNERS.min(0) - 90, *CORNERS.max(0) + 90))


def board(number=21):
    """Return the part of a photo that shows the board, and the board's corners in it."""
    grey = photo(AHEAD, {number: TRUTH}).mean(-1).astype(np.uint8)
    return grey[TOP:BOTTOM, LEFT:RIGHT].copy(), CORNERS - [LEFT, TOP]


def bar(grey, corners, fraction, tone=60):
    """Draw a post before the board."""
    middle, width = corners.mean(0), np.ptp(corners[:, 0])
    x = round(float(middle[0] - 0.12 * width))
    grey[:, x : x + max(2, round(fraction * width))] = tone


def leaf(grey, corners):
    """Cover the lower right corner."""
    cv2.circle(grey, tuple(np.round(corners[2]).astype(int).tolist()), round(0.33 * np.ptp(corners[:, 0])), 70, -1)


def side(grey, corners):
    low = corners.min(0)
    grey[:, : round(float(low[0] + 0.1 * np.ptp(corners[:, 0])))] = 70


def shadow(grey, corners):
    x, y = corners.mean(0)
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    dark = (columns - x) + 0.6 * (rows - y) > 5.0
    grey[dark] = (0.35 * grey[dark]).astype(np.uint8)


def none(grey, corners):
    del grey, corners


DAMAGE = {
    "none": (none, 0.2, 0),
    "bar 2 %": (lambda g, c: bar(g, c, 0.02), 0.3, 5),
    "bar 10 %": (lambda g, c: bar(g, c, 0.1), 0.3, 7),
    "bar 18 %": (lambda g, c: bar(g, c, 0.18), 0.4, 9),
    "leaf": (leaf, 0.5, 9),
    "side": (side, 0.8, 9),
    "shadow": (shadow, 0.8, 2),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_board_is_found_at_its_place(name):
    grey, corners = board()
    damage, within, wrong = DAMAGE[name]
    damage(grey, corners)
    if name != "none":
        assert not len(find_markers(grey, DetectorConfig(search="outlines")).marker_id)
    (found,) = find_occluded(grey, ARUCO, 8.0, ids=range(40))
    assert found.marker_id == 21
    assert np.abs(found.corners - corners).max() < within
    assert found.wrong_bits <= wrong, found.wrong_bits
    assert found.explained > 0.85


def test_hidden_cells_of_the_border_are_wrong_bits():
    """Regression: inner cells alone counted, so that a board without a side had the score of a whole one."""
    grey, corners = board()
    across = np.ptp(corners[:, 0])
    grey[:, : round(float(corners[:, 0].min() + across / 7))] = 120  # the left column of the border
    (found,) = find_occluded(grey, ARUCO, 8.0, ids=range(40))
    assert 5 <= found.wrong_bits <= 9
    (whole,) = find_occluded(board()[0], ARUCO, 8.0, ids=range(40))
    assert whole.wrong_bits == 0


@pytest.mark.parametrize("turns", [1, 2])
def test_corners_follow_the_pattern_of_a_turned_board(turns):
    grey, corners = board()
    bar(grey, corners, 0.05)
    assert find_markers(grey, DetectorConfig(search="all")).marker_id.tolist() == [21]
    (found,) = find_occluded(np.ascontiguousarray(np.rot90(grey, turns)), ARUCO, 8.0)
    assert found.marker_id == 21
    for _ in range(turns):
        corners, grey = np.stack([corners[:, 1], grey.shape[1] - corners[:, 0]], -1), np.rot90(grey)
    assert np.abs(found.corners - corners).max() < 0.4


def test_only_possible_ids_are_found():
    grey, corners = board()
    bar(grey, corners, 0.1)
    assert find_occluded(grey, ARUCO, 8.0, ids=(3, 4)) == []
    assert find_occluded(grey, ARUCO, 8.0, ids=()) == []


@pytest.mark.parametrize("seed", [2])
def test_rectangles_and_noise_hold_no_markers(seed):
    """Dark panes in bright frames, some with bright cells in them."""
    rng = np.random.default_rng(seed)
    grey = np.full((240, 320), 120, np.uint8)
    for _ in range(12):
        x, y, size = (int(v) for v in (*rng.integers(0, (260, 180)), rng.integers(18, 70)))
        cv2.rectangle(grey, (x, y), (x + size, y + size), 210, -1)
        edge = size // 9 + 1
        cv2.rectangle(grey, (x + edge, y + edge), (x + size - edge, y + size - edge), 30, -1)
        inner = rng.integers(0, 2, (3, 3)) * 180 + 30
        cell = (size - 6 * edge) // 3
        if cell > 1:
            start = slice(y + 3 * edge, y + 3 * edge + 3 * cell), slice(x + 3 * edge, x + 3 * edge + 3 * cell)
            shown = np.kron(inner, np.ones((cell, cell)))
            part = grey[start]
            part[:] = shown[: part.shape[0], : part.shape[1]]
    grey = np.clip(grey + 5.0 * rng.standard_normal(grey.shape), 0, 255).astype(np.uint8)
    assert find_occluded(grey, ARUCO, 8.0) == []


def test_an_arrow_on_a_traffic_sign_is_no_board():
    """In a bright sky the sign has margin and border, and its arrow most cells of id 98."""
    world = WorldConfig(duration_s=3.6, keyframes=4, markers=PlacementConfig(side="both", site="clear"))
    rig = CameraRigConfig(cameras=ARGOVERSE2_RING[:1], scale=0.5, markers=True)
    views = render_cameras(simulate(2000, world), 3, rig)
    grey = cv2.cvtColor(views.image[0], cv2.COLOR_RGB2GRAY)
    assert find_occluded(grey, ARUCO, 8.0, ids=(4, 29, 33, 44, 46, 49, 61, 92, 98)) == []


@pytest.mark.parametrize("shape", [(5, 5), (40, 40)])
def test_small_and_empty_images(shape):
    assert find_occluded(np.full(shape, 100, np.uint8), ARUCO, 8.0) == []


def test_a_whole_board_of_another_family_member_is_not_read_as_a_known_one():
    """Ids 0 and 16 of this family differ in three cells, which the search for hidden boards allows for."""
    family = MarkerFamily.ARUCO_ORIGINAL
    truth = pose(15.0, -0.2, 1.8)
    grey = photo(AHEAD, {0: truth}, family).mean(-1).astype(np.uint8)
    corners = marker_outline(truth, 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
    left, top, right, bottom = (int(v) for v in (*corners.min(0) - 60, *corners.max(0) + 60))
    part = grey[top:bottom, left:right].copy()
    known = DetectorConfig(family, search="all", ids=(16,))
    assert [each.marker_id for each in find_occluded(part, family, 12.0, known.ids)] == [16]
    found = find_markers(part, known)
    assert found.marker_id.tolist() == [0]
    assert found.wrong_bits.tolist() == [0]
