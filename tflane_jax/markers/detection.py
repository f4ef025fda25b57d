"""Detection of fiducial markers in calibrated images: ids, poses and scores (marker paper, section III).

OpenCV (extra `images`) finds the squares and decodes their ids. This file computes the pose, resolves the ambiguity
between the two poses of a square, and computes the score.
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
# Added to both errors of a pose ratio, so that the ratio of two perfect fits is 1, pixels.
_EXACT = 1e-3
# Scales of the score, pixels: side of a cell whose factor is 1 - 1/e, reprojection error whose factor is exp(-1/2).
_CELL, _ERROR = 2.0, 1.0
# Window widths of OpenCV's adaptive threshold, pixels: its defaults.
_WINDOWS = (3, 13, 23)
# Moves the corners by less than a ten-thousandth of a pixel.
_NUDGE = 3e-8 * np.array([(1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (-1.0, 1.0)])


@dataclass(frozen=True)
class DetectorConfig:
    """Settings of the detector.

    Attributes:
        family: dictionary of the markers.
        size: side of the black square, metres.
        capacity: most markers reported per frame; the best scores are kept.
        corners: "pattern" fits all printed cells to the image, "subpixel" refines each corner separately, "none" keeps
            the pixels of the outline.
        enlarge: factor by which images are enlarged before the search; a larger one finds smaller markers, more slowly.
        least_pixels: smallest side of a detected square, pixels of the given image.
        ambiguous: the prior chooses between the two poses if the ratio of the smaller to the greater error is above
            this; 1 never uses the prior.
        tilt, turn: standard deviations of the prior, radians: of the angle between the marker's y axis and the
            vertical, and of the angle between its face and the direction to the camera.
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
        """Raise UserError for numbers out of range."""
        for name, least in (("capacity", 1), ("enlarge", 1)):
            if getattr(self, name) < least:
                raise UserError(f"DetectorConfig.{name} must be at least {least}, not {getattr(self, name)}")
        for name in ("size", "least_pixels", "tilt", "turn"):
            if not getattr(self, name) > 0.0:
                raise UserError(f"DetectorConfig.{name} must be positive, not {getattr(self, name)}")


class ImageMarkers(NamedTuple):
    """K markers found in one image, with unique ascending ids.

    Attributes:
        marker_id: (K,).
        corners: (K, 4, 2) pixels from the image's corner: upper left, upper right, lower right, lower left of the
            black square as printed.
        wrong_bits: (K,) cells read with the wrong colour, border included.
    """

    marker_id: Int[np.ndarray, " k"]
    corners: Float[np.ndarray, "k 4 2"]
    wrong_bits: Int[np.ndarray, " k"]


class SquarePose(NamedTuple):
    """The two candidate poses of a square.

    Attributes:
        camera_from_marker: (2, 4, 4) the preferred one first.
        error: (2,) root mean square distance between detected and projected corners, pixels.
    """

    camera_from_marker: Float[np.ndarray, "2 4 4"]
    error: Float[np.ndarray, "2"]

    @property
    def ambiguity(self) -> float:
        """Ratio of the smaller to the greater error: 0 (only one pose fits) to 1 (both fit equally well)."""
        return float((self.error.min() + _EXACT) / (self.error.max() + _EXACT))


class DetectedMarkers(NamedTuple):
    """Markers found in the images of one frame, by descending score; rows that are not valid are padding.

    Attributes:
        marker_id: (M,) int32.
        pose: (M, 4, 4) ego_from_marker, metres (frame: `tflane_jax.markers`).
        score: (M,) 0 to 1, see `detection_score`.
        reprojection: (M,) root mean square distance between detected and projected corners, pixels.
        ambiguity: (M,) 0 (only one pose fits) to 1 (both fit equally well).
        camera: (M,) int32 index of the view it was detected in.
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
        """Return padding for `capacity` markers."""
        number, real = np.zeros(capacity, np.int32), np.zeros(capacity, np.float32)
        pose = np.tile(np.eye(4, dtype=np.float32), (capacity, 1, 1))
        return cls(number, pose, real, real.copy(), real.copy(), number.copy(), np.zeros(capacity, bool))


def detect(views: CameraViews, config: DetectorConfig = DetectorConfig()) -> DetectedMarkers:
    """Return the markers in all images of a frame; an id detected several times is reported once, with its best score.

    Invalid views, and pixels beyond a view's size, are ignored. Raises UserError without OpenCV or for an invalid
    config.
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
    # Ties are broken by id, so that the result does not depend on the order of the views.
    best = sorted(rows, key=lambda marker_id: (-rows[marker_id][0], marker_id))[: config.capacity]
    for place, marker_id in enumerate(best):
        score, camera, pose, error, ambiguity = rows[marker_id]
        for column, value in zip(answer, (marker_id, pose, score, error, ambiguity, camera, True), strict=True):
            column[place] = value
    return answer


def find_markers(
    image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"], config: DetectorConfig = DetectorConfig()
) -> ImageMarkers:
    """Return the markers of the family in an undistorted image, RGB or grey.

    An id found several times is reported once, where its cells are read best. Raises UserError without OpenCV or for an
    invalid config.
    """
    config.validate()
    cv2 = opencv()
    if min(image.shape[:2]) < config.least_pixels:
        return ImageMarkers(np.zeros(0, int), np.zeros((0, 4, 2)), np.zeros(0, int))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else np.ascontiguousarray(image)
    if config.enlarge > 1:
        grey = cv2.resize(grey, None, fx=config.enlarge, fy=config.enlarge, interpolation=cv2.INTER_CUBIC)
    # Against a bright sky some threshold windows merge the white margin with the square, and the outline is that of the
    # board. OpenCV prefers the outermost outline, so each width is tried separately and the best result is kept.
    best: dict[int, tuple[tuple[int, float], np.ndarray]] = {}
    for width in _WINDOWS:
        outlines, ids, _ = _detector(cv2, max(grey.shape), config, width).detectMarkers(grey)
        # OpenCV has its origin at the centre of the first pixel, this package at its corner.
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
    """Return the number of cells read with the wrong colour, and black minus white brightness (-255 to 255).

    Lower is better for both."""
    across, fine = len(cells), 8
    square = fine * across * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) - 0.5
    flat = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), square.astype(np.float32))
    seen = cv2.warpPerspective(grey, flat, (fine * across, fine * across), flags=cv2.INTER_LINEAR)
    # Only the middle of each cell: its edge is blurred with its neighbours.
    middle = seen.reshape(across, fine, across, fine)[:, 2:6, :, 2:6].mean((1, 3))
    white, black = middle[cells].mean(), middle[~cells].mean()
    return int(((middle > 0.5 * (white + black)) != cells).sum()), float(black - white)


def solve_square(
    corners: Float[np.ndarray, "4 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    camera_from_ego: Float[np.ndarray, "4 4"],
    config: DetectorConfig = DetectorConfig(),
) -> SquarePose:
    """Return both poses of a marker from its corners (in the order of `ImageMarkers`), the preferred one first.

    From afar a square looks nearly the same when its normal is mirrored about the line of sight, so four corners have
    two candidate poses (infinitesimal plane-based pose estimation, Collins and Bartoli 2014; OpenCV's IPPE_SQUARE).
    The pose with the smaller error is preferred, unless the ratio of both errors is above `config.ambiguous`.
    Then the prior prefers the one with the smaller (lean / tilt)^2 + (turned / turn)^2 + (error / least error)^2, with
    lean the angle between the marker's y axis and the ego frame's z axis (boards are upright), and
    turned the angle between its z axis and the direction to the camera (boards face the traffic).
    """
    cv2 = opencv()
    square = 0.5 * config.size * _SQUARE
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(np.asarray(intrinsics, np.float64)).T
    # A marker that faces the camera is rotated by about 180 degrees, where OpenCV's rotation vectors are unstable
    # (always for an upright marker and a level camera). So the problem is solved with y of the image and z of the
    # marker mirrored, where the rotation is small; z does not matter for a flat square.
    seen = rays[:, :2] / rays[:, 2:] * [1.0, -1.0]
    count, turns, places = _two_poses(cv2, square, seen)
    if not np.isfinite(turns).all():
        # Exactly from the front OpenCV takes the root of a number that rounding makes negative.
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
    """Return the number of poses, their rotation vectors and their translations."""
    count, turns, places, _ = cv2.solvePnPGeneric(
        square, np.ascontiguousarray(seen), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return count, np.reshape(turns, (-1, 3)), np.reshape(places, (-1, 3))


def detection_score(corners: Float[np.ndarray, "4 2"], wrong_bits: int, error: float, family: MarkerFamily) -> float:
    """Return the confidence of a detection, 0 to 1, as the product of three factors.

    - bits: max(0, 1 - h / (c + 1)); h wrong cells, c cells that the family can correct,
    - size: 1 - exp(-p / 2); p mean side of a cell in pixels,
    - fit: exp(-e^2 / 2); e reprojection error in pixels.

    Args:
        corners: of the black square, pixels.
        wrong_bits: cells read with the wrong colour.
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
    """Return the pixels of a marker's corners, in the order of `ImageMarkers`; corners behind the camera are zeros.

    Args:
        pose: ego_from_marker.
        size: side of the black square, metres.
        intrinsics, camera_from_ego: of the camera.
    """
    return project(transform_points(pose, 0.5 * size * _SQUARE), intrinsics, camera_from_ego)[0]
