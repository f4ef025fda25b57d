"""Photographs as files: finding, reading, resizing.

OpenCV (extra `images`) does the work and is imported at the first use. The published LSTR weights were trained on its
decoding and its rounding, so another library would give other pixels.
"""

from __future__ import annotations

import contextlib
import os
import stat
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.errors import LeftOutWarning, UserError, missing_extra

PHOTO_SUFFIXES = (".bmp", ".gif", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
LARGEST_SIDE = 2**15 - 2
"""Pixels; OpenCV samples no larger pictures."""
_NAMED = 3  # files in a message
# Place of the principal point, as fractions of width and height, outside of which an image is of another size.
_SCALED = (0.3, 0.75)
# Environment variable of OpenCV, and the pixels that it takes where the variable is not set.
_PIXELS, _MOST_PIXELS = "OPENCV_IO_MAX_IMAGE_PIXELS", 2**27
# Largest value of a 16-bit image that is as good as black in 8 bits.
_DARK = 2**14


class DarkImageWarning(UserWarning):
    """A 16-bit image uses few of its bits."""


def opencv() -> ModuleType:
    """Return the module cv2; raises UserError that names the extra where it is not installed."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet; FFmpeg prints beside OpenCV's own log
    # A file of 100 kB may claim more pixels than fit into memory; panoramas of 30,000 by 4,000 fit.
    os.environ.setdefault(_PIXELS, str(_MOST_PIXELS))
    try:
        import cv2
    except ImportError as error:
        raise missing_extra("images need OpenCV", "images") from error
    return cv2


@contextlib.contextmanager
def quiet_opencv() -> Iterator[ModuleType]:
    """Yield the module cv2, which prints no warnings of its own meanwhile: the caller's message replaces them."""
    cv2 = opencv()
    log = cv2.utils.logging  # cv2.setLogLevel is gone from OpenCV 5
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_SILENT)
    try:
        yield cv2
    finally:
        log.setLogLevel(level)


def list_photos(paths: Iterable[Path], suffixes: tuple[str, ...] = PHOTO_SUFFIXES) -> list[Path]:
    """Return the files among `paths` as they are, and for each folder the photos directly in it, sorted by name.

    Photos are files with one of the suffixes. Warns (`LeftOutWarning`) of others in a folder, but for hidden ones.

    Raises UserError for a path that does not exist, a folder without photos, or no paths at all.
    """
    photos = []
    for path in map(Path, paths):
        if path.is_dir():
            # Links to nothing stay, so that whoever reads the photos names them.
            files = sorted(p for p in path.iterdir() if not p.is_dir() and not p.name.startswith("."))
            inside = [p for p in files if p.suffix.lower() in suffixes]
            if not inside:
                raise UserError(f"folder {path} holds no photo (looked for {', '.join(suffixes)})")
            photos += inside
            _warn_of_others(path, [p.name for p in files if p.suffix.lower() not in suffixes], len(files))
        elif path.exists():
            photos.append(path)
        else:
            raise UserError(f"there is no file or folder {path}")
    if not photos:
        raise UserError("no photos given: name image files or folders of them")
    return photos


def _warn_of_others(folder: Path, names: Sequence[str], count: int) -> None:
    if names:
        shown = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
        message = f"{len(names)} of {count} files in {folder} have no photo's suffix and are left out: {shown}"
        warnings.warn(message, LeftOutWarning, stacklevel=3)


def unreadable(path: Path) -> str | None:
    """Return why a path cannot be read as a file; None if it can. Devices are refused: they may never end."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        return error.strerror
    except ValueError:  # a zero, or half a character
        return "no file can have this name"
    return None if stat.S_ISREG(mode) else "it is a folder or a device"


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Return a photo as 8-bit RGB, turned upright as its EXIF record says; transparency is dropped.

    A JPEG decodes to the pixels of `cv2.imread`, with the channels turned round. Transparent parts of a TIFF are
    blended with black. Raises UserError where the file cannot be read, is empty, cut off, or no image of a known format
    with 8 or 16 bits a channel. Warns of 16-bit images that use few of their bits.
    """
    cv2, path = opencv(), Path(path)
    if fault := unreadable(path):
        raise UserError(f"cannot read {path}: {fault}")
    try:
        # Not cv2.imread: it cannot open every path on Windows, and says nothing about why it failed.
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    if data.size == 0:
        raise UserError(f"{path} is empty: copy or download the image again")
    try:
        with quiet_opencv():
            image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        if "MAX_IMAGE_PIXELS" in error.err:
            limit = os.environ[_PIXELS]  # OpenCV also takes texts such as 100Mb
            most = f"{int(limit):,}" if limit.isdecimal() else limit
            raise UserError(f"{path} has more than {most} pixels: make it smaller, or set {_PIXELS}") from None
        raise UserError(f"cannot read the image {path}: {error.err}") from None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise UserError(
            f"{path} is damaged or no image of a known format, with 8 or 16 bits a channel: open it in an image viewer "
            "and save it as JPEG or PNG"
        )
    if image.dtype == np.uint16:
        if image.max(initial=0) < _DARK:
            warnings.warn(
                f"{path} uses {int(image.max(initial=0)).bit_length()} of its 16 bits, so that it is almost black: "
                "stretch its values to all of them",
                DarkImageWarning,
                stacklevel=2,
            )
        image = (image >> 8).astype(np.uint8)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def check_center(path: Path, image: UInt8[np.ndarray, "h w 3"], intrinsics: Float[np.ndarray, "3 3"]) -> None:
    """Raise UserError if the principal point shows that an image has another size than the calibration.

    It is outside of the image, or off its center in both directions alike, as cropping alone seldom leaves it.
    """
    height, width = image.shape[:2]
    x, y = intrinsics[:2, 2]
    across, down = x / width, y / height
    scaled = min(across, down) > _SCALED[1] or max(across, down) < _SCALED[0]
    if scaled or not (0.0 <= across <= 1.0 and 0.0 <= down <= 1.0):
        raise UserError(
            f"{path} is {width} x {height}, but the principal point is ({x:g}, {y:g}): are the intrinsics of another "
            "image size?"
        )


def undistorted(
    path: Path, image: UInt8[np.ndarray, "h w 3"], intrinsics: Float[np.ndarray, "3 3"], distortion: Sequence[float]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image as a pinhole camera would take it.

    Args:
        path: of the image, for messages.
        image: of a camera with lens distortion.
        intrinsics: pixels from the corner of the image; those of the result too.
        distortion: OpenCV's K1 K2 P1 P2, with K3, or with K3 to K6; empty returns the image itself.

    Raises UserError for an image with a side that is too long for OpenCV.
    """
    if not len(distortion):
        return image
    if max(image.shape) > LARGEST_SIDE:
        height, width = image.shape[:2]
        raise UserError(
            f"{path} has {width} x {height} pixels; lens distortion can be removed up to {LARGEST_SIDE} on a side: "
            "make it smaller, and its intrinsics"
        )
    # OpenCV's pixel origin is the center of the first pixel, ours its corner.
    shifted = intrinsics - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    return opencv().undistort(image, shifted, np.array(distortion))


def resize(image: UInt8[np.ndarray, "h w 3"], height: int, width: int) -> UInt8[np.ndarray, "height width 3"]:
    """Return the image at another size, bilinear with OpenCV's 8-bit rounding: what LSTR was trained on.

    Nothing is smoothed beforehand, so that reductions to less than half skip pixels, as in the original.
    """
    cv2 = opencv()
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
