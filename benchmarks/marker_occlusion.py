"""Markers behind posts and leaves, dirty, shadowed and blurred, on real photographs: ours against OpenCV's detector.

    python -m benchmarks.marker_occlusion --out runs/bench                                   # parts round the board
    python -m benchmarks.marker_occlusion --whole --ids 20 --sample 20 --out runs/bench      # whole photographs

A board of 1 m is composited into photographs of roads (nuScenes and TuSimple below $TFLANE_SHARED/data, or noise and
rectangles where there are none) at several distances, turned by up to 40 degrees. Damage is drawn on the board. The
same composites go to every detector: cut out around the board, or with --whole as whole photographs. All poses come
from `solve_square`. "found" is the fraction of boards whose id is read at their place; "error" the median error of the
distance. False ids are all others, and all in the whole photographs without boards.

--ids N tells the search for partly hidden boards that the board is one of N, as a store of N boards does; OpenCV knows
of no ids. --sample N takes N composites, spread over photographs, distances and damages, and does not list distances.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from benchmarks.marker_composites import (
    CAMERA,
    DAMAGE,
    DISTANCES,
    FAMILY,
    Composite,
    Selection,
    composites,
    known_ids,
    photographs,
)
from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax.markers.image_search import DetectorConfig, ImageMarkers, find_markers
from tflane_jax.markers.square_pose import solve_square
from tflane_jax.scene.marker_patterns import dictionary_of, marker_count

DETECTORS = ("OpenCV", "outlines", "all")


def search(image: np.ndarray, detector: str, ids: tuple[int, ...] | None = None) -> ImageMarkers:
    """Return what a detector finds; `ids` are those that partly hidden boards may have."""
    if detector != "OpenCV":
        how = "outlines" if detector == "outlines" else "all"
        return find_markers(image, DetectorConfig(FAMILY, search=how, ids=ids))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    finder: Any = cv2.aruco.ArucoDetector(dictionary_of(FAMILY), parameters)
    outlines, read, _ = finder.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    corners = np.asarray(outlines, np.float64).reshape(-1, 4, 2) + 0.5
    found = np.zeros(0, int) if read is None else np.ravel(read).astype(int)
    return ImageMarkers(found, corners, np.zeros(len(found), int))


def run(out: Path, selection: Selection, most: int, only: Sequence[str] = DETECTORS) -> dict[str, Any]:
    """Compare the detectors, print the tables and return the record; `most` photographs, "only" these detectors."""
    photos = photographs()
    photos = photos[:: -(-len(photos) // most)]
    errors: dict[tuple[str, str, float], list[float]] = {}
    false, seconds = dict.fromkeys(only, 0), dict.fromkeys(only, 0.0)
    for number, photo in enumerate(photos):
        known = None if selection.ids is None else known_ids(number, selection.ids, np.random.default_rng(number))
        for detector in only:
            false[detector] += len(search(photo, detector, known).marker_id)
    count = 0
    for each in tqdm(composites(photos, selection), desc="composites", unit="image"):
        count += 1
        for detector in only:
            start = time.process_time()
            found = search(each.image, detector, each.ids)
            seconds[detector] += time.process_time() - start
            right = _right(found, each)
            false[detector] += int((~right).sum())
            errors.setdefault((detector, each.damage, each.distance), []).append(_error(found, right, each))
    # A sample has too few boards at each distance.
    groups = {f" at {each:g} m": (each,) for each in DISTANCES} if selection.sample is None else {"": DISTANCES}
    rows, totals = [], []
    for damage, detector in product(DAMAGE, only):
        cells = [_pooled(errors, detector, (damage,), distances) for distances in groups.values()]
        if any(len(cell) for cell in cells):
            rows.append([damage, detector, *(f"{np.isfinite(cell).mean():.2f} ({_median(cell)})" for cell in cells)])
    for detector in only:
        cell = _pooled(errors, detector, DAMAGE, DISTANCES)
        fraction, each = f"{np.isfinite(cell).mean():.3f}", f"{seconds[detector] / count:.2f}"
        totals.append([detector, fraction, _median(cell), str(false[detector]), each])
    table = markdown_table(["damage", "detector", *(f"found (error m){name}" for name in groups)], rows)
    summary = markdown_table(["detector", "found", "error m", "false ids", "CPU s an image"], totals)
    what = "whole photographs" if selection.shown == "whole" else "parts of photographs"
    ids = "all ids of the family" if selection.ids is None else f"{selection.ids} ids"
    text = f"{count} composites, {what}, on {len(photos)} photographs; {ids} possible\n\n{summary}\n\n{table}"
    print(text)
    record = {"machine": machine(), "rows": rows, "totals": totals, "composites": count, "photographs": len(photos)}
    save(out, "marker_occlusion", record | {"selection": asdict(selection)}, text)
    return record


def _right(found: ImageMarkers, truth: Composite) -> np.ndarray:
    """Return which of the found markers are the board at its place."""
    side = np.linalg.norm(truth.outline[0] - truth.outline[2])
    place = np.linalg.norm(found.corners.mean(1) - truth.outline.mean(0), axis=-1) < 0.2 * side
    return place & (found.marker_id == truth.marker_id)


def _error(found: ImageMarkers, right: np.ndarray, truth: Composite) -> float:
    """Return the error of the distance, metres; NaN for a board that is not found."""
    if not right.any():
        return np.nan
    fit = solve_square(found.corners[int(np.argmax(right))], truth.camera, CAMERA)
    true = solve_square(truth.outline, truth.camera, CAMERA)
    return abs(float(fit.camera_from_marker[0, 2, 3] - true.camera_from_marker[0, 2, 3]))


def _pooled(
    errors: dict[tuple[str, str, float], list[float]], detector: str, damages: Sequence[str], distances: Sequence[float]
) -> np.ndarray:
    return np.array([e for key in product((detector,), damages, distances) for e in errors.get(key, [])])


def _median(errors: np.ndarray) -> str:
    seen = errors[np.isfinite(errors)]
    return f"{np.median(seen):.2f}" if len(seen) else "-"


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, rounds=1)
    parser.add_argument("--photographs", type=int, default=16, help="most photographs")
    parser.add_argument("--detectors", nargs="+", choices=DETECTORS, default=list(DETECTORS))
    parser.add_argument("--whole", action="store_true", help="search whole photographs, not parts of them")
    parser.add_argument("--ids", type=int, help="number of possible ids (default: all of the family)")
    parser.add_argument("--sample", type=int, help="number of composites (default: all)")
    options = parser.parse_args()
    if options.ids is not None and options.ids > marker_count(FAMILY):
        parser.error(f"--ids is at most {marker_count(FAMILY)}, the ids of {FAMILY.name}")
    selection = Selection(options.rounds, options.sample, "whole" if options.whole else "part", options.ids)
    run(options.out, selection, options.photographs, options.detectors)


if __name__ == "__main__":
    main()
