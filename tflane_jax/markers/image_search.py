"""Searching an image for fiducial markers: outlines and ids.

OpenCV (extra `images`) finds the squares and decodes their ids; `corner_refinement` places their corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv
from tflane_jax.limits import Count, CountOrZero, Fraction, Limit, Positive, check_settings, counted
from tflane_jax.markers.corner_refinement import refine_corners
from tflane_jax.markers.occluded_search import find_occluded
from tflane_jax.scene.marker_patterns import BOARD_SIZES, MarkerFamily, dictionary_of, marker_cells

# Window widths of OpenCV's adaptive threshold, pixels: its defaults.
_WINDOWS = (3, 13, 23)
_MOST_PIXELS = 200_000_000
_LEAST, _MOST = BOARD_SIZES
_BOARD_SIZE = Limit(f"from {_LEAST:g} to {_MOST:g} metres", lambda value: _LEAST <= value <= _MOST)


@dataclass(frozen=True)
class DetectorConfig:
    """Settings of the detector.

    Attributes:
        family: dictionary of the markers.
        size: side of the black square, metres, as of a store's markers.
        capacity: most markers reported per frame; the best scores are kept.
        corners: "pattern" fits all printed cells to the image, "subpixel" refines each corner separately, "none" keeps
            the pixels of the outline.
        enlarge: factor by which images are enlarged before the search; a larger one finds smaller markers, more slowly.
        search: "outlines": OpenCV's search alone, which needs the whole outline of a square; "all": also boards that
            are partly hidden, dirty or half in the shadow (`occluded_search`), in several times the time.
        ids: that partly hidden boards may have, for example those of the store; None: all of the family. The fewer, the
            more of a board may be hidden.
        least_pixels: smallest side of a detected square, pixels of the given image.
        ambiguous: the prior chooses between the two poses if the ratio of the smaller to the greater error is above
            this; 1 never uses the prior.
        tilt, turn: standard deviations of the prior, radians: of the angle between the marker's y axis and the
            vertical, and of the angle between its face and the direction to the camera.
    """

    family: MarkerFamily = MarkerFamily.ARUCO_5X5_100
    size: Annotated[float, _BOARD_SIZE] = 1.0
    capacity: Count = 16
    corners: Literal["pattern", "subpixel", "none"] = "pattern"
    enlarge: Annotated[int, counted(1, 16)] = 1
    search: Literal["outlines", "all"] = "outlines"
    ids: tuple[CountOrZero, ...] | None = None
    least_pixels: Positive = 8.0
    ambiguous: Fraction = 0.6
    tilt: Positive = 0.05
    turn: Positive = 0.8


class ImageMarkers(NamedTuple):
    """K markers found in one image, by ascending id; an id that was read at several places has a row for each.

    Attributes:
        marker_id: (K,).
        corners: (K, 4, 2) pixels from the image's corner: upper left, upper right, lower right, lower left of the
            black square as printed.
        wrong_bits: (K,) cells read with the wrong colour, border included.
    """

    marker_id: Int[np.ndarray, " k"]
    corners: Float[np.ndarray, "k 4 2"]
    wrong_bits: Int[np.ndarray, " k"]


def find_markers(
    image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"], config: DetectorConfig = DetectorConfig()
) -> ImageMarkers:
    """Return the markers of the family in an undistorted image, RGB or grey.

    Of several readings at one place the one counts whose cells are read best, of one id or of several; an id at several
    places is reported at each. Raises UserError without OpenCV or for an invalid config.
    """
    check_settings(config, "DetectorConfig.")
    cv2 = opencv()
    if min(image.shape[:2]) < config.least_pixels:
        return ImageMarkers(np.zeros(0, int), np.zeros((0, 4, 2)), np.zeros(0, int))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else np.ascontiguousarray(image)
    if config.enlarge > 1:
        if grey.size * config.enlarge**2 > _MOST_PIXELS:
            raise UserError(
                f"an image of {grey.shape[1]} x {grey.shape[0]} pixels enlarged {config.enlarge} times has more than "
                f"{_MOST_PIXELS / 1e6:.0f} million: enlarge it less"
            )
        grey = cv2.resize(grey, None, fx=config.enlarge, fy=config.enlarge, interpolation=cv2.INTER_CUBIC)
    # Against a bright sky some threshold windows merge the white margin with the square, and the outline is that of the
    # board. OpenCV prefers the outermost outline, so each width is tried separately and the best result is kept.
    found: list[_Reading] = []
    for width in _WINDOWS:
        outlines, ids, _ = _detector(cv2, max(grey.shape), config, width).detectMarkers(grey)
        # OpenCV has its origin at the center of the first pixel, this package at its corner.
        squares = np.asarray(outlines, np.float64).reshape(-1, 4, 2) + 0.5
        for marker_id, corners in zip([] if ids is None else np.ravel(ids).tolist(), squares, strict=True):
            cells = marker_cells(config.family, marker_id)
            if config.corners == "pattern":
                corners = refine_corners(grey, corners, cells)
            found.append(_Reading(marker_id, _rank(cv2, grey, corners, cells), corners))
    if config.search == "all":
        for each in find_occluded(grey, config.family, config.least_pixels * config.enlarge, config.ids):
            rank = _rank(cv2, grey, each.corners, marker_cells(config.family, each.marker_id))
            # Its own count of wrong cells stands, which knows shadows.
            found.append(_Reading(each.marker_id, rank._replace(wrong_bits=each.wrong_bits), each.corners))
    return _as_arrays(_best_ids(_one_for_each_place(found)), config.enlarge)


def joined(parts: Sequence[ImageMarkers]) -> ImageMarkers:
    """Return what was found in several parts of one image, in pixels of the whole image, as `find_markers` does."""
    found = [
        _Reading(int(marker_id), _Rank(int(wrong), 0.0), corners)
        for part in parts
        for marker_id, corners, wrong in zip(part.marker_id, part.corners, part.wrong_bits, strict=True)
    ]
    return _as_arrays(_best_ids(_one_for_each_place(found)))


class _Rank(NamedTuple):
    """How badly the cells at a place read as those of a marker; the smaller rank is the better reading.

    Attributes:
        wrong_bits: cells read with the wrong colour.
        black_minus_white: brightness, -255 (full contrast) to 255.
    """

    wrong_bits: int
    black_minus_white: float


class _Reading(NamedTuple):
    """A marker read at a place; of two readings there, that of the smaller rank counts."""

    marker_id: int
    rank: _Rank
    corners: Float[np.ndarray, "4 2"]


def _as_arrays(readings: list[_Reading], enlarged: int = 1) -> ImageMarkers:
    return ImageMarkers(
        np.array([each.marker_id for each in readings], int),
        np.array([each.corners for each in readings]).reshape(-1, 4, 2) / enlarged,
        np.array([each.rank.wrong_bits for each in readings], int),
    )


def _one_for_each_place(found: list[_Reading]) -> list[_Reading]:
    """Return the best reading of each id at each place, by ascending id."""
    kept: list[_Reading] = []
    for each in sorted(found, key=lambda each: (each.marker_id, each.rank)):
        same = [other for other in kept if other.marker_id == each.marker_id]
        if not any(_overlap(each.corners, other.corners) for other in same):
            kept.append(each)
    return kept


def _best_ids(found: list[_Reading]) -> list[_Reading]:
    """Return the readings without those at whose place another id has fewer wrong cells.

    The search for partly hidden boards takes known ids alone, so that it may read a whole board of another id, too.
    """
    return [
        each
        for each in found
        if not any(
            other.rank.wrong_bits < each.rank.wrong_bits and _overlap(each.corners, other.corners) for other in found
        )
    ]


def _overlap(a: Float[np.ndarray, "4 2"], b: Float[np.ndarray, "4 2"]) -> bool:
    """Return whether the middles of two outlines are nearer than half the side of the larger one."""
    side = max(np.linalg.norm(each - np.roll(each, 1, 0), axis=-1).mean() for each in (a, b))
    return bool(np.linalg.norm(a.mean(0) - b.mean(0)) < 0.5 * side)


def _detector(cv2: Any, longest: int, config: DetectorConfig, window: int) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window
    parameters.minMarkerPerimeterRate = 4.0 * config.least_pixels * config.enlarge / longest
    alone = config.corners == "none"
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE if alone else cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(dictionary_of(config.family), parameters)


def _rank(
    cv2: Any, grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], cells: Bool[np.ndarray, "n n"]
) -> _Rank:
    """Return how badly the cells in an outline read as those of a marker."""
    across, fine = len(cells), 8
    square = fine * across * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) - 0.5
    flat = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), square.astype(np.float32))
    seen = cv2.warpPerspective(grey, flat, (fine * across, fine * across), flags=cv2.INTER_LINEAR)
    # Only the middle of each cell: its edge is blurred with its neighbours.
    middle = seen.reshape(across, fine, across, fine)[:, 2:6, :, 2:6].mean((1, 3))
    white, black = middle[cells].mean(), middle[~cells].mean()
    return _Rank(int(((middle > 0.5 * (white + black)) != cells).sum()), float(black - white))
