"""MapTR's files: `nuscmap_results.json` and the ground truth that its evaluation writes (`*_map_anns_val.json`).

Both are lists of {"sample_token", "vectors": [{"pts", "cls_name", "confidence_level" (results only)}]}, under "results"
and under "GTs". Other fields of MapTR (`pts_num`, `type`) repeat these, and must not contradict them: MapTR's own
evaluation sorts by `type`, of which every configuration has its own order. Points are (x, y), or (x, y, z) in MapTRv2's
variant for Argoverse 2. For groups by occlusion, the truth has a field of ours, `visibility`, 0 to 1.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import replacing
from tflane_jax.files.fields import is_text, items, load_file, member, numbers, scores, whole_number
from tflane_jax.files.wording import named, shown
from tflane_jax.metrics.map_matching import LINE_CLASSES, Dims, MapDetections, MapTruth

# Metres from the vehicle: no line of a local map is so far away.
_FARTHEST = 1e5
# Number of each class in a file.
_Types = dict[str, int]
# What the official files say about the inputs; the evaluation does not read it.
_META = {"use_lidar": False, "use_camera": True, "use_radar": False, "use_map": False, "use_external": True}


def read_predictions(path: Path, dims: Dims = 2) -> dict[str, MapDetections]:
    """Return the detections by sample token, see `read_truth`."""
    frames = {}
    types: _Types = {}
    for token, vectors, where in _samples(path, "results"):
        lines = _lines(vectors, where, 1, dims, types)
        levels = [member(vector, "confidence_level", f"{where}: vectors[{i}]") for i, vector in enumerate(vectors)]
        frames[token] = MapDetections(*lines, scores(levels, f"{where}: confidence_level"))
    return frames


def read_truth(path: Path, dims: Dims = 2) -> dict[str, MapTruth]:
    """Return the annotations by sample token.

    Args:
        path: of the file.
        dims: coordinates of a point, which are those that the metric compares.

    Raises:
        UserError: it names file, sample and field; also for points with other coordinates, whose numbers would be those
            of another protocol, and for a line that is there twice.
    """
    types: _Types = {}
    frames = {}
    for token, vectors, where in _samples(path, "GTs"):
        points, classes = _lines(vectors, where, 2, dims, types)
        _check_once(points, classes, where)
        frames[token] = MapTruth(points, classes, visibility=_visibility(vectors, where))
    return frames


def write_predictions(path: Path, frames: Iterable[tuple[str, MapDetections]]) -> Path:
    """Write `nuscmap_results.json`, frame by frame: sample tokens with their lines in the lidar's axes.

    Raises UserError if the file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f'{{"meta": {json.dumps(_META)}, "results": [')
        for number, (token, found) in enumerate(frames):
            vectors = [
                {
                    "pts": np.asarray(points, float).tolist(),
                    "pts_num": len(points),
                    "cls_name": LINE_CLASSES[kind],
                    "type": int(kind),
                    "confidence_level": float(score),
                }
                for points, kind, score in zip(found.points, found.classes, found.scores, strict=True)
            ]
            file.write(("," if number else "") + "\n" + json.dumps({"sample_token": token, "vectors": vectors}))
        file.write("]}\n")
    return path


def _samples(path: Path, field: str) -> list[tuple[str, Any, str]]:
    """Return token, vectors and place of every sample."""
    samples, seen = [], set()
    for i, record in enumerate(items(load_file(path), field, str(path))):
        token = member(record, "sample_token", f"{path}: {field}[{i}]")
        if not is_text(token) or not token:
            raise UserError(f"{path}: {field}[{i}].sample_token is {shown(token)}, expected a text")
        where = f"{path}, sample {named(token)}"
        if token in seen:
            raise UserError(f"{where} is there twice")
        seen.add(token)
        samples.append((token, items(record, "vectors", where), where))
    return samples


def _lines(vectors: Any, where: str, least: int, dims: Dims, types: _Types) -> tuple[list[np.ndarray], np.ndarray]:
    """Return points and classes.

    Args:
        vectors: of a sample.
        where: names the sample.
        least: number of points that a line must have.
        dims: coordinates of a point.
        types: numbers of the classes in the samples before, extended by those of this one.
    """
    points, classes = [], []
    for i, vector in enumerate(vectors):
        at = f"{where}: vectors[{i}]"
        line = numbers(member(vector, "pts", at), (None, None), f"{at}.pts", largest=_FARTHEST)
        if line.shape[1] not in (2, 3) or len(line) < least:
            raise UserError(f"{at}.pts has shape {line.shape}, expected (n, {dims}) with n of at least {least}")
        if line.shape[1] != dims:
            other = "maptr or maptrv2" if dims == 3 else "maptrv2-3d"
            raise UserError(f"{at}.pts has shape {line.shape}, expected (n, {dims}): such files are scored by {other}")
        count = vector.get("pts_num", len(line))
        if not isinstance(count, (int, float, np.number)) or count != len(line):
            raise UserError(f"{at}.pts_num is {shown(count)}, but pts has {len(line)} points: is the line cut off?")
        name = member(vector, "cls_name", at)
        if not isinstance(name, str) or name not in LINE_CLASSES:
            raise UserError(f"{at}.cls_name is {shown(name)}, expected one of {', '.join(LINE_CLASSES)}")
        _check_type(vector, name, at, types)
        points.append(line)
        classes.append(LINE_CLASSES.index(name))
    return points, np.array(classes, np.int64)


def _check_once(points: list[np.ndarray], classes: np.ndarray, where: str) -> None:
    """Raise UserError if a line is there twice, of which one detection finds only one.

    Centerlines are exempt: paths that part outside of the map's range are the same within it.
    """
    first: dict[tuple[int, bytes], int] = {}
    for i, (line, number) in enumerate(zip(points, classes.tolist(), strict=True)):
        before = first.setdefault((number, line.tobytes()), i)
        if before != i and LINE_CLASSES[number] != "centerline":
            raise UserError(f"{where}: vectors[{i}] is vectors[{before}] once more: keep one of them")


def _check_type(vector: Any, name: str, at: str, types: _Types) -> None:
    """Raise UserError where `type` tells the classes apart otherwise than `cls_name` does."""
    if "type" not in vector:
        return
    number = whole_number(vector["type"], -1, 1000, f"{at}.type")
    if types.setdefault(name, number) != number:
        raise UserError(f"{at}.type is {number}, but other lines of the class {name} have {types[name]}")
    other = next((one for one, its in types.items() if its == number and one != name), None)
    if other is not None:
        raise UserError(f"{at}.type is {number}, which lines of the class {other} have, but cls_name is {name}")


def _visibility(vectors: Any, where: str) -> np.ndarray | None:
    """Return the fraction of each line in line of sight; None for official files, which do not tell."""
    have = ["visibility" in vector for vector in vectors]
    if have and not any(have):
        return None
    if not all(have):
        raise UserError(f"{where}: vectors[{have.index(False)}] lacks the entry 'visibility', which others have")
    return scores([vector["visibility"] for vector in vectors], f"{where}: visibility")
