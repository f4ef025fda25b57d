"""Detection of fiducial markers in calibrated images: ids, poses and scores (marker paper, section III).

`image_search` finds outlines and ids, `square_pose` the pose of each; this file joins the cameras of a frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import invert_pose
from tflane_jax.markers.image_search import DetectorConfig, ImageMarkers, find_markers
from tflane_jax.markers.square_pose import solve_square
from tflane_jax.scene import CameraViews
from tflane_jax.scene.marker_patterns import MarkerFamily, cells_across, correctable_bits

# Scales of the score, pixels: side of a cell whose factor is 1 - 1/e, reprojection error whose factor is exp(-1/2).
_CELL, _ERROR = 2.0, 1.0
# Two cameras see two boards if these are farther apart, metres and fraction of the distance (pose errors are smaller).
_APART, _APART_SHARE = 1.0, 0.2


class DetectedMarkers(NamedTuple):
    """Markers found in the images of one frame, by descending score; rows that are not valid are padding.

    An id has one row, or one for each board that carries it; those are `contradictory`.

    Attributes:
        marker_id: (M,) int32.
        pose: (M, 4, 4) ego_from_marker, metres (frame: `tflane_jax.markers`).
        score: (M,) 0 to 1, see `detection_score`.
        reprojection: (M,) root mean square distance between detected and projected corners, pixels.
        ambiguity: (M,) 0 (only one pose fits) to 1 (both fit equally well).
        camera: (M,) int32 index of the view it was detected in.
        size: (M,) side of the black square that the pose rests on, metres.
        contradictory: (M,) the id was read at another place too (another row, if the capacity allows), so that one of
            the boards is not the surveyed one.
        valid: (M,).
    """

    marker_id: Int[np.ndarray, " m"]
    pose: Float[np.ndarray, "m 4 4"]
    score: Float[np.ndarray, " m"]
    reprojection: Float[np.ndarray, " m"]
    ambiguity: Float[np.ndarray, " m"]
    camera: Int[np.ndarray, " m"]
    size: Float[np.ndarray, " m"]
    contradictory: Bool[np.ndarray, " m"]
    valid: Bool[np.ndarray, " m"]

    @classmethod
    def empty(cls, capacity: int) -> DetectedMarkers:
        """Return padding for `capacity` markers."""
        number, real = np.zeros(capacity, np.int32), np.zeros(capacity, np.float32)
        pose = np.tile(np.eye(4, dtype=np.float32), (capacity, 1, 1))
        flag = np.zeros(capacity, bool)
        return cls(number, pose, real, real.copy(), real.copy(), number.copy(), real.copy(), flag, flag.copy())


def detect(
    views: CameraViews, config: DetectorConfig = DetectorConfig(), sizes: Mapping[int, float] | None = None
) -> DetectedMarkers:
    """Return the markers in all images of a frame; a board in several cameras is reported once, with its best score.

    Invalid views, and pixels beyond a view's size, are ignored. Raises UserError without OpenCV or for an invalid
    config.

    Args:
        views: images of one frame, at the size in which markers are searched.
        config: settings.
        sizes: surveyed side of the black square by id, metres (`MarkerStore.sizes`); other ids have `config.size`. The
            distance of a marker is proportional to it.
    """
    return locate(views, [_found_in(views, number, config) for number in _valid(views)], config, sizes)


def locate(
    views: CameraViews,
    found: Sequence[ImageMarkers],
    config: DetectorConfig = DetectorConfig(),
    sizes: Mapping[int, float] | None = None,
) -> DetectedMarkers:
    """Return the markers of a frame from what was found in its images; a board found several times is reported once.

    The sighting with the best score is reported. Two boards with one id are both reported, as `contradictory`.

    Args:
        views: of the frame; only calibration and validity are used.
        found: corners and ids in each valid view, in the order of the views.
        config, sizes: see `detect`.
    """
    sightings: dict[int, list[_Sighting]] = {}
    for number, in_image in zip(_valid(views), found, strict=True):
        intrinsics = np.asarray(views.intrinsics[number], np.float64)
        camera_from_ego = np.asarray(views.camera_from_ego[number], np.float64)
        for marker_id, corners, wrong in zip(
            in_image.marker_id.tolist(), in_image.corners, in_image.wrong_bits, strict=True
        ):
            size = float((sizes or {}).get(marker_id, config.size))
            fit = solve_square(corners, intrinsics, camera_from_ego, replace(config, size=size))
            if not np.isfinite(fit.error[0]):
                continue
            score = detection_score(corners, int(wrong), float(fit.error[0]), config.family)
            pose = invert_pose(camera_from_ego) @ fit.camera_from_marker[0]
            seen = _Sighting(score, pose, float(fit.error[0]), fit.ambiguity, number, size)
            sightings.setdefault(marker_id, []).append(seen)
    answer = DetectedMarkers.empty(config.capacity)
    boards = {marker_id: _boards(seen) for marker_id, seen in sightings.items()}
    chosen = [(marker_id, best) for marker_id, several in boards.items() for best in several]
    # Ties are broken by id, so that the result does not depend on the order of the views.
    order = sorted(chosen, key=lambda each: (-each[1].score, each[0]))[: config.capacity]
    for place, (marker_id, best) in enumerate(order):
        answer.marker_id[place], answer.pose[place], answer.score[place] = marker_id, best.pose, best.score
        answer.reprojection[place], answer.ambiguity[place] = best.error, best.ambiguity
        answer.camera[place], answer.size[place], answer.valid[place] = best.camera, best.size, True
        answer.contradictory[place] = len(boards[marker_id]) > 1
    return answer


class _Sighting(NamedTuple):
    """An id in one camera: columns of `DetectedMarkers`."""

    score: float
    pose: Float[np.ndarray, "4 4"]
    error: float
    ambiguity: float
    camera: int
    size: float


def _boards(sightings: Sequence[_Sighting]) -> list[_Sighting]:
    """Return the best sighting of each board with an id."""
    boards: list[_Sighting] = []
    for seen in sorted(sightings, key=lambda each: -each.score):
        if all(_elsewhere(seen, other) for other in boards):
            boards.append(seen)
    return boards


def _elsewhere(a: _Sighting, b: _Sighting) -> bool:
    """Return whether two sightings of an id are two boards."""
    if a.camera == b.camera:
        return True
    far = max(np.linalg.norm(a.pose[:3, 3]), np.linalg.norm(b.pose[:3, 3]))
    return bool(np.linalg.norm(a.pose[:3, 3] - b.pose[:3, 3]) > _APART + _APART_SHARE * far)


def _valid(views: CameraViews) -> list[int]:
    return np.flatnonzero(np.asarray(views.valid)).tolist()


def _found_in(views: CameraViews, number: int, config: DetectorConfig) -> ImageMarkers:
    width, height = np.asarray(views.size[number]).tolist()
    return find_markers(np.asarray(views.image[number])[:height, :width], config)


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
