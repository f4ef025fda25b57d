"""Lane lines drawn into photos."""

import numpy as np
import pytest

from tests.models.images import road_images
from tflane_jax.plots.images import (
    LANE_COLOURS,
    TRUTH,
    lanes_drawn,
    predicted_lines,
    save_photo,
    save_road_images,
)
from tflane_jax.scene import CurvePrediction


def test_lanes_are_drawn_into_a_copy_of_a_frame():
    pytest.importorskip("cv2")
    frame = np.zeros((40, 60, 3), np.uint8)
    lanes = [np.array([[10.0, 5.0], [10.0, 35.0]]), np.array([[40.0, 5.0], [80.0, 35.0]])]
    drawn = lanes_drawn(frame, lanes)
    assert not frame.any()
    assert drawn[20, 10].tolist() == [255, 77, 109]  # the first of LANE_COLOURS
    assert drawn[5:36, 10].any(-1).all()
    assert drawn[12, 49].any()
    assert not drawn[:, 20:35].any()
    np.testing.assert_array_equal(lanes_drawn(frame, []), frame)


@pytest.mark.filterwarnings("error")
def test_points_that_are_not_there_are_gaps_of_a_lane():
    pytest.importorskip("cv2")
    frame, none = np.zeros((40, 60, 3), np.uint8), [np.nan, np.nan]
    lane = np.array([none, [10.0, 5.0], [10.0, 15.0], none, [10.0, 25.0], [10.0, 35.0], none])
    marked = lanes_drawn(frame, [lane, np.array([none]), np.zeros((0, 2))])[:, 10].any(-1)
    assert marked[5:16].all()
    assert marked[25:36].all()
    assert not marked[18:23].any()


def drawn(*curves):
    """Return what is drawn of curves (upper, lower, k'', f'', m'', n', b'', b''') that are all lanes."""
    logits = np.tile([0.0, 1.0], (len(curves), 1))
    return predicted_lines(CurvePrediction(logits=logits, curves=np.array(curves)))


def test_lanes_are_drawn_on_the_rows_of_the_metric():
    """Columns are constant: n' alone differs from 0. The last lane's ends changed places: the metric reads none."""
    first, second, swapped = drawn(
        (0.5, 0.8, 0, 0, 0, 0.2, 0, 0), (0.4, 0.9, 0, 0, 0, 0.7, 0, 0), (0.9, 0.4, 0, 0, 0, 0.8, 0, 0)
    )
    for lane, u, rows in ((first, 0.2, range(360, 577, 10)), (second, 0.7, range(290, 649, 10))):
        seen = lane[~np.isnan(lane[:, 0])]
        np.testing.assert_allclose(seen, [[u, row / 720.0] for row in rows])
    assert np.isnan(swapped).all()


def test_a_lane_that_ends_above_its_own_horizon_is_not_drawn_across_the_image():
    """u = 0.5 + 0.001 / (v - 0.4): at its horizon, row 288, it leaves on the right and comes back from the left."""
    (lane,) = drawn((0.35, 0.9, 0, 0.4, 0.001, 0.5, 0, 0))
    seen = lane[~np.isnan(lane[:, 0])]
    assert len(seen) > 35
    assert np.abs(seen[:, 0] - 0.5).max() < 0.4
    dense = np.linspace(0.35, 0.9, 100)  # points between the rows of the metric
    assert np.abs(0.001 / (dense - 0.4)).max() > 0.4


SIZES = [((900, 1600), 630), ((1600, 900), 1910), ((2000, 1), 2145), ((1, 900), 34)]


@pytest.mark.parametrize(("size", "drawn"), SIZES)
def test_the_picture_of_a_narrow_photo_is_of_bounded_height(tmp_path, size, drawn):
    """A photo one pixel wide would be stretched to a picture of gigabytes."""
    pytest.importorskip("matplotlib")
    from PIL import Image

    path = save_photo(tmp_path / "photo.png", np.full((*size, 3), 90, np.uint8), [], "a photo")
    with Image.open(path) as picture:
        assert picture.size == (1056, pytest.approx(drawn, abs=5))


@pytest.mark.parametrize(
    ("count", "across", "down"), [(1, 1, 1), (3, 3, 1), (8, 4, 2), pytest.param(9, 4, 3, marks=pytest.mark.slow)]
)
def test_images_without_predictions_share_rows(tmp_path, count, across, down):
    """Eight of them below each other made a picture five times as high as wide."""
    pytest.importorskip("matplotlib")
    from PIL import Image

    images = road_images(count)
    height, width = images.image.shape[1:3]
    with Image.open(save_road_images(tmp_path / "sheet.png", images)) as picture:
        assert picture.size == (across * 528, pytest.approx(down * (528 * height / width + 27.5), abs=2))
    prediction = CurvePrediction(logits=np.tile([0.0, 1.0], (count, 3, 1)), curves=np.full((count, 3, 8), 0.5))
    with Image.open(save_road_images(tmp_path / "beside.png", images, {"a": prediction})) as picture:
        legend = 27.5
        assert picture.size == (2 * 528, pytest.approx(count * (528 * height / width + 27.5) + legend, abs=2))


def test_no_predicted_lane_looks_like_the_truth(tmp_path):
    pytest.importorskip("matplotlib")
    from tests.plots.test_style import lab

    everybody = np.eye(3)
    truth = lab(TRUTH, everybody)
    assert min(np.linalg.norm(lab(colour, everybody) - truth) for colour in LANE_COLOURS) > 40.0
    images, answers = road_images(2), CurvePrediction(logits=np.zeros((2, 7, 2)), curves=np.zeros((2, 7, 8)))
    for predictions in (None, {"model": answers}):
        assert save_road_images(tmp_path / "roads.png", images, predictions).stat().st_size > 1000
