"""Photographs of any size and camera are fitted to LSTR's view."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.shared import random_photo, shared_path
from tflane_jax.datasets.photos import FOCAL, HEIGHT, HORIZON, WIDTH, PhotoCamera, Placement, fit_photo, misfits
from tflane_jax.errors import UserError
from tflane_jax.files.images import read_image, resize


@pytest.mark.golden
def test_a_tusimple_frame_is_read_and_fitted_as_by_the_reference():
    reference = np.load(shared_path("data/lstr/reference_outputs_train.npz"))
    frames = shared_path("data/tusimple/LaneDetection")
    fitted = fit_photo(read_image(frames / str(reference["raw_file"][0])))
    mean = np.float32([0.40789654, 0.44719302, 0.47026115])
    std = np.float32([0.28863828, 0.27408164, 0.27809835])
    normalised = ((fitted.image[..., ::-1] / 255.0 - mean) / std).astype(np.float32)
    np.testing.assert_array_equal(normalised.transpose(2, 0, 1), reference["input_first_image"])
    assert fitted.placement == Placement(0, 0, 1280, 720)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 1000), (590, 1640), (720, 1280), (900, 1200), (1200, 900)])
def test_a_photo_of_any_size_is_seen_whole(height, width):
    fitted = fit_photo(random_photo(height, width))
    assert fitted.placement == Placement(0, 0, width, height)
    assert fitted.image.shape == (HEIGHT, WIDTH, 3)
    assert fitted.image.dtype == np.uint8
    assert fitted.image_valid.shape == (HEIGHT, WIDTH)
    assert fitted.image_valid.all()


@pytest.mark.parametrize("scale", [0.25, 0.5, 1, 3])
def test_tusimples_own_camera_is_seen_whole(scale):
    height, width = round(720 * scale), round(1280 * scale)
    camera = PhotoCamera(FOCAL * width, HORIZON * height)
    assert fit_photo(random_photo(height, width), camera).placement == Placement(0, 0, width, height)


def test_a_horizon_cuts_the_sky():
    seen = fit_photo(random_photo(600, 800), PhotoCamera(horizon=300)).placement
    assert (seen.left, seen.width, seen.top + seen.height) == (0, 800, 600)
    assert seen.to_photo(np.array([0.0, HORIZON]))[1] == pytest.approx(300.0, abs=1.0)


def test_rows_that_are_missing_above_a_high_horizon_are_black():
    photo = random_photo(600, 800)
    fitted = fit_photo(photo, PhotoCamera(horizon=50))
    seen = fitted.placement
    assert seen.top < -100
    assert (seen.left, seen.width, seen.top + seen.height) == (0, 800, 600)
    assert seen.to_photo(np.array([0.0, HORIZON]))[1] == pytest.approx(50.0, abs=1.0)
    rows = -seen.top * HEIGHT / seen.height
    assert not fitted.image[: int(rows) - 1].any()
    assert fitted.image[int(rows) + 2 :].any()
    below = fit_photo(photo, Placement(0, 0, 800, 600)).image
    np.testing.assert_allclose(fitted.image[-1].mean(), below[-1].mean(), atol=10)


def test_a_wide_lens_is_cut_to_tusimples_view():
    """Half the focal length: half of each side, and the same angles of the scene in the same places."""
    camera = PhotoCamera(focal=FOCAL * 640, horizon=400, column=700)
    seen = fit_photo(random_photo(800, 1280), camera).placement
    assert (seen.width, seen.left) == (640, 380)
    assert abs(seen.height - 360) <= 1
    np.testing.assert_allclose(seen.to_photo(np.array([0.5, HORIZON])), [700.0, 400.0], atol=0.7)
    # Ahead near the border: the view keeps its width.
    near_border = PhotoCamera(FOCAL * 640, column=1270)
    assert fit_photo(random_photo(800, 1280), near_border).placement == Placement(640, 0, 640, 800)


def test_thin_paint_survives_a_strong_reduction():
    image = np.zeros((360 * 8, 640 * 8, 3), np.uint8)
    image[:, 45:48] = 255  # in pixel 5 of the small image, beside the two samples of plain interpolation
    assert resize(image, HEIGHT, WIDTH)[:, 5].max() == 0
    np.testing.assert_allclose(fit_photo(image).image[:, 5].astype(int), 255 * 3 / 8, atol=1)


@pytest.mark.parametrize(
    ("shape", "camera", "message"),
    [
        ((0, 5), PhotoCamera(), "5 x 0 pixels shows nothing"),
        ((600, 800), PhotoCamera(focal=26.0), "26 pixels is too short .* 800 x focal length / sensor width"),
        ((600, 800), PhotoCamera(focal=float("nan")), "a focal length of nan is no number of pixels"),
        ((600, 800), PhotoCamera(focal=float("inf")), "a focal length of inf is no number of pixels"),
        ((600, 800), PhotoCamera(horizon=600.0), "horizon, row 600, is below"),
        ((600, 800), PhotoCamera(horizon=float("nan")), "horizon"),
        (
            (720, 1280),
            PhotoCamera(horizon=0.33),
            "0.33 is a fraction: give the row in pixels, such as 238 of",
        ),
        ((720, 1280), PhotoCamera(horizon=1.0), "1 is a fraction"),
        ((720, 1280), PhotoCamera(horizon=-50.0), "horizon, row -50, is above a photo 720 pixels high"),
        ((600, 800), PhotoCamera(column=-1.0), "column straight ahead, -1, is outside"),
    ],
)
def test_numbers_in_other_units_are_refused(shape, camera, message):
    with pytest.raises(UserError, match=message):
        fit_photo(np.zeros((*shape, 3), np.uint8), camera)


@settings(max_examples=60)
@given(
    st.integers(1, 6000),
    st.integers(1, 6000),
    st.floats(0.06, 1e4),
    st.floats(0.0, 0.99),
    st.floats(0, 1),
    st.booleans(),
    st.booleans(),
)
def test_placements_lie_in_the_photo_but_for_missing_rows_above_a_horizon(
    height, width, focal, horizon, column, has_focal, has_horizon
):
    focal, horizon = focal * width if has_focal else None, horizon * height if has_horizon else None
    horizon = 0.0 if horizon is not None and horizon <= 1.0 else horizon
    camera = PhotoCamera(focal, horizon, column * width)
    # One row and column repeated: only the size matters here.
    seen = fit_photo(np.broadcast_to(np.zeros((1, 1, 3), np.uint8), (height, width, 3)), camera).placement
    assert seen.left >= 0 and seen.width >= 1 and seen.height >= 1  # noqa: PT018
    assert seen.top >= 0 or (
        has_horizon and seen.to_photo(np.array([0.0, HORIZON]))[1] == pytest.approx(horizon, abs=1)
    )
    assert seen.left + seen.width <= width
    assert seen.top + seen.height <= height
    corners = seen.to_photo(np.array([[0.0, 0.0], [1.0, 1.0]]))
    np.testing.assert_allclose(corners[:, 0], [seen.left, seen.left + seen.width])
    np.testing.assert_allclose(corners[:, 1], [seen.top, seen.top + seen.height])


@pytest.mark.parametrize(
    ("horizon", "said"),
    [
        (100, []),
        (700, ["sees 1280 x 30 pixels, distorted to 16:9: is row 700 the horizon"]),
        (0, []),
        (205, []),
        (238, []),
        (340, []),
    ],
)
def test_a_horizon_that_cannot_be_tusimples_is_named(horizon, said):
    found = misfits(fit_photo(random_photo(720, 1280), PhotoCamera(horizon=horizon)).placement, horizon)
    assert len(found) == len(said)
    assert all(re.search(pattern, text) for pattern, text in zip(said, found, strict=True))
