"""Markers in one image: outlines and ids."""

import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, photo, pose
from tflane_jax.errors import UserError
from tflane_jax.markers.image_search import DetectorConfig, ImageMarkers, find_markers, joined
from tflane_jax.markers.square_pose import marker_outline

pytest.importorskip("cv2")


def test_partial_occlusion_moves_the_corners_little():
    """A post before the right margin, as dark as the square."""
    truth = pose(12.0, 0.3, 2.0)
    image = photo(AHEAD, {21: truth})
    expected = marker_outline(truth, 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
    right = round(float(expected[1, 0])) + 4
    image[:, right : right + 9] = 25
    found = find_markers(image)
    assert found.marker_id.tolist() == [21]
    assert np.abs(found.corners[0] - expected).max() < 0.25


def test_enlarging_keeps_pixels_where_they_are():
    image = photo(AHEAD, {21: pose(14.0, 0.3, 2.0, 25.0)})
    once, twice = (find_markers(image, DetectorConfig(enlarge=factor)) for factor in (1, 2))
    assert once.marker_id.tolist() == twice.marker_id.tolist() == [21]
    np.testing.assert_allclose(once.corners, twice.corners, atol=0.1)


@pytest.mark.parametrize(
    "change",
    [
        {"capacity": 0},
        {"enlarge": 0},
        {"size": 0.0},
        {"least_pixels": float("nan")},
        {"tilt": 0.0},
        {"turn": -1.0},
    ],
)
def test_invalid_settings_are_refused(change):
    with pytest.raises(UserError, match=next(iter(change))):
        find_markers(np.zeros((60, 60), np.uint8), DetectorConfig(**change))


def test_parts_of_an_image_are_joined():
    """One board in two parts is one; two boards with one id stay two."""
    square = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)])
    first = ImageMarkers(np.array([4, 9]), np.stack([square, square + 50.0]), np.array([2, 0]))
    second = ImageMarkers(np.array([4, 9]), np.stack([square + 1.0, square + 90.0]), np.array([0, 1]))
    both = joined([first, second])
    assert both.marker_id.tolist() == [4, 9, 9]
    assert both.wrong_bits.tolist() == [0, 0, 1]
    np.testing.assert_array_equal(both.corners[0], square + 1.0)
    assert joined([]).corners.shape == (0, 4, 2)
