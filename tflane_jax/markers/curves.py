"""Detection rate and pose errors of markers over distance, measured in images of the built-in world.

Counterpart of Fig. 3 of the marker paper, which assumes such curves (section IV-A): a vehicle drives along a straight
street towards three unoccluded boards beside it, which are turned by different angles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, yaw_pose
from tflane_jax.limits import NOT_EMPTY, Count, Fraction, Positive, above_at_most, check_settings
from tflane_jax.markers.image_search import DetectorConfig, find_markers
from tflane_jax.markers.square_pose import marker_outline, solve_square
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import KeyFrame, LaneSegment, Log, PlacedMarkers, Tracks, VectorMap
from tflane_jax.scene.marker_patterns import marker_count
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraMount, CameraRigConfig, draw_rig
from tflane_jax.world.cameras.sensor import render_window
from tflane_jax.world.render.camera import PinholeCamera

# Margin around a board in the rendered window, pixels, in addition to half the size of the board.
_AROUND = 24
_LANE, _HEIGHT = 3.5, 3.0
_Distance = Annotated[float, above_at_most(1, 500)]  # the street is drawn up to it


@dataclass(frozen=True)
class CurveConfig:
    """Scenes and detector of a measurement.

    Attributes:
        distances: from the camera to the boards along the street, metres.
        turns: yaw of each board from facing the traffic, degrees.
        seeds: number of scenes; each has its own weather, light, calibration and board positions.
        mounts: cameras; a board is detected in the first one whose image contains it.
        scale: of their images; 1 is native.
        severity: of weather and camera, 0 (clear day, perfect camera) to 1.
        detector: settings.
    """

    distances: Annotated[tuple[_Distance, ...], NOT_EMPTY] = tuple(map(float, range(5, 65, 5)))
    turns: Annotated[tuple[float, ...], NOT_EMPTY] = (0.0, 20.0, 40.0)
    seeds: Count = 8
    mounts: Annotated[tuple[CameraMount, ...], NOT_EMPTY] = (ARGOVERSE2_RING[0], ARGOVERSE2_RING[2])
    scale: Positive = 1.0
    severity: Fraction = 0.5
    detector: DetectorConfig = DetectorConfig()


@dataclass(frozen=True)
class Sighting:
    """One board in one image.

    Attributes:
        seed: number of the scene.
        turn: yaw of the board, degrees.
        distance: along the street, metres.
        found: its id was read; otherwise all errors are NaN.
        pixels: mean side of the black square, from the true pose.
        translation: (3,) of the estimate minus truth, along the line of sight, to the right, down, metres.
        rotation: angle between the orientation of the preferred pose and the true one, degrees.
        other: that angle of the rejected pose, degrees.
        error: reprojection error of the preferred pose, pixels.
        ambiguity: see `SquarePose`.
    """

    seed: int
    turn: float
    distance: float
    found: bool
    pixels: float
    translation: Float[np.ndarray, "3"] = field(default_factory=lambda: np.full(3, np.nan))
    rotation: float = np.nan
    other: float = np.nan
    error: float = np.nan
    ambiguity: float = np.nan


def measure(configs: Sequence[CurveConfig]) -> list[list[Sighting]]:
    """Draw every scene and return the result of each detector for each board that lies wholly in an image.

    The same configs give the same numbers. Raises UserError for an invalid config, or for configs that differ in more
    than the detector.
    """
    if not configs:
        return []
    for config in configs:
        check_settings(config, "CurveConfig.")
        if replace(config, detector=configs[0].detector) != configs[0]:
            raise UserError("detectors are compared on the same scenes: give configs that differ in the detector alone")
    found: list[list[Sighting]] = [[] for _ in configs]
    for image in _images(configs[0]):
        for sightings, config in zip(found, configs, strict=True):
            sightings += _sightings(image, config.detector)
    return found


class _Board(NamedTuple):
    """A board in an image: ego_from_marker, turn in degrees, corners in pixels of the whole image."""

    marker_id: int
    pose: Float[np.ndarray, "4 4"]
    turn: float
    outline: Float[np.ndarray, "4 2"]


@dataclass(frozen=True)
class _Image:
    """Part of an image with some boards.

    Attributes:
        pixels: (h, w, 3).
        corner: its upper left pixel in the whole image.
        camera: of the whole image.
        boards: those that lie wholly in it, and in no image before.
        seed, distance: as in `Sighting`.
    """

    pixels: UInt8[np.ndarray, "h w 3"]
    corner: tuple[int, int]
    camera: PinholeCamera
    boards: list[_Board]
    seed: int
    distance: float


def _images(config: CurveConfig) -> Iterator[_Image]:
    rig = CameraRigConfig(cameras=config.mounts, scale=config.scale, severity=config.severity, markers=True)
    for seed in range(config.seeds):
        log, turns = street(seed, config), _turns(seed, config)
        markers = log.markers
        assert markers is not None
        for number, distance in enumerate(config.distances):
            poses = invert_pose(log.keyframes[number].global_from_ego) @ markers.pose
            unseen = np.ones(len(poses), bool)
            for view, camera in enumerate(draw_rig(log.seed, rig)):
                outlines = np.stack(
                    [marker_outline(pose, markers.size, camera.intrinsics, camera.camera_from_ego) for pose in poses]
                )
                here = unseen & _in_image(outlines, camera)
                unseen &= ~here
                if not here.any():
                    continue
                boards = [
                    _Board(int(markers.marker_id[k]), poses[k], turns[k], outlines[k])
                    for k in np.flatnonzero(here).tolist()
                ]
                corner, size = _window(outlines[here], camera)
                pixels = render_window(log, number, rig, corner, size, camera=view)
                yield _Image(pixels, corner, camera, boards, seed, distance)


def _sightings(image: _Image, detector: DetectorConfig) -> list[Sighting]:
    found = find_markers(image.pixels, detector)
    sightings = []
    for board in image.boards:
        sighting = Sighting(image.seed, board.turn, image.distance, False, float(_sides(board.outline)))
        hits = np.flatnonzero(found.marker_id == board.marker_id)
        if len(hits):
            corners = found.corners[hits[0]] + image.corner
            sighting = _compared(sighting, corners, image.camera, board.pose, detector)
        sightings.append(sighting)
    return sightings


def _sides(outline: Float[np.ndarray, "*b 4 2"]) -> Float[np.ndarray, "*b"]:
    return np.linalg.norm(outline - np.roll(outline, 1, -2), axis=-1).mean(-1)


def _in_image(outlines: Float[np.ndarray, "b 4 2"], camera: PinholeCamera) -> Bool[np.ndarray, " b"]:
    """Return which boards lie in the image with their margin."""
    margin = 0.3 * _sides(outlines)[:, None, None]
    size = np.array([camera.width, camera.height])
    return np.asarray(((outlines > margin) & (outlines < size - margin)).all((1, 2)))


def _window(outlines: Float[np.ndarray, "b 4 2"], camera: PinholeCamera) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return corner and size of the part of the image that shows these boards."""
    around = _AROUND + 0.5 * _sides(outlines).max()
    low = np.maximum(np.floor(outlines.min((0, 1)) - around), 0.0).astype(int)
    high = np.minimum(np.ceil(outlines.max((0, 1)) + around), [camera.width, camera.height]).astype(int)
    (left, top), (width, height) = low.tolist(), (high - low).tolist()
    return (left, top), (width, height)


def _compared(
    sight: Sighting,
    corners: Float[np.ndarray, "4 2"],
    camera: PinholeCamera,
    ego_from_marker: Float[np.ndarray, "4 4"],
    detector: DetectorConfig,
) -> Sighting:
    """Return the sighting with the pose errors of its corners."""
    fit = solve_square(corners, camera.intrinsics, camera.camera_from_ego, detector)
    truth = camera.camera_from_ego @ ego_from_marker
    along = truth[:3, 3] / np.linalg.norm(truth[:3, 3])
    right = np.cross([0.0, 1.0, 0.0], along)
    right /= np.linalg.norm(right)
    axes = np.stack([along, right, np.cross(along, right)])
    turned = [_angle_between(pose[:3, :3], truth[:3, :3]) for pose in fit.camera_from_marker]
    return replace(
        sight,
        found=True,
        translation=axes @ (fit.camera_from_marker[0, :3, 3] - truth[:3, 3]),
        rotation=turned[0],
        other=turned[1],
        error=float(fit.error[0]),
        ambiguity=fit.ambiguity,
    )


def summarise(sightings: Sequence[Sighting]) -> list[dict[str, Any]]:
    """Return one row for each distance: detection rate, and errors of the detected boards.

    translation m: mean distance between estimate and truth; forward m: root mean square error along the line of sight;
    sideways m: the same across it; rotation: median and root mean square, degrees; wrong pose: fraction in which the
    rejected pose is nearer to the truth by more than a degree.
    """
    rows = []
    for distance in sorted({sighting.distance for sighting in sightings}):
        all_here = [sighting for sighting in sightings if sighting.distance == distance]
        here = [sighting for sighting in all_here if sighting.found]
        shift = np.array([sighting.translation for sighting in here]).reshape(-1, 3)
        turned = np.array([sighting.rotation for sighting in here])
        other = np.array([sighting.other for sighting in here])
        rows.append(
            {
                "distance m": distance,
                "boards": len(all_here),
                "pixels": _mean([sighting.pixels for sighting in all_here]),
                "found": len(here) / len(all_here),
                "translation m": _mean(np.linalg.norm(shift, axis=-1)),
                "forward m": _rms(shift[:, 0]),
                "sideways m": _rms(np.linalg.norm(shift[:, 1:], axis=-1)),
                "rotation median": float(np.median(turned)) if len(here) else np.nan,
                "rotation rms": _rms(turned),
                "wrong pose": _mean(other < turned - 1.0),
                "reprojection px": _mean([sighting.error for sighting in here]),
            }
        )
    return rows


def street(seed: int, config: CurveConfig) -> Log:
    """Return a drive along a straight empty street towards boards at its right side, with a key frame for each
    distance."""
    rng = np.random.default_rng([20_251_122, seed])
    heading, place = rng.uniform(-np.pi, np.pi), rng.uniform(-1000.0, 1000.0, 2)
    global_from_street = yaw_pose(place[0], place[1], np.asarray(heading))
    eyes = np.array([config.mounts[0].x + distance for distance in config.distances])
    keyframes = [global_from_street @ yaw_pose(-eye, np.asarray(-0.5 * _LANE), np.zeros(())) for eye in eyes]
    # The boards are side by side, so that none hides another.
    lateral = -_LANE - 1.0 - 1.8 * np.arange(len(config.turns)) - rng.uniform(0.0, 0.5)
    height = _HEIGHT + rng.uniform(-0.3, 0.3, len(config.turns))
    poses = [
        global_from_street @ _facing_back(0.0, y, z, np.deg2rad(turn))
        for y, z, turn in zip(lateral, height, _turns(seed, config), strict=True)
    ]
    ids = rng.choice(marker_count(config.detector.family), len(poses), replace=False)
    frames = len(keyframes)
    nothing = Tracks.empty(frames)
    return Log(
        name=f"markers {seed}",
        source="markers",
        map=_street_map(global_from_street, float(eyes.max())),
        timestamps_ns=np.arange(frames) * 500_000_000,
        global_from_ego=np.stack(keyframes),
        tracks=nothing,
        actors=nothing,
        keyframes=tuple(KeyFrame(int(n) * 500_000_000, keyframes[n], int(n)) for n in range(frames)),
        weather=float(rng.random()),
        paint_wear=0.5,
        seed=seed,
        markers=PlacedMarkers(ids, np.stack(poses), config.detector.size, config.detector.family),
    )


def _turns(seed: int, config: CurveConfig) -> list[float]:
    """Return the yaw of the boards from the road outwards; order and signs differ between scenes."""
    rng = np.random.default_rng([20_251_123, seed])
    return (rng.permutation(config.turns) * rng.choice([-1.0, 1.0], len(config.turns))).tolist()


def _facing_back(x: float, y: float, z: float, turn: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose of an upright marker that faces traffic along x, turned by `turn` (radians)."""
    face = np.array([-np.cos(turn), -np.sin(turn), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    pose = np.eye(4)
    pose[:3] = np.stack([np.cross(up, face), up, face, [x, y, z]], -1)
    return pose


def _street_map(global_from_street: Float[np.ndarray, "4 4"], length: float) -> VectorMap:
    ends = np.array([-length - 60.0, 60.0])

    def line(y: float) -> np.ndarray:
        local = np.column_stack([ends, np.full(2, y), np.zeros(2)])
        return local @ global_from_street[:3, :3].T + global_from_street[:3, 3]

    lanes = {
        n: LaneSegment(
            n, line(y), line(y + 0.5 * _LANE), line(y - 0.5 * _LANE), LineType.DASHED, LineType.SOLID, False, ()
        )
        for n, y in enumerate((0.5 * _LANE, -0.5 * _LANE))
    }
    # A closed ring has no open kerb, along which scenery would place trees and lamps in front of the boards.
    low, high = line(-_LANE - 0.5), line(_LANE + 0.5)
    ring = np.concatenate([low, high[::-1], low[:1]])
    return VectorMap(lanes, road_boundaries=(ring,))


def _angle_between(a: Float[np.ndarray, "3 3"], b: Float[np.ndarray, "3 3"]) -> float:
    return float(np.rad2deg(np.arccos(np.clip(0.5 * (np.trace(a.T @ b) - 1.0), -1.0, 1.0))))


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan
