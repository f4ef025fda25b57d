"""`tflane markers detect` and `tflane markers curves`.

`detect` writes one picture for each photo, with the outline and the axes of every marker (x red, y green, z blue), and
detections.json:
    {"family", "size", "photos": [{"file", "picture", "markers": [{"id", "score", "position", "distance", "turn",
     "reprojection", "ambiguity", "contradictory", "corners", "pose"}, ...]}, ...],
     "faults": [{"file", "error"}, ...]}
    Position and pose (ego_from_marker, 4 x 4) are in the ego frame, on the ground below the camera: x forward, y left,
    z up, metres. Corners of the black square are pixels of the undistorted photo. An id that is read at two places has
    two entries, both `contradictory`. `faults` are photos that could not be read, are of another size than the
    intrinsics, or whose picture could not be written.

`curves` writes curves-NAME.md and .json for each curve, and curves.png.
"""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.commands.sources import make_folder
from tflane_jax.datasets.plausible import LARGEST_DISTORTION, MOST_PIXELS
from tflane_jax.errors import LeftOutWarning, UserError
from tflane_jax.files.atomic import check_folder, check_replaces, delete_older, write_bytes, write_json
from tflane_jax.files.images import check_center, list_photos, opencv, read_image, undistorted
from tflane_jax.files.wording import check_name, counted, plain_name, short_stem
from tflane_jax.geometry.cameras import project
from tflane_jax.limits import check_settings
from tflane_jax.markers.curves import CurveConfig, Sighting, measure, summarise
from tflane_jax.markers.detection import DetectedMarkers, detect
from tflane_jax.markers.image_search import DetectorConfig
from tflane_jax.markers.square_pose import marker_outline
from tflane_jax.plots import format_table, save_table, style
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.marker_curves import save_error_curves
from tflane_jax.plots.marker_drive import OUTCOMES
from tflane_jax.scene import CameraViews
from tflane_jax.scene.marker_patterns import MarkerFamily, board_size
from tflane_jax.world.render.camera import camera_pose

_AXES = np.array([(255, 40, 40), (40, 200, 40), (60, 90, 255)])
_OUTLINE, _CONTRADICTORY, _DARK = (255, 210, 0), style.rgb(OUTCOMES["contradictory"]), style.rgb(style.ROAD)

_HIGHEST = 100.0  # of a camera above the ground, metres
_PICTURE = re.compile(r"\d{3,}-.*-markers\.png")

Box = tuple[int, int, int, int]


def find(options: argparse.Namespace) -> int:
    """Detect markers in photos of one calibrated camera; print a table, write pictures and detections.json.

    A photo that cannot be read, or that the intrinsics do not fit, is recorded and told, the others are searched, and
    the result is 2.
    """
    check_folder(options.out)
    opencv()  # without it, every photo would be a fault
    photos = _without_own_pictures(list_photos(options.images), options)
    config = DetectorConfig(
        _family(options.family),
        options.size,
        corners=options.corners,
        enlarge=options.enlarge,
        search=options.search,
    )
    check_settings(config, "--")
    _check_camera(options)
    distortion: list[float] = options.distortion or []
    intrinsics, pose = _intrinsics(options.intrinsics), camera_pose(options.height, np.deg2rad(options.pitch))
    pictures = {path: f"{number:03d}-{short_stem(path)}-markers.png" for number, path in enumerate(photos)}
    check_replaces({options.out / name: path for path, name in pictures.items()}, photos)
    make_folder(options.out)
    rows, records, faults, twice = [], [], [], []
    for path, picture in pictures.items():
        try:
            check_name(path)
            photo = read_image(path)
            check_center(path, photo, intrinsics)
            photo = undistorted(path, photo, intrinsics, distortion)
            found = detect(_views(photo, intrinsics, pose), config)
            _write_picture(options.out / picture, photo, found, config.size, config.family, intrinsics, pose)
        except UserError as error:
            faults.append({"file": plain_name(path), "error": str(error)})
            continue
        here = [_record(found, k, intrinsics, pose) for k in np.flatnonzero(found.valid).tolist()]
        twice += _contradictions(path, here)
        records.append({"file": str(path), "picture": picture, "markers": here})
        for record in here:
            remark = {"remark": "contradictory"} if record["contradictory"] else {}
            rows.append({"photo": path.name} | record | dict(zip("xyz", record["position"], strict=True)) | remark)
        if not here:
            rows.append({"photo": path.name})
    head = {"family": config.family.name, "size": config.size}
    write_json(options.out / "detections.json", head | {"photos": records, "faults": faults})
    columns = ("photo", "id", "score", "distance", "x", "y", "z", "turn", "reprojection", "ambiguity")
    if twice:
        columns = (*columns, "remark")
    print(format_table(rows, columns, title=f"{config.family.name}, {config.size:g} m; metres, degrees, pixels"))
    print(f"\nwritten to {options.out}")
    for text in twice:
        print(f"tflane: warning: {text}", file=sys.stderr)
    for fault in faults:
        print(f"tflane: {fault['error']}", file=sys.stderr)
    if faults:
        print(f"tflane: photos without an answer: {len(faults)} of {len(pictures)}, see above", file=sys.stderr)
    return 2 if faults else 0


def _check_camera(options: argparse.Namespace) -> None:
    """Raise UserError for a distortion, height or pitch that no camera has, and for numbers that are not finite."""
    distortion: list[float] = options.distortion or []
    if len(distortion) not in (0, 4, 5, 8):
        raise UserError(f"--distortion takes OpenCV's K1 K2 P1 P2, with K3, or with K3 to K6, not {len(distortion)}")
    for name in ("intrinsics", "distortion", "height", "pitch"):
        if not np.isfinite(getattr(options, name) or 0.0).all():
            raise UserError(f"--{name} takes finite numbers, not nan or inf")
    if np.abs(distortion).max(initial=0.0) > LARGEST_DISTORTION:
        raise UserError(f"--distortion holds numbers up to {LARGEST_DISTORTION:g}, not {np.abs(distortion).max():g}")
    if not 0.0 < options.height <= _HIGHEST:
        raise UserError(
            f"--height is that of the camera above the ground, above 0 and up to {_HIGHEST:g} metres, not "
            f"{options.height:g}"
        )
    if not abs(options.pitch) <= 90.0:
        raise UserError(f"--pitch is from -90 to 90 degrees, not {options.pitch:g}")


def curves(options: argparse.Namespace) -> int:
    """Measure detection rate and pose error over distance; write tables and, with matplotlib, a picture."""
    if min(options.scales) <= 0.0:
        raise UserError(f"--scales are positive fractions of the native image size, not {min(options.scales):g}")
    if not 0.0 < options.sigma_d < np.inf:
        raise UserError(f"--sigma-d must be a positive distance in metres, not {options.sigma_d:g}")
    check_folder(options.out)
    for name in ("distances", "scales", "corners"):
        setattr(options, name, list(dict.fromkeys(getattr(options, name))))
    if len(set(map("{:g}".format, options.scales))) < len(options.scales):
        raise UserError(f"--scales {' '.join(map(str, options.scales))}: two of them have one name in tables and files")
    configs = {scale: [_curve(options, scale, corners) for corners in options.corners] for scale in options.scales}
    make_folder(options.out)
    drawn: dict[str, list[dict[str, Any]]] = {}
    for scale, several in configs.items():  # all corner methods see the same scenes
        for corners, config, sightings in zip(options.corners, several, measure(several), strict=True):
            name = f"{corners}, scale {scale:g}"
            drawn[name] = _summary(sightings, options.distances, name)
            stem = options.out / f"curves-{corners}-{scale:g}"
            meta = {"config": str(config), "boards": [vars(sighting) for sighting in sightings]}
            save_table(stem, drawn[name], meta, title=name)
            print(format_table(drawn[name], title=name) + "\n")
    delete_older(options.out, "curves.png")
    if can_draw():
        save_error_curves(options.out / "curves.png", drawn, options.sigma_d)
    print(f"written to {options.out}")
    return 0


def _summary(sightings: Sequence[Sighting], distances: Sequence[float], name: str) -> list[dict[str, Any]]:
    """Return the rows of a curve; warn of distances without a board, raise UserError if all are."""
    seen = {sighting.distance for sighting in sightings}
    absent = ", ".join(f"{distance:g}" for distance in distances if distance not in seen)
    if not seen:
        raise UserError(f"{name}: no board lies wholly in an image at {absent} m: give larger --distances")
    if absent:
        print(
            f"tflane: warning: {name}: no board lies wholly in an image at {absent} m, left out of the table",
            file=sys.stderr,
        )
    return summarise(sightings)


def _curve(options: argparse.Namespace, scale: float, corners: Any) -> CurveConfig:
    """Return what is measured; raise UserError, naming the option, where it cannot be."""
    detector = DetectorConfig(_family(options.family), corners=corners, enlarge=options.enlarge)
    check_settings(detector, "--")
    config = CurveConfig(
        tuple(options.distances), seeds=options.seeds, scale=scale, severity=options.severity, detector=detector
    )
    check_settings(config, "--")
    return config


def _family(name: str) -> MarkerFamily:
    if name not in MarkerFamily.__members__:
        raise UserError(f"there is no marker family {name}: choose one of {', '.join(MarkerFamily.__members__)}")
    return MarkerFamily[name]


def _without_own_pictures(photos: list[Path], options: argparse.Namespace) -> list[Path]:
    """Return the photos without pictures that an earlier run wrote into their folder; warn of these.

    A file that is named itself is what the user means.
    """
    out = options.out.resolve()
    own = [
        path
        for path in photos
        if _PICTURE.fullmatch(path.name) and path.parent.resolve() == out and path not in options.images
    ]
    if own:
        pictures = counted(len(own), "picture")
        warnings.warn(
            f"{pictures} of an earlier run in {options.out} left out: {own[0].name}", LeftOutWarning, stacklevel=2
        )
    if len(own) == len(photos):
        raise UserError(f"{options.out} holds no photos but pictures of an earlier run: name the photos")
    return [path for path in photos if path not in own]


def _intrinsics(numbers: list[float]) -> Float[np.ndarray, "3 3"]:
    fx, fy, cx, cy = numbers
    if not (0.0 < fx <= MOST_PIXELS and 0.0 < fy <= MOST_PIXELS):
        raise UserError(
            f"--intrinsics are FX FY CX CY in pixels, with FX and FY above 0 and up to {MOST_PIXELS:,.0f}, not {fx:g} "
            f"{fy:g}"
        )
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _views(
    photo: UInt8[np.ndarray, "h w 3"], intrinsics: Float[np.ndarray, "3 3"], pose: Float[np.ndarray, "4 4"]
) -> CameraViews:
    height, width = photo.shape[:2]
    return CameraViews(photo[None], np.array([[width, height]]), intrinsics[None], pose[None], np.ones(1, bool))


def _contradictions(photo: Path, records: list[dict[str, Any]]) -> list[str]:
    """Return one sentence for each id that a photo shows at several places."""
    places: dict[int, list[str]] = {}
    for record in records:
        if record["contradictory"]:
            x, y, _ = record["position"]
            places.setdefault(record["id"], []).append(f"({x:.1f}, {y:.1f})")
    return [
        f"{photo}: marker {number} is at several places, x and y {' and '.join(several)} m: give each board an id of "
        "its own, or leave out the one that is not surveyed"
        for number, several in places.items()
    ]


def _record(
    found: DetectedMarkers, k: int, intrinsics: Float[np.ndarray, "3 3"], camera_from_ego: Float[np.ndarray, "4 4"]
) -> dict[str, Any]:
    pose = np.asarray(found.pose[k], np.float64)
    # 0 if the marker faces back along x, positive if it is turned to its own left.
    turn = np.rad2deg(np.arctan2(-pose[1, 2], -pose[0, 2]))
    return {
        "id": int(found.marker_id[k]),
        "score": round(float(found.score[k]), 4),
        "distance": round(float(np.linalg.norm(pose[:2, 3])), 4),
        "turn": round(float(turn), 2),
        "reprojection": round(float(found.reprojection[k]), 4),
        "ambiguity": round(float(found.ambiguity[k]), 4),
        "contradictory": bool(found.contradictory[k]),
        "corners": marker_outline(pose, float(found.size[k]), intrinsics, camera_from_ego).round(1).tolist(),
        "position": np.round(pose[:3, 3], 4).tolist(),
        "pose": np.round(pose, 6).tolist(),
    }


def _write_picture(
    path: Path,
    photo: UInt8[np.ndarray, "h w 3"],
    found: DetectedMarkers,
    size: float,
    family: MarkerFamily,
    intrinsics: Float[np.ndarray, "3 3"],
    camera_from_ego: Float[np.ndarray, "4 4"],
) -> None:
    cv2 = opencv()
    image = np.ascontiguousarray(photo)
    width, taken = max(1, round(max(image.shape) / 900)), []
    font = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * width, width

    def fixed(pixels: np.ndarray) -> np.ndarray:
        return np.round((np.clip(pixels, -8000.0, 8000.0) - 0.5) * 16).astype(np.int32)

    for k in np.flatnonzero(found.valid).tolist():
        pose = np.asarray(found.pose[k], np.float64)
        outline = marker_outline(pose, size, intrinsics, camera_from_ego)
        colour = _CONTRADICTORY if found.contradictory[k] else _OUTLINE
        cv2.polylines(image, [fixed(outline)], True, colour, width, cv2.LINE_AA, 4)
        ends = pose[:3, 3] + np.concatenate([np.zeros((1, 3)), 0.75 * size * pose[:3, :3].T])
        pixels, _, ahead = project(ends, intrinsics, camera_from_ego)
        for axis in np.flatnonzero(ahead[1:]).tolist():
            start, end = fixed(pixels[[0, axis + 1]]).tolist()
            cv2.line(image, start, end, _AXES[axis].tolist(), 2 * width, cv2.LINE_AA, 4)
        words = f"{found.marker_id[k]}: {np.linalg.norm(pose[:2, 3]):.1f} m, {found.score[k]:.2f}"
        words += ", contradictory" if found.contradictory[k] else ""
        board = marker_outline(pose, board_size(family, size), intrinsics, camera_from_ego)
        (across, high), low = cv2.getTextSize(words, *font)
        left, bottom = _label_place(board, (across, high + low), image.shape[1::-1], 4 * width, taken)
        taken.append((left, bottom - high - low, left + across, bottom))
        # On dark ground it can be read on the sky and on paint. (A dark edge would be text of another thickness, which
        # some versions of OpenCV space differently.)
        cv2.rectangle(image, taken[-1][:2], taken[-1][2:], _DARK, cv2.FILLED)
        cv2.putText(image, words, (left, bottom - low), font[0], font[1], colour, font[2], cv2.LINE_AA)
    write_bytes(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def _label_place(
    board: Float[np.ndarray, "4 2"], text: tuple[int, int], size: tuple[int, int], gap: int, taken: Sequence[Box]
) -> tuple[int, int]:
    """Return the lower left corner of a label's box in the picture, beside the labels whose boxes are `taken`.

    It is below the board, above it where there is no room, and further down or up where another label is.
    """
    low, high = board.min(0), board.max(0)
    left = int(max(min(low[0], size[0] - text[0] - gap), 0))
    line = text[1] + gap
    below = [round(high[1]) + line * number for number in range(1, len(taken) + 2)]
    above = [round(low[1]) - gap - line * number for number in range(len(taken) + 1)]
    inside = [bottom for bottom in (*below, *above) if text[1] <= bottom <= size[1] - gap]
    for bottom in inside:
        box = (left, bottom - text[1], left + text[0], bottom)
        if not any(box[0] < r and l < box[2] and box[1] < b and t < box[3] for l, t, r, b in taken):
            return left, bottom
    return left, int(np.clip(below[0], text[1], size[1] - gap))
