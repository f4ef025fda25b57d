import builtins
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.shared import shared_path
from tflane_jax.errors import UserError
from tflane_jax.files.images import (
    FOCAL,
    HEIGHT,
    HORIZON,
    WIDTH,
    PhotoCamera,
    Placement,
    fit_photo,
    list_photos,
    read_image,
    resize,
)

RED = np.full((6, 8, 3), (0, 0, 255), np.uint8)  # BGR


def written(path: Path, image: np.ndarray, suffix: str = ".png") -> Path:
    path.write_bytes(cv2.imencode(suffix, image)[1].tobytes())
    return path


def photo(height, width):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


@pytest.mark.golden
@pytest.mark.parametrize(("name", "height", "width"), [("half_u8", 72, 128), ("odd_u8", 90, 150), ("up_u8", 200, 300)])
def test_resizing_has_the_rounding_of_the_reference(name, height, width):
    case = np.load(shared_path("golden/modules/lstr_preprocess.npz"))
    np.testing.assert_array_equal(resize(case["in/crop_bgr_u8"], height, width), case[f"out/{name}"])


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


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".webp"])
def test_formats_read_as_rgb_on_any_path(tmp_path, suffix):
    image = read_image(written(tmp_path / f"Straße 道路{suffix}", RED, suffix))
    assert image.dtype == np.uint8
    np.testing.assert_allclose(image.astype(int), np.broadcast_to([255, 0, 0], (6, 8, 3)), atol=1)


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (np.full((2, 3), 7, np.uint8), (7, 7, 7)),
        (np.full((2, 3), 0x8081, np.uint16), (0x80, 0x80, 0x80)),
        (np.full((2, 3, 4), (1, 2, 3, 0), np.uint8), (3, 2, 1)),
        (np.full((2, 3, 4), (0x0100, 0x0200, 0x0300, 0xFFFF), np.uint16), (3, 2, 1)),
    ],
    ids=["grey", "16-bit", "alpha", "16-bit alpha"],
)
def test_other_depths_and_channels_become_8_bit_rgb(tmp_path, pixels, expected):
    image = read_image(written(tmp_path / "image.png", pixels))
    np.testing.assert_array_equal(image, np.broadcast_to(np.uint8(expected), (2, 3, 3)))


def test_photos_stand_upright(tmp_path):
    """EXIF orientation 6: the camera was turned, the stored rows are the photo's columns."""
    from PIL import Image

    stored = np.zeros((16, 32, 3), np.uint8)
    stored[:, :16] = 255  # stored left is upright top
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(stored).save(tmp_path / "turned.jpg", exif=exif, quality=100)
    image = read_image(tmp_path / "turned.jpg")
    assert image.shape == (32, 16, 3)
    assert image[:12].min() > 200
    assert image[-12:].max() < 50


def test_unreadable_files_are_named(tmp_path):
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.jpg").write_text("hello")
    whole = written(tmp_path / "whole.jpg", photo(64, 64), ".jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    for name, message in {
        "missing.jpg": "cannot read .*missing.jpg: No such file",
        "empty.jpg": "empty.jpg is empty: copy or download",
        "text.jpg": "text.jpg is damaged or no image .*save it as JPEG or PNG",
        "cut.jpg": "cut.jpg is damaged",
        ".": "cannot read .*: Is a directory",
    }.items():
        with pytest.raises(UserError, match=message):
            read_image(tmp_path / name)


def test_absent_opencv_names_the_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    original = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "cv2":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UserError, match=r"pip install 'tflane_jax\[images\]'"):
        resize(RED, 3, 4)


def test_folders_stand_for_their_photos(tmp_path):
    for name in ("b.JPG", "a.png", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "sub.png").mkdir()
    named = tmp_path / "notes.txt"
    assert list_photos([tmp_path, named]) == [tmp_path / "a.png", tmp_path / "b.JPG", named]
    with pytest.raises(UserError, match=r"sub.png holds no photo \(looked for"):
        list_photos([tmp_path / "sub.png"])
    with pytest.raises(UserError, match=r"no file or folder .*nothing"):
        list_photos([tmp_path / "nothing"])
    with pytest.raises(UserError, match="no photos given"):
        list_photos([])


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 1000), (590, 1640), (720, 1280), (900, 1200), (1200, 900)])
def test_a_photo_of_any_size_is_seen_whole(height, width):
    fitted = fit_photo(photo(height, width))
    assert fitted.placement == Placement(0, 0, width, height)
    assert fitted.image.shape == (HEIGHT, WIDTH, 3)
    assert fitted.image.dtype == np.uint8
    assert fitted.image_valid.shape == (HEIGHT, WIDTH)
    assert fitted.image_valid.all()


@pytest.mark.parametrize("scale", [0.25, 0.5, 1, 3])
def test_tusimples_own_camera_is_seen_whole(scale):
    height, width = round(720 * scale), round(1280 * scale)
    camera = PhotoCamera(FOCAL * width, HORIZON * height)
    assert fit_photo(photo(height, width), camera).placement == Placement(0, 0, width, height)


def test_a_horizon_cuts_the_sky():
    seen = fit_photo(photo(600, 800), PhotoCamera(horizon=300)).placement
    assert (seen.left, seen.width, seen.top + seen.height) == (0, 800, 600)
    assert seen.to_network(np.array([0.0, 300.0]))[1] == pytest.approx(HORIZON, abs=2e-3)
    # Nothing can be added above a horizon that is higher than TuSimple's.
    assert fit_photo(photo(600, 800), PhotoCamera(horizon=50)).placement == Placement(0, 0, 800, 600)


def test_a_wide_lens_is_cut_to_tusimples_view():
    """Half the focal length: half of each side, and the same angles of the scene in the same places."""
    camera = PhotoCamera(focal=FOCAL * 640, horizon=400, column=700)
    seen = fit_photo(photo(800, 1280), camera).placement
    assert (seen.width, seen.left) == (640, 380)
    assert abs(seen.height - 360) <= 1
    np.testing.assert_allclose(seen.to_network(np.array([700.0, 400.0])), [0.5, HORIZON], atol=2e-3)
    # Ahead near the border: the view keeps its width.
    assert fit_photo(photo(800, 1280), PhotoCamera(FOCAL * 640, column=1270)).placement == Placement(640, 0, 640, 800)


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
        ((600, 800), PhotoCamera(focal=float("nan")), "too short"),
        ((600, 800), PhotoCamera(horizon=600.0), "horizon, row 600, is below"),
        ((600, 800), PhotoCamera(horizon=float("nan")), "horizon"),
        ((600, 800), PhotoCamera(column=-1.0), "column straight ahead, -1, is outside"),
    ],
)
def test_numbers_in_other_units_are_refused(shape, camera, message):
    with pytest.raises(UserError, match=message):
        fit_photo(np.zeros((*shape, 3), np.uint8), camera)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 6000),
    st.integers(1, 6000),
    st.floats(0.06, 1e4),
    st.floats(-1.0, 0.99),
    st.floats(0, 1),
    st.booleans(),
    st.booleans(),
)
def test_placements_lie_in_the_photo_and_invert(height, width, focal, horizon, column, has_focal, has_horizon):
    focal, horizon = focal * width if has_focal else None, horizon * height if has_horizon else None
    camera = PhotoCamera(focal, horizon, column * width)
    # One row and column repeated: only the size matters here.
    seen = fit_photo(np.broadcast_to(np.zeros((1, 1, 3), np.uint8), (height, width, 3)), camera).placement
    assert seen.left >= 0 and seen.top >= 0 and seen.width >= 1 and seen.height >= 1  # noqa: PT018
    assert seen.left + seen.width <= width
    assert seen.top + seen.height <= height
    points = np.array([[0.0, 0.0], [1.0, 1.0], [0.3, -0.7]])
    np.testing.assert_allclose(seen.to_network(seen.to_photo(points)), points, atol=1e-9)
    np.testing.assert_allclose(seen.to_photo(points)[:2, 0], [seen.left, seen.left + seen.width])
    np.testing.assert_allclose(seen.to_photo(points)[:2, 1], [seen.top, seen.top + seen.height])
