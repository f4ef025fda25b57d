"""Black and white cells of ArUco and AprilTag markers, from OpenCV's dictionaries (extra `images`)."""

from __future__ import annotations

import enum
import functools
from typing import Any

import numpy as np
from jaxtyping import Bool

from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv


class MarkerFamily(enum.Enum):
    """A dictionary of markers, by OpenCV's name (ArUco: Garrido-Jurado et al. 2014; AprilTag: Olson 2011)."""

    ARUCO_4X4_50 = "DICT_4X4_50"
    ARUCO_4X4_100 = "DICT_4X4_100"
    ARUCO_4X4_1000 = "DICT_4X4_1000"
    ARUCO_5X5_100 = "DICT_5X5_100"
    ARUCO_5X5_1000 = "DICT_5X5_1000"
    ARUCO_6X6_250 = "DICT_6X6_250"
    ARUCO_6X6_1000 = "DICT_6X6_1000"
    ARUCO_7X7_1000 = "DICT_7X7_1000"
    ARUCO_ORIGINAL = "DICT_ARUCO_ORIGINAL"
    ARUCO_MIP_36H12 = "DICT_ARUCO_MIP_36h12"
    APRILTAG_16H5 = "DICT_APRILTAG_16h5"
    APRILTAG_25H9 = "DICT_APRILTAG_25h9"
    APRILTAG_36H10 = "DICT_APRILTAG_36h10"
    APRILTAG_36H11 = "DICT_APRILTAG_36h11"


BOARD_SIZES = (0.01, 100.0)
"""Smallest and largest side of a marker's black square, metres."""
# Wrong bits to correct: floor((d - 1) / 2) of the least distance d, and 1 in the original family, where some ids look
# alike when they are turned. Older versions of OpenCV have 12 for ARUCO_MIP_36H12 and 0 for the others.
_CORRECTABLE = {
    MarkerFamily.ARUCO_ORIGINAL: 1,
    MarkerFamily.ARUCO_MIP_36H12: 5,
    MarkerFamily.APRILTAG_16H5: 2,
    MarkerFamily.APRILTAG_25H9: 4,
    MarkerFamily.APRILTAG_36H10: 4,
    MarkerFamily.APRILTAG_36H11: 5,
}
# Width in cells of the white margin of a printed marker, which detectors need.
MARGIN = 1


@functools.cache
def dictionary_of(family: MarkerFamily) -> Any:
    """Return OpenCV's dictionary, which corrects as many bits in every version of OpenCV.

    Raises UserError if OpenCV or its aruco module is missing.
    """
    cv2 = opencv()
    if not hasattr(cv2, "aruco") or not hasattr(cv2.aruco, "ArucoDetector"):
        raise UserError("this OpenCV has no aruco.ArucoDetector: pip install 'opencv-python-headless>=4.10'")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family.value))
    dictionary.maxCorrectionBits = _CORRECTABLE.get(family, dictionary.maxCorrectionBits)
    return dictionary


def marker_count(family: MarkerFamily) -> int:
    """Return the number of ids of a family; ids start at 0."""
    return len(dictionary_of(family).bytesList)


def correctable_bits(family: MarkerFamily) -> int:
    """Return the number of wrong bits that can be corrected in a marker of this family."""
    return int(dictionary_of(family).maxCorrectionBits)


def cells_across(family: MarkerFamily) -> int:
    """Return the number of cells along a side of the black square, including its border."""
    return int(dictionary_of(family).markerSize) + 2


def marker_cells(family: MarkerFamily, marker_id: int) -> Bool[np.ndarray, "n n"]:
    """Return which cells of a marker are white, top row first, with its black border and without a margin.

    The array is cached and read-only. Raises UserError for an id outside the family.
    """
    return _cells(family, int(marker_id))


@functools.lru_cache(maxsize=1024)
def _cells(family: MarkerFamily, marker_id: int) -> Bool[np.ndarray, "n n"]:
    count = marker_count(family)
    if not 0 <= marker_id < count:
        raise UserError(
            f"marker family {family.name} has the ids 0 to {count - 1}, not {marker_id}: choose one of these, or a "
            "larger family"
        )
    cells = opencv().aruco.generateImageMarker(dictionary_of(family), marker_id, cells_across(family)) > 127
    cells.flags.writeable = False
    return cells


def board_cells(family: MarkerFamily, marker_id: int) -> Bool[np.ndarray, "m m"]:
    """Return the cells of a printed marker: those of `marker_cells` in a white margin of `MARGIN` cells."""
    return np.pad(marker_cells(family, marker_id), MARGIN, constant_values=True)


def board_size(family: MarkerFamily, size: float) -> float:
    """Return the side of a printed marker with its margin, metres; `size` is the side of its black square."""
    across = cells_across(family)
    return size * (across + 2 * MARGIN) / across
