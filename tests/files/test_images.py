"""Photographs: formats, depths, orientation, damaged files, the rounding of resizing."""

import builtins
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case
from tests.shared import ROOT, random_photo
from tflane_jax.errors import LeftOutWarning, UserError
from tflane_jax.files.images import DarkImageWarning, list_photos, read_image, resize

RED = np.full((6, 8, 3), (0, 0, 255), np.uint8)  # BGR


def written(path: Path, image: np.ndarray, suffix: str | None = None) -> Path:
    path.write_bytes(cv2.imencode(suffix or path.suffix, image)[1].tobytes())
    return path


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("lstr_preprocess*"), ids=case_id)
def test_resizing_has_the_rounding_of_the_reference(path):
    case = load_module_case(path)
    names = [name for name in case.outputs if name.endswith("_u8")]
    assert names
    for name in names:
        expected = case.outputs[name]
        found = resize(case.inputs["crop_bgr_u8"], *expected.shape[:2])
        np.testing.assert_array_equal(found, expected, err_msg=name)


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
        (np.full((2, 3, 4), (0x4100, 0x4200, 0x4300, 0xFFFF), np.uint16), (0x43, 0x42, 0x41)),
    ],
    ids=["grey", "16-bit", "alpha", "16-bit alpha"],
)
def test_other_depths_and_channels_become_8_bit_rgb(tmp_path, pixels, expected):
    image = read_image(written(tmp_path / "image.png", pixels))
    np.testing.assert_array_equal(image, np.broadcast_to(np.uint8(expected), (2, 3, 3)))


def test_a_16_bit_photo_of_few_bits_is_told(tmp_path):
    """12 bits of a sensor in 16: OpenCV makes them almost black, and no lane was found without a word."""
    path = written(tmp_path / "image.png", np.linspace(0, 4080, 12).astype(np.uint16).reshape(3, 4))
    with pytest.warns(DarkImageWarning, match="uses 12 of its 16 bits, so that it is almost black: stretch"):
        assert read_image(path).max() == 15


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_pixels_of_another_type_are_named(tmp_path, kind):
    path = written(tmp_path / "image.tiff", np.ones((3, 4), kind))
    with pytest.raises(
        UserError, match=r"is damaged or no image of a known format, with 8 or 16 bits a channel: open it"
    ):
        read_image(path)


def test_photos_stand_upright(tmp_path):
    """EXIF orientation 6: the stored rows are the columns of the upright photo."""
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
    whole = written(tmp_path / "whole.jpg", random_photo(64, 64), ".jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    for name, message in {
        "missing.jpg": "cannot read .*missing.jpg: No such file",
        "empty.jpg": "empty.jpg is empty: copy or download",
        "text.jpg": "text.jpg is damaged or no image .*save it as JPEG or PNG",
        "cut.jpg": "cut.jpg is damaged",
        ".": "cannot read .*: it is a folder or a device",
        "/dev/null": "cannot read /dev/null: it is a folder or a device",
        "zero\0.jpg": "cannot read .*: no file can have this name",
        "half\ud800.jpg": "cannot read .*: no file can have this name",
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
    with pytest.raises(UserError, match=r"images need OpenCV: run `pip install -e '\.\[images\]'` in the checkout"):
        resize(RED, 3, 4)


def test_folders_stand_for_their_photos(tmp_path):
    for name in ("b.JPG", "a.png", "notes.txt", "still.gif", "IMG_1.heic", ".hidden"):
        (tmp_path / name).touch()
    (tmp_path / "sub.png").mkdir()
    named = tmp_path / "notes.txt"
    others = r"2 of 5 files in .* have no photo's suffix and are left out: IMG_1.heic, notes.txt$"
    with pytest.warns(LeftOutWarning, match=others):
        found = list_photos([tmp_path, named])
    assert found == [*(tmp_path / name for name in ("a.png", "b.JPG", "still.gif")), named]
    (tmp_path / "lost.png").symlink_to(tmp_path / "nothing")  # regression: it was passed over without a word
    with pytest.warns(LeftOutWarning):
        assert tmp_path / "lost.png" in list_photos([tmp_path])
    (tmp_path / "lost.png").unlink()
    with pytest.raises(UserError, match=r"sub.png holds no photo \(looked for"):
        list_photos([tmp_path / "sub.png"])
    with pytest.raises(UserError, match=r"no file or folder .*nothing"):
        list_photos([tmp_path / "nothing"])
    with pytest.raises(UserError, match="no photos given"):
        list_photos([])


def test_opencv_prints_nothing_beside_the_message(tmp_path, capfd):
    """It would print warnings about a TIFF of floating-point numbers."""
    path = written(tmp_path / "depth.tiff", np.zeros((6, 8, 3), np.float32), ".tiff")
    with pytest.raises(UserError, match=r"depth.tiff is damaged or no image of a known format"):
        read_image(path)
    assert capfd.readouterr() == ("", "")


def test_more_pixels_than_fit_into_memory_are_refused(tmp_path):
    """OpenCV reads its limit when it is imported. This image has 120 kB and would take 6 GB."""
    rows = zlib.compress(b"\0" * (32_000 // 8 + 1) * 32_000, 9)
    header = struct.pack(">IIBBBBB", 32_000, 32_000, 1, 0, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in parts:
        content += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    (tmp_path / "a.png").write_bytes(content)
    code = "import sys; from tflane_jax.files.images import read_image; read_image(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.png"], cwd=ROOT, capture_output=True, text=True)
    assert "a.png has more than 134,217,728 pixels: make it smaller" in done.stderr
