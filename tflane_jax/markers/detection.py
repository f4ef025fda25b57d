"""Finding fiducial markers in calibrated images: which, where, turned how, and how sure (section III of the paper).

OpenCV (extra `images`) finds the squares and reads their ids; pose, score and the choice between the two poses that a
square can have are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv
from tflane_jax.geometry import invert_pose, pose_matrix, transform_points
from tflane_jax.geometry.cameras import project
from tflane_jax.markers.corner_refinement import refine_corners
from tflane_jax.scene import CameraViews
from tflane_jax.scene.marker_patterns import MarkerFamily, cells_across, correctable_bits, dictionary_of, marker_cells

# Corners of a marker of size 2 in its own frame, in OpenCV's order: upper left, upper right, lower right, lower left.
_SQUARE = np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)])
# Errors below this are alike, pixels: it keeps the ratio of two perfect fits at 1.
_EXACT = 1e-3
# Score: pixels of a cell's side and error of the fit (pixels) at which their factors fall to 1 - 1/e and exp(-1/2).
_CELL, _ERROR = 2.0, 1.0
# Widths of the windows of OpenCV's thresholds, pixels: its defaults.
_WINDOWS = (3, 13, 23)
# Moves the corners by less than a ten-thousandth of a pixel.
_NUDGE = 3e-8 * np.array([(1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (-1.0, 1.0)])


@dataclass(frozen=True)
class DetectorConfig:
    """How markers are looked for.

    Attributes:
        family: dictionary of the markers.
        size: side of the black square, metres.
        capacity: most markers reported for a frame; the best scores stay.
        corners: "pattern" moves the corners until the printed cells fit the image best, "subpixel" finds each corner
            between the pixels by itself, "none" takes the pixels of the outline.
        enlarge: each image is enlarged so many times before the search, which finds smaller markers and takes longer.
        least_pixels: shorter sides are not looked at, pixels of the given image.
        ambiguous: where the better of the two poses fits less than so many times better than the other (ratio of errors
            above this), the prior chooses; 1 never asks the prior.
        tilt, turn: standard deviations of the prior, radians: how far the marker's y axis leans from the vertical, and
            how far its face is turned away from the camera.
    """

    family: MarkerFamily = MarkerFamily.ARUCO_5X5_100
    size: float = 1.0
    capacity: int = 16
    corners: Literal["pattern", "subpixel", "none"] = "pattern"
    enlarge: int = 1
    least_pixels: float = 8.0
    ambiguous: float = 0.6
    tilt: float = 0.05
    turn: float = 0.8

    def validate(self) -> None:
        """Raise UserError for numbers that mean nothing."""
        for name, least in (("capacity", 1), ("enlarge", 1)):
            if getattr(self, name) < least:
                raise UserError(f"DetectorConfig.{name} must be at least {least}, not {getattr(self, name)}")
        for name in ("size", "least_pixels", "tilt", "turn"):
            if not getattr(self, name) > 0.0:
                raise UserError(f"DetectorConfig.{name} must be positive, not {getattr(self, name)}")


class ImageMarkers(NamedTuple):
    """K markers found in one image, ids ascending and each once.

    Attributes:
        marker_id: (K,).
        corners: (K, 4, 2) pixels from the image's corner: upper left, upper right, lower right, lower left of the
            black square as printed.
        wrong_bits: (K,) cells whose brightness is on the wrong side, border included.
    """

    marker_id: Int[np.ndarray, " k"]
    corners: Float[np.ndarray, "k 4 2"]
    wrong_bits: Int[np.ndarray, " k"]


class SquarePose(NamedTuple):
    """The two poses that a square can have.

    Attributes:
        camera_from_marker: (2, 4, 4) the preferred one first.
        error: (2,) root mean square distance between seen and projected corners, pixels.
    """

    camera_from_marker: Float[np.ndarray, "2 4 4"]
    error: Float[np.ndarray, "2"]

    @property
    def ambiguity(self) -> float:
        """Smaller over greater error, 0 (only one pose fits) to 1 (both fit alike)."""
        return float((self.error.min() + _EXACT) / (self.error.max() + _EXACT))


class DetectedMarkers(NamedTuple):
    """Markers found in the images of one frame, the best score first; what is not valid is padding.

    Attributes:
        marker_id: (M,) int32.
        pose: (M, 4, 4) ego_from_marker, metres (frame: `tflane_jax.markers`).
        score: (M,) 0 to 1, see `detection_score`.
        reprojection: (M,) root mean square distance between seen and projected corners, pixels.
        ambiguity: (M,) 0 (only one pose fits) to 1 (both fit alike).
        camera: (M,) int32 view of the frame that it was taken from.
        valid: (M,).
    """

    marker_id: Int[np.ndarray, " m"]
    pose: Float[np.ndarray, "m 4 4"]
    score: Float[np.ndarray, " m"]
    reprojection: Float[np.ndarray, " m"]
    ambiguity: Float[np.ndarray, " m"]
    camera: Int[np.ndarray, " m"]
    valid: Bool[np.ndarray, " m"]

    @classmethod
    def empty(cls, capacity: int) -> DetectedMarkers:
        """Return room for `capacity` markers and none valid."""
        number, real = np.zeros(capacity, np.int32), np.zeros(capacity, np.float32)
        pose = np.tile(np.eye(4, dtype=np.float32), (capacity, 1, 1))
        return cls(number, pose, real, real.copy(), real.copy(), number.copy(), np.zeros(capacity, bool))


def detect(views: CameraViews, config: DetectorConfig = DetectorConfig()) -> DetectedMarkers:
    """Return the markers in all images of a frame; of an id that several images show, or one shows twice, the best.

    Views that are not valid, and pixels beyond a view's size, are not looked at. Raises UserError without OpenCV or for
    a config that means nothing.
    """
    rows: dict[int, tuple[float, int, np.ndarray, float, float]] = {}
    for number in np.flatnonzero(np.asarray(views.valid)).tolist():
        width, height = np.asarray(views.size[number]).tolist()
        intrinsics = np.asarray(views.intrinsics[number], np.float64)
        camera_from_ego = np.asarray(views.camera_from_ego[number], np.float64)
        found = find_markers(np.asarray(views.image[number])[:height, :width], config)
        for marker_id, corners, wrong in zip(found.marker_id.tolist(), found.corners, found.wrong_bits, strict=True):
            fit = solve_square(corners, intrinsics, camera_from_ego, config)
            if not np.isfinite(fit.error[0]):
                continue
            score = detection_score(corners, int(wrong), float(fit.error[0]), config.family)
            if marker_id not in rows or score > rows[marker_id][0]:
                pose = invert_pose(camera_from_ego) @ fit.camera_from_marker[0]
                rows[marker_id] = (score, number, pose, float(fit.error[0]), fit.ambiguity)
    answer = DetectedMarkers.empty(config.capacity)
    # Equal scores stay in the order of ids, so that the answer does not depend on the order of the views.
    best = sorted(rows, key=lambda marker_id: (-rows[marker_id][0], marker_id))[: config.capacity]
    for place, marker_id in enumerate(best):
        score, camera, pose, error, ambiguity = rows[marker_id]
        for column, value in zip(answer, (marker_id, pose, score, error, ambiguity, camera, True), strict=True):
            column[place] = value
    return answer


def find_markers(
    image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"], config: DetectorConfig = DetectorConfig()
) -> ImageMarkers:
    """Return the markers of the family in an image without lens distortion, RGB or grey; of an id that is found twice,
    the one whose cells are read best.

    Raises UserError without OpenCV or for a config that means nothing.
    """
    config.validate()
    cv2 = opencv()
    if min(image.shape[:2]) < config.least_pixels:
        return ImageMarkers(np.zeros(0, int), np.zeros((0, 4, 2)), np.zeros(0, int))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else np.ascontiguousarray(image)
    if config.enlarge > 1:
        grey = cv2.resize(grey, None, fx=config.enlarge, fy=config.enlarge, interpolation=cv2.INTER_CUBIC)
    # Before a bright sky the white margin looks as dark as the square at some widths of the threshold's window, and the
    # outline is that of the board. OpenCV tries the outermost outline first; each width by itself, the best is kept.
    best: dict[int, tuple[tuple[int, float], np.ndarray]] = {}
    for width in _WINDOWS:
        outlines, ids, _ = _detector(cv2, max(grey.shape), config, width).detectMarkers(grey)
        # OpenCV counts from the middle of the first pixel, we from its corner.
        squares = np.asarray(outlines, np.float64).reshape(-1, 4, 2) + 0.5
        for marker_id, corners in zip([] if ids is None else np.ravel(ids).tolist(), squares, strict=True):
            cells = marker_cells(config.family, marker_id)
            if config.corners == "pattern":
                corners = refine_corners(grey, corners, cells)
            rank = _fit(cv2, grey, corners, cells)
            if marker_id not in best or rank < best[marker_id][0]:
                best[marker_id] = rank, corners
    return ImageMarkers(
        np.array(sorted(best), int),
        np.array([best[marker_id][1] for marker_id in sorted(best)]).reshape(-1, 4, 2) / config.enlarge,
        np.array([best[marker_id][0][0] for marker_id in sorted(best)], int),
    )


def _detector(cv2: Any, longest: int, config: DetectorConfig, window: int) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window
    parameters.minMarkerPerimeterRate = 4.0 * config.least_pixels * config.enlarge / longest
    alone = config.corners == "none"
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE if alone else cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(dictionary_of(config.family), parameters)


def _fit(
    cv2: Any, grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], cells: Bool[np.ndarray, "n n"]
) -> tuple[int, float]:
    """Return how many cells look white that are black, or black that are white, and less the contrast of the others,
    0 to 255: the smaller, the better."""
    across, fine = len(cells), 8
    square = fine * across * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) - 0.5
    flat = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), square.astype(np.float32))
    seen = cv2.warpPerspective(grey, flat, (fine * across, fine * across), flags=cv2.INTER_LINEAR)
    # The middle of each cell: its edge mixes with its neighbours.
    middle = seen.reshape(across, fine, across, fine)[:, 2:6, :, 2:6].mean((1, 3))
    white, black = middle[cells].mean(), middle[~cells].mean()
    return int(((middle > 0.5 * (white + black)) != cells).sum()), float(black - white)


def solve_square(
    corners: Float[np.ndarray, "4 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    camera_from_ego: Float[np.ndarray, "4 4"],
    config: DetectorConfig = DetectorConfig(),
) -> SquarePose:
    """Return both poses of a marker whose corners are seen (in the order of `ImageMarkers`), the preferred one first.

    A square seen from afar looks nearly the same when its face is mirrored about the line of sight, so that four
    corners fit two poses (infinitesimal plane-based pose estimation, Collins and Bartoli 2014; OpenCV's IPPE_SQUARE).
    The rule: the pose with the smaller error is preferred, unless the ratio of both errors is above `config.ambiguous`.
    Then the prior prefers the one with the smaller (lean / tilt)^2 + (turned / turn)^2 + (error / least error)^2, with
    lean the angle between the marker's y axis and the ego frame's z axis (a marker stands upright on its post), and
    turned the angle between its z axis and the direction to the camera (it faces those whom it addresses).
    """
    cv2 = opencv()
    square = 0.5 * config.size * _SQUARE
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(np.asarray(intrinsics, np.float64)).T
    # A marker that faces the camera is turned by half a circle, where OpenCV's rotation vectors break down (always for
    # an upright marker before a level camera). Seen in a mirror, y turned round, it is hardly turned at all; its own z
    # is turned round as well, of which a flat square shows nothing.
    seen = rays[:, :2] / rays[:, 2:] * [1.0, -1.0]
    count, turns, places = _two_poses(cv2, square, seen)
    if not np.isfinite(turns).all():
        # Seen exactly from the front, one of them is the root of a number that rounding makes negative.
        count, turns, places = _two_poses(cv2, square, seen + _NUDGE)
    mirror, back = np.array([1.0, -1.0, 1.0]), np.array([1.0, 1.0, -1.0])
    rotation = mirror[:, None] * np.stack([cv2.Rodrigues(turn)[0] for turn in turns]) * back
    poses = pose_matrix(rotation, mirror * places)
    if count == 1:
        poses = np.concatenate([poses, poses])
    pixels, _, _ = project(square[None], np.asarray(intrinsics, np.float64), poses)
    error = np.sqrt(((pixels - corners) ** 2).sum(-1).mean(-1))
    order = np.argsort(error, kind="stable")
    fit = SquarePose(poses[order], error[order])
    if fit.ambiguity <= config.ambiguous:
        return fit
    up = np.asarray(camera_from_ego, np.float64)[:3, 2]
    toward = -fit.camera_from_marker[:, :3, 3]
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    lean = np.arccos(np.clip(fit.camera_from_marker[:, :3, 1] @ up, -1.0, 1.0))
    turned = np.arccos(np.clip((fit.camera_from_marker[:, :3, 2] * toward).sum(-1), -1.0, 1.0))
    worse = (fit.error + _EXACT) / (fit.error.min() + _EXACT)
    cost = (lean / config.tilt) ** 2 + (turned / config.turn) ** 2 + worse**2
    order = np.argsort(cost, kind="stable")
    return SquarePose(fit.camera_from_marker[order], fit.error[order])


def _two_poses(
    cv2: Any, square: Float[np.ndarray, "4 3"], seen: Float[np.ndarray, "4 2"]
) -> tuple[int, Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return how many poses there are, their rotation vectors, and their places."""
    count, turns, places, _ = cv2.solvePnPGeneric(
        square, np.ascontiguousarray(seen), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return count, np.reshape(turns, (-1, 3)), np.reshape(places, (-1, 3))


def detection_score(corners: Float[np.ndarray, "4 2"], wrong_bits: int, error: float, family: MarkerFamily) -> float:
    """Return how far a detection may be trusted, 0 to 1: the product of three factors.

    - bits: 1 - h / (c + 1), at least 0; h wrong cells, of which c can be corrected in this family,
    - size: 1 - exp(-p / 2); p mean side of a cell in pixels,
    - fit: exp(-e^2 / 2); e reprojection error in pixels.

    Args:
        corners: of the black square, pixels.
        wrong_bits: cells that were read wrong.
        error: reprojection error of the pose, pixels.
        family: of the marker.
    """
    side = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=-1).mean()
    bits = max(0.0, 1.0 - wrong_bits / (correctable_bits(family) + 1.0))
    size = 1.0 - np.exp(-side / cells_across(family) / _CELL)
    return float(bits * size * np.exp(-0.5 * (error / _ERROR) ** 2))


def marker_outline(
    pose: Float[np.ndarray, "4 4"],
    size: float,
    intrinsics: Float[np.ndarray, "3 3"],
    camera_from_ego: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "4 2"]:
    """Return the pixels of a marker's corners, in the order of `ImageMarkers`; what lies behind the camera is zeros.

    Args:
        pose: ego_from_marker.
        size: side of the black square, metres.
        intrinsics, camera_from_ego: of the camera.
    """
    return project(transform_points(pose, 0.5 * size * _SQUARE), intrinsics, camera_from_ego)[0]
