"""Lanes in photos of unknown cameras: how many the search for a view finds, on photos cut and scaled in many ways.

    python -m benchmarks.photo_views --out runs/bench

LSTR's published weights read TuSimple's labelled frames, cut or padded to other shapes, and a street photo of nuScenes
in several resolutions, all without hints. "Found" is the fraction of labelled points within TuSimple's tolerance of the
best lane (20 pixels of a 1280 wide image, across the lane), "false" are lanes of which less than half is near a label.
The street's two lines of paint were labelled by eye; the edge of the road counts neither way. Photos without a road
ahead should have no lanes. The rule that chooses the view was fitted to these very photos: the numbers say what the
search gains on them, not what it does on others.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.timing import command_line, markdown_table, save
from tflane_jax.config import load_config
from tflane_jax.files.images import opencv, read_image
from tflane_jax.runs import open_weights
from tflane_jax.tasks.photo_lanes import PhotoReader
from tflane_jax.training.runtime import configure_jax

_TOLERANCE = 20.0
# Lines of the nuScenes key frame at hand, 1600 x 900 pixels, by eye: two of paint, and the foot of the barrier.
_STREET = (
    ((855, 567), (843, 579), (830, 634), (817, 664), (801, 708), (773, 780), (732, 884)),
    ((985, 529), (1038, 559), (1091, 587), (1216, 654), (1551, 828)),
)
_EDGE = ((1097, 523), (1347, 588), (1592, 654))


class Labelled(NamedTuple):
    """A photo (h, w, 3) with lines that can be seen and lines that may be found or not, (column, row) in its pixels.

    `pixel` is the width and height, in its pixels, of a pixel of the camera with a 1280 wide image.
    """

    image: np.ndarray
    lines: list[np.ndarray]
    optional: list[np.ndarray]
    pixel: tuple[float, float]


def cut(top: int = 0, bottom: int | None = None, left: int = 0, right: int | None = None) -> Callable[..., Labelled]:
    def change(photo: Labelled) -> Labelled:
        return _moved(photo, photo.image[top:bottom, left:right], (-left, -top))

    return change


def padded(top: int = 0, bottom: int = 0, grey: int = 0) -> Callable[..., Labelled]:
    def change(photo: Labelled) -> Labelled:
        rows = ((top, bottom), (0, 0), (0, 0))
        return _moved(photo, np.pad(photo.image, rows, constant_values=grey), (0, top))

    return change


def scaled(width: int, height: int) -> Callable[..., Labelled]:
    def change(photo: Labelled) -> Labelled:
        cv2 = opencv()
        rows, columns = photo.image.shape[:2]
        how = cv2.INTER_AREA if width < columns else cv2.INTER_CUBIC
        scale = (width / columns, height / rows)
        return _moved(photo, cv2.resize(photo.image, (width, height), interpolation=how), (0, 0), scale)

    return change


def mirrored(photo: Labelled) -> Labelled:
    return _moved(photo, photo.image[:, ::-1], (photo.image.shape[1] - 1, 0), (-1, 1))


def _moved(
    photo: Labelled, image: np.ndarray, offset: tuple[int, int], scale: tuple[float, float] = (1, 1)
) -> Labelled:
    """Return a changed photo with the points of its lines where they are now, as far as they are inside."""
    height, width = image.shape[:2]

    def inside(line: np.ndarray) -> np.ndarray:
        line = line * scale + offset
        return line[((line >= 0) & (line < (width, height))).all(1)]

    lines, optional = (
        [line for each in group if len(line := inside(each)) > 5] for group in (photo.lines, photo.optional)
    )
    pixel = (photo.pixel[0] * abs(scale[0]), photo.pixel[1] * scale[1])
    return Labelled(np.ascontiguousarray(image), lines, optional, pixel)


FRAMES: dict[str, Callable[[Labelled], Labelled]] = {
    "whole": cut(),
    "half as large": scaled(640, 360),
    "without the upper 100 rows": cut(top=100),
    "without the upper 150 rows": cut(top=150),
    "without the lower 120 rows": cut(bottom=600),
    "without the right 280 columns": cut(right=1000),
    "4:3": cut(left=160, right=1120),
    "21:9": cut(top=130, bottom=680),
    "the middle, 2/3": cut(top=120, bottom=600, left=213, right=1067),
    "black bars above and below": padded(180, 180),
    "200 rows of sky above": padded(200, grey=190),
    "400 grey rows below": padded(bottom=400, grey=60),
    "squeezed to a square": scaled(720, 720),
}
STREET: dict[str, Callable[[Labelled], Labelled]] = {
    **{f"street, {width} wide": scaled(width, width * 9 // 16) for width in (640, 800, 1000, 1280, 1400, 1600, 1920)},
    "street, mirrored": mirrored,
    "street, cut": cut(top=100, left=100, right=1500),
    "street, cut to 1000 columns": cut(top=200, left=300, right=1300),
}


def frames(data: Path) -> Iterator[Labelled]:
    """Yield TuSimple's labelled frames."""
    root = data / "tusimple" / "LaneDetection"
    for file in sorted(root.glob("label_data_*.json")):
        for record in map(json.loads, file.read_text().splitlines()):
            if (root / record["raw_file"]).exists():
                lanes = [np.stack([lane, record["h_samples"]], -1).astype(float) for lane in record["lanes"]]
                yield Labelled(
                    read_image(root / record["raw_file"]), [lane[lane[:, 0] >= 0] for lane in lanes], [], (1, 1)
                )


def street(data: Path) -> Labelled:
    """Return the front camera's image of a nuScenes key frame, a street in bright sun."""

    def dense(line: tuple[tuple[int, int], ...]) -> np.ndarray:
        columns, rows = np.array(line, float).T
        at = np.arange(rows[0], rows[-1], 8.0)
        return np.stack([np.interp(at, rows, columns), at], -1)

    (file,) = (data / "nuscenes_keyframe" / "samples" / "CAM_FRONT").glob("*.jpg")
    return Labelled(read_image(file), [dense(line) for line in _STREET], [dense(_EDGE)], (1.25, 1.25))


def roadless(data: Path) -> Iterator[np.ndarray]:
    """Yield photos that show no road ahead: skies, side views, frames on their side or head, noise, stripes."""
    for photo in frames(data):
        yield photo.image[:230]
    for image in [photo.image for photo in frames(data)][::4]:
        yield from (np.rot90(image), image[::-1])
    for camera in ("FRONT_LEFT", "FRONT_RIGHT", "BACK_LEFT", "BACK_RIGHT"):
        for file in (data / "nuscenes_keyframe" / "samples" / f"CAM_{camera}").glob("*.jpg"):
            yield read_image(file)
    yield street(data).image[:500, 800:]
    noise = np.random.default_rng(0).integers(0, 256, (720, 1280, 3), np.uint8)
    yield noise
    yield opencv().resize(noise[:12, :20], (1280, 720), interpolation=opencv().INTER_CUBIC)
    yield np.where(np.arange(1280)[:, None] % 80 < 30, np.uint8(230), np.uint8(90)) * np.ones((720, 1, 3), np.uint8)


def score(found: list[np.ndarray], photo: Labelled) -> np.ndarray:
    """Return the labelled points that were found, all of them, lanes that are false, and all lanes."""
    hits = sum(max((np.nansum(_near(line, lane, photo.pixel)) for lane in found), default=0.0) for line in photo.lines)
    labels = [*photo.lines, *photo.optional]
    false = [all(_along(lane, line, photo.pixel) < 0.5 for line in labels) for lane in found]
    return np.array([hits, sum(map(len, photo.lines)), sum(false), len(found)])


def _near(line: np.ndarray, other: np.ndarray, pixel: tuple[float, float]) -> np.ndarray:
    """Say of each point of a line whether another one is near, 0 or 1; NaN beyond the ends of that."""
    columns = np.interp(line[:, 1], other[:, 1], other[:, 0], left=np.nan, right=np.nan)
    slope = np.polyfit(other[:, 1] / pixel[1], other[:, 0] / pixel[0], 1)[0]
    near = np.abs(columns - line[:, 0]) / pixel[0] < _TOLERANCE * np.hypot(slope, 1.0)
    return np.where(np.isnan(columns), np.nan, near)


def _along(lane: np.ndarray, line: np.ndarray, pixel: tuple[float, float]) -> float:
    """Return the fraction of a lane that is near a line, of the rows that both have; 0 without such rows."""
    near = _near(lane, line, pixel)
    return 0.0 if np.isnan(near).all() else float(np.nanmean(near))


def measure(reader: PhotoReader, data: Path) -> list[dict[str, Any]]:
    """Return a row for each way in which photos are cut, and one for photos without a road ahead."""
    rows = []
    photos = list(frames(data))
    for name, change in {**FRAMES, **STREET}.items():
        total, warned = np.zeros(4), 0
        for photo in map(change, photos if name in FRAMES else [street(data)]):
            answer = reader.read(photo.image)
            total += score([lane for lane in answer.lanes if len(lane) > 1], photo)
            warned += bool(answer.warning)
        rows.append({"photos": name, "found": total[0] / total[1], "false": int(total[2]), "lanes": int(total[3])})
        rows[-1]["with a warning"] = warned
    answers = [reader.read(np.ascontiguousarray(image)) for image in roadless(data)]
    lanes = sum(len(answer.lanes) for answer in answers)
    warned = sum(bool(answer.warning) for answer in answers)
    name = f"{len(answers)} without a road ahead"
    return [*rows, {"photos": name, "found": None, "false": lanes, "lanes": lanes, "with a warning": warned}]


def published_reader(data: Path) -> PhotoReader:
    """Return LSTR with its published weights."""
    config = replace(load_config("gtn_lane/lstr"), weights=data / "lstr" / "LSTR_500000.npz")
    trained = open_weights(config)
    return PhotoReader(trained.config.task, trained.params[0])


def run(data: Path, out: Path) -> None:
    rows = measure(published_reader(data), data)
    cells = [["" if row["found"] is None else f"{100 * row['found']:.1f}", *list(row.values())[2:]] for row in rows]
    lines = [[row["photos"], *map(str, each)] for row, each in zip(rows, cells, strict=True)]
    print(table := markdown_table(["photos", "found, percent", "false", "lanes", "with a warning"], lines))
    save(out, "photo_views", {"rows": rows}, table)


if __name__ == "__main__":
    options = command_line(__doc__).parse_args()
    folder = Path(os.environ.get("TFLANE_SHARED", Path(__file__).parents[2] / "shared")) / "data"
    if not (folder / "tusimple").is_dir():
        raise SystemExit(f"{folder} has no TuSimple frames: set TFLANE_SHARED to the folder of real data")
    configure_jax()
    run(folder, options.out)
