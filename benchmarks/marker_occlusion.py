"""Markers behind posts and leaves, dirty, shadowed and blurred, on real photographs: ours against OpenCV's detector.

    python -m benchmarks.marker_occlusion --out runs/bench

A board of 1 m is composited into photographs of roads (nuScenes and TuSimple below $TFLANE_SHARED/data, or noise and
rectangles where there are none) at several distances, turned by up to 40 degrees. Damage is drawn on the board; the
same composites, cut out around the board, go to every detector. All poses come from `solve_square`. "found" is the
fraction of boards whose id is read at their place; "error" the median error of the distance. False ids are all others,
and all in the whole photographs without boards.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.timing import machine, markdown_table, save
from tflane_jax.files.images import PHOTO_SUFFIXES, read_image
from tflane_jax.markers.image_search import DetectorConfig, ImageMarkers, find_markers
from tflane_jax.markers.square_pose import marker_outline, solve_square
from tflane_jax.scene.marker_patterns import MarkerFamily, board_cells, board_size, cells_across, dictionary_of
from tflane_jax.world.roads.markers import marker_pose

FAMILY = MarkerFamily.ARUCO_5X5_100
DISTANCES = (10.0, 20.0, 30.0, 40.0)
DAMAGE = (
    "none",
    "bar 2 %",
    "bar 10 %",
    "bar 20 %",
    "corner",
    "side 25 %",
    "dirt",
    "shadow 65 %",
    "leaf shadows",
    "blur",
)
DETECTORS = ("OpenCV", "outlines", "all")
# Pixels of a cell on the painted board, and cells around the board that damage may cover too.
_FINE, _AROUND = 16, 2
# Horizontal focal length as a fraction of the image width, as nuScenes' front camera has it.
_FOCAL = 0.79
# The part of a photograph that is searched reaches this far around a board, in addition to its own size, pixels.
_PART = 120
# Ego frame (x ahead, y left, z up) to camera frame.
CAMERA = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Composite:
    """A photograph with a board.

    Attributes:
        image: RGB.
        marker_id, outline: of the board; pixels.
        camera: intrinsics.
        distance: metres.
        damage: one of `DAMAGE`.
    """

    image: np.ndarray
    marker_id: int
    outline: np.ndarray
    camera: np.ndarray
    distance: float
    damage: str


def photographs() -> list[np.ndarray]:
    """Return photographs of roads, or invented pictures where the shared data are absent."""
    root = Path(os.environ.get("TFLANE_SHARED", Path(__file__).parents[2] / "shared")) / "data"
    found = [
        path
        for folder in ("nuscenes_keyframe", "tusimple")
        for path in sorted((root / folder).rglob("*"))
        if path.suffix.lower() in PHOTO_SUFFIXES
    ]
    if not found:
        print(f"no photographs below {root}: invented pictures instead")
        return [_invented(np.random.default_rng(seed)) for seed in range(6)]
    return [read_image(path) for path in found]


def _invented(rng: np.random.Generator) -> np.ndarray:
    image = np.full((900, 1600, 3), 120, np.uint8)
    for _ in range(150):
        (x, y), (w, h) = rng.integers(0, (1600, 900)), rng.integers(5, 200, 2)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 255, 3).tolist(), -1)
    return np.clip(image + 6.0 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)


def composites(photos: Sequence[np.ndarray], repeats: int) -> Iterator[Composite]:
    """Yield a board for each photograph, distance, damage and repeat."""
    for number, photo in enumerate(photos):
        for distance in DISTANCES:
            for kind, damage in enumerate(DAMAGE):
                for repeat in range(repeats):
                    yield composite(
                        photo, distance, damage, np.random.default_rng([number, int(distance), kind, repeat])
                    )


def composite(photo: np.ndarray, distance: float, damage: str, rng: np.random.Generator) -> Composite:
    """Return the part of a photograph around a damaged board."""
    height, width = photo.shape[:2]
    focal = _FOCAL * width
    camera = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    marker_id, turn = int(rng.integers(100)), np.deg2rad(rng.uniform(-40.0, 40.0))
    aside = rng.uniform(-0.3, 0.3) * distance
    pose = marker_pose(np.array([[distance, aside, rng.uniform(0.5, 2.0)]]), np.array([np.pi + turn]))[0]
    outline = marker_outline(pose, 1.0, camera, CAMERA)
    board, alpha = _board(marker_id, damage, rng)
    size = _AROUND / cells_across(FAMILY) + 0.5 * board_size(FAMILY, 1.0)
    corners = marker_outline(pose, 2.0 * size, camera, CAMERA)
    image = _paint(photo, board, alpha, corners, damage, rng)
    around = _PART + (outline.max(0) - outline.min(0)).max()
    low = np.maximum(np.floor(outline.min(0) - around), 0).astype(int)
    high = np.minimum(np.ceil(outline.max(0) + around), (width, height)).astype(int)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    camera[:2, 2] -= low
    return Composite(part, marker_id, outline - low, camera, distance, damage)


def _board(marker_id: int, damage: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return brightness (0 to 1) and opacity of a board with `_AROUND` cells around it."""
    cells = board_cells(FAMILY, marker_id)
    board = np.pad(np.kron(np.where(cells, 0.9, 0.1), np.ones((_FINE, _FINE))), _AROUND * _FINE)
    alpha = np.pad(np.ones((len(cells) * _FINE,) * 2), _AROUND * _FINE)
    side, whole, start = len(cells) * _FINE, len(board), _AROUND * _FINE
    y, x = np.mgrid[:whole, :whole].astype(float)

    def cover(where: np.ndarray, tone: float) -> None:
        board[where], alpha[where] = tone, 1.0

    angle = rng.uniform(-0.35, 0.35)
    if damage.startswith("bar"):
        share = float(damage.split()[1]) / 100.0
        middle = start + rng.uniform(0.15, 0.85) * side
        across = (x - middle) * np.cos(angle) + (y - 0.5 * whole) * np.sin(angle)
        cover(np.abs(across) < 0.5 * share * side, rng.uniform(0.15, 0.7))
    elif damage == "corner":
        radius = rng.uniform(0.3, 0.42) * side
        corner = start + side * rng.integers(0, 2, 2)
        ragged = 1.0 + 0.2 * np.sin(7.0 * np.arctan2(y - corner[1], x - corner[0]) + rng.uniform(0.0, 6.0))
        cover(np.hypot(x - corner[0], y - corner[1]) < radius * ragged, rng.uniform(0.15, 0.4))
    elif damage == "side 25 %":
        edge = start + 0.25 * side * (1.0 + 0.15 * np.sin(0.06 * y + rng.uniform(0.0, 6.0)))
        covered = x < edge
        for _ in range(rng.integers(4)):
            covered = np.rot90(covered)
        cover(covered, rng.uniform(0.15, 0.4))
    elif damage == "dirt":
        noise = cv2.GaussianBlur(rng.standard_normal(board.shape), (0, 0), 0.06 * side)
        amount = np.clip(2.5 * (noise / noise.std() - 0.4), 0.0, 0.85)
        board[:] = np.where(alpha > 0.0, (1.0 - amount) * board + amount * 0.35, board)
    elif damage == "shadow 65 %":
        turn, offset = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.25, 0.25) * side
        away = (x - 0.5 * whole) * np.cos(turn) + (y - 0.5 * whole) * np.sin(turn)
        board *= np.where(away > offset, 0.35, 1.0)
    elif damage == "leaf shadows":
        noise = cv2.GaussianBlur(rng.standard_normal(board.shape), (0, 0), 0.05 * side)
        board *= np.where(noise > 0.3 * noise.std(), 0.4, 1.0)
    return board, alpha


def _paint(
    photo: np.ndarray, board: np.ndarray, alpha: np.ndarray, corners: np.ndarray, damage: str, rng: np.random.Generator
) -> np.ndarray:
    """Return the photograph with the board in front of it, blurred by the lens and with the camera's noise."""
    image, more = photo.astype(np.float32), 4
    low = np.maximum(np.floor(corners.min(0)).astype(int) - 12, 0)
    high = np.minimum(np.ceil(corners.max(0)).astype(int) + 12, photo.shape[1::-1])
    width, height = (high - low).tolist()
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32) * len(board) - 0.5
    target = (more * (corners - low) - 0.5).astype(np.float32)
    matrix = cv2.getPerspectiveTransform(square, target)
    warped = [
        cv2.resize(
            cv2.warpPerspective(each.astype(np.float32), matrix, (more * width, more * height), flags=cv2.INTER_AREA),
            (width, height),
            interpolation=cv2.INTER_AREA,
        )
        for each in (board * alpha, alpha)
    ]
    sigma = 0.6 if damage != "blur" else rng.uniform(1.2, 1.8)
    shown, opacity = (cv2.GaussianBlur(each, (0, 0), sigma) for each in warped)
    part = image[low[1] : high[1], low[0] : high[0]]
    light = rng.uniform(110.0, 240.0)
    noise = 2.0 * rng.standard_normal(part.shape)
    part[:] = part * (1.0 - opacity[..., None]) + light * shown[..., None] + noise * (opacity[..., None] > 0.0)
    return np.clip(image, 0, 255).astype(np.uint8)


def search(image: np.ndarray, detector: str) -> ImageMarkers:
    """Return what a detector finds."""
    if detector != "OpenCV":
        return find_markers(image, DetectorConfig(FAMILY, search="outlines" if detector == "outlines" else "all"))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    finder: Any = cv2.aruco.ArucoDetector(dictionary_of(FAMILY), parameters)
    outlines, ids, _ = finder.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    corners = np.asarray(outlines, np.float64).reshape(-1, 4, 2) + 0.5
    found = np.zeros(0, int) if ids is None else np.ravel(ids).astype(int)
    return ImageMarkers(found, corners, np.zeros(len(found), int))


def run(out: Path, repeats: int, most: int, only: Sequence[str] = DETECTORS) -> dict[str, Any]:
    """Compare the detectors, print the tables and return the record."""
    photos = photographs()
    photos = photos[:: -(-len(photos) // most)]
    hits: dict[tuple[str, str, float], list[float]] = {}
    false, seconds = dict.fromkeys(only, 0), dict.fromkeys(only, 0.0)
    for photo in photos:
        for detector in only:
            false[detector] += len(search(photo, detector).marker_id)
    count = 0
    for each in composites(photos, repeats):
        count += 1
        for detector in only:
            start = time.perf_counter()
            found = search(each.image, detector)
            seconds[detector] += time.perf_counter() - start
            side = np.linalg.norm(each.outline[0] - each.outline[2])
            place = np.linalg.norm(found.corners.mean(1) - each.outline.mean(0), axis=-1) < 0.2 * side
            right = place & (found.marker_id == each.marker_id)
            false[detector] += int((~right).sum())
            error = np.nan
            if right.any():
                fit = solve_square(found.corners[int(np.argmax(right))], each.camera, CAMERA)
                truth = solve_square(each.outline, each.camera, CAMERA)
                error = abs(float(fit.camera_from_marker[0, 2, 3] - truth.camera_from_marker[0, 2, 3]))
            hits.setdefault((detector, each.damage, each.distance), []).append(error)
    rows = []
    for damage in DAMAGE:
        for detector in only:
            row: list[str] = [damage, detector]
            for distance in DISTANCES:
                errors = np.array(hits[detector, damage, distance])
                seen = np.isfinite(errors)
                error = f"{np.median(errors[seen]):.2f}" if seen.any() else "-"
                row.append(f"{seen.mean():.2f} ({error})")
            rows.append(row)
    columns = ["damage", "detector", *(f"found (error m) at {distance:g} m" for distance in DISTANCES)]
    table = markdown_table(columns, rows)
    totals = [
        [
            detector,
            f"{np.mean([np.isfinite(e) for key, errors in hits.items() if key[0] == detector for e in errors]):.3f}",
            str(false[detector]),
            f"{seconds[detector] / count:.2f}",
        ]
        for detector in only
    ]
    summary = markdown_table(["detector", "found", "false ids", "s an image"], totals)
    text = f"{count} composites on {len(photos)} photographs\n\n{summary}\n\n{table}"
    print(text)
    record = {"machine": machine(), "rows": rows, "totals": totals, "composites": count, "photographs": len(photos)}
    save(out, "marker_occlusion", record, text)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--photographs", type=int, default=16, help="most photographs")
    parser.add_argument("--detectors", nargs="+", choices=DETECTORS, default=list(DETECTORS))
    options = parser.parse_args()
    run(options.out, options.repeats, options.photographs, options.detectors)


if __name__ == "__main__":
    main()
