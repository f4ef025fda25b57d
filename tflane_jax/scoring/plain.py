"""This project's own form of centerline files, for predictions of any framework: arrays in .npz, or .json.

.npz, F frames of L lanes: `scene` (F,) and `timestamp_ns` (F,), which together name a frame; `points` (F, L, n, 3),
metres, ego frame, in driving direction; `successor` (F, L, L), [f, i, j] lane j continues lane i; `scores` (F, L), 0 to
1 (predictions); optional `valid` (F, L), false where a slot is empty, and `visibility` (F, L), 0 to 1 (ground truth).
`tflane predict` writes both sides. Its predictions of lane segments have `category` (F, L), 0 lane segment, 1 crossing:
crossings are no lanes and are left out.

.json: {"frames": [{"scene", "timestamp_ns", "points", "successor", "scores" or "visibility"}]}, the same by frame, also
`valid` and `category`; lines may have different numbers of points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sized
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.fields import (
    fractions,
    is_name,
    is_time,
    is_whole,
    items,
    line_points,
    load_file,
    member,
    scores,
    truth_values,
)
from tflane_jax.files.npz import read_npz
from tflane_jax.files.wording import named, shown
from tflane_jax.metrics.frames import LaneDetections, LaneTruth

SUFFIXES = (".npz", ".json")


class PlainKey(NamedTuple):
    """Identifier of a frame."""

    scene: str
    timestamp_ns: str

    def __str__(self) -> str:
        return f"{self.scene} at {self.timestamp_ns} ns"


def read_predictions(path: Path) -> dict[PlainKey, LaneDetections]:
    """Return the detections by frame; raises UserError that names file, frame and field."""
    return {
        key: LaneDetections(_lines(record, where), _column(record, "scores", where), _successor(record, where))
        for key, record, where in _frames(path)
    }


def read_truth(path: Path) -> dict[PlainKey, LaneTruth]:
    """Return the true lanes by frame; raises UserError that names file, frame and field."""
    frames = {}
    for key, record, where in _frames(path):
        if "scores" in record:
            raise UserError(f"{where} has scores, so that {path} is a file of predictions: give the ground truth")
        lanes = _lines(record, where, least=2)
        successor = truth_values(member(record, "successor", where), (len(lanes), len(lanes)), f"{where}: successor")
        visibility = _column(record, "visibility", where) if "visibility" in record else None
        frames[key] = LaneTruth(lanes, successor, visibility=visibility)
    return frames


def _frames(path: Path) -> Iterator[tuple[PlainKey, Any, str]]:
    records = _npz_records(path) if path.suffix == ".npz" else _json_records(path)
    seen = set()
    for i, record in enumerate(records):
        at = f"{path}: frames[{i}]"
        key = PlainKey(_scene(member(record, "scene", at), at), _time(member(record, "timestamp_ns", at), at))
        if key in seen:
            raise UserError(f"{path}: frame {named(key)} is there twice")
        seen.add(key)
        yield key, record, f"{path}, frame {named(key)}"


def _scene(value: Any, where: str) -> str:
    if not is_name(value):
        raise UserError(f"{where}: scene is {shown(value)}, expected a text")
    return str(value)


def _time(value: Any, where: str) -> str:
    """Return a time as the digits of its nanoseconds."""
    digits = isinstance(value, str) and value.strip().isascii() and is_time(value.strip())
    if not (digits or (is_whole(value) and abs(int(value)) < 2**63)):
        dated = isinstance(value, (np.datetime64, np.timedelta64))
        found = f"of type {value.dtype}" if dated else shown(value)
        remedy = " (.astype(np.int64) turns datetime64[ns] into them)" if dated else ""
        raise UserError(f"{where}: timestamp_ns is {found}, expected whole nanoseconds{remedy}")
    return str(int(value))


def _npz_records(path: Path) -> Iterator[dict[str, Any]]:
    """Return the frames of a file of arrays, without the empty slots."""
    arrays = read_npz(path)
    points = member(arrays, "points", str(path))
    if points.ndim != 4:
        raise UserError(f"{path}: points has shape {points.shape}, expected (frames, lanes, points, 3)")
    frames, lanes = points.shape[:2]
    shapes = {"scene": (frames,), "timestamp_ns": (frames,), "successor": (frames, lanes, lanes)}
    shapes |= dict.fromkeys(("scores", "visibility", "valid", "category"), (frames, lanes))
    for name, shape in shapes.items():
        if name in arrays and arrays[name].shape != shape:
            raise UserError(f"{path}: {name} has shape {arrays[name].shape}, expected {shape}")
    valid = truth_values(arrays.pop("valid", np.ones((frames, lanes), bool)), (frames, lanes), f"{path}: valid")
    if "category" in arrays:
        valid &= ~truth_values(arrays.pop("category"), (frames, lanes), f"{path}: category")
    known = {name: array for name, array in arrays.items() if name in (*shapes, "points")}
    for f in range(frames):
        record: dict[str, Any] = {name: array[f] for name, array in known.items()}
        for name in record.keys() & {"points", "scores", "visibility"}:
            record[name] = record[name][valid[f]]
        if "successor" in record:
            record["successor"] = record["successor"][np.ix_(valid[f], valid[f])]
        yield record


def _json_records(path: Path) -> Iterator[Any]:
    """Return the frames of a file of records, without empty slots and crossings."""
    for i, record in enumerate(items(load_file(path), "frames", str(path))):
        at = f"{path}: frames[{i}]"
        given = record.keys() & {"valid", "category"} if isinstance(record, dict) else ()
        if not given:
            yield record
            continue
        count = len(items(record, "points", at))
        kept = truth_values(record.get("valid", np.ones(count, bool)), (count,), f"{at}: valid")
        if "category" in given:
            kept &= ~truth_values(record["category"], (count,), f"{at}: category")
        rows = np.flatnonzero(kept).tolist()
        lists = {name: items(record, name, at) for name in record.keys() & {"points", "scores", "visibility"}}
        for name, values in lists.items():
            _check_count(values, count, name, at)
        found = record | {name: [values[row] for row in rows] for name, values in lists.items()}
        if "successor" in record:
            edges = fractions(record["successor"], (count, count), f"{at}: successor", largest=np.inf)
            found["successor"] = edges[np.ix_(rows, rows)]
        yield found


def _lines(record: Any, where: str, least: int = 1) -> list[np.ndarray]:
    """Return the lines, each of at least so many points."""
    lines = enumerate(items(record, "points", where))
    return [line_points(line, f"{where}: points[{i}]", least) for i, line in lines]


def _successor(record: Any, where: str) -> np.ndarray:
    lanes = len(items(record, "points", where))
    return fractions(member(record, "successor", where), (lanes, lanes), f"{where}: successor", largest=np.inf)


def _column(record: Any, name: str, where: str) -> np.ndarray:
    values = scores(items(record, name, where), f"{where}: {name}")
    _check_count(values, len(record["points"]), name, where)
    return values


def _check_count(values: Sized, lanes: int, name: str, where: str) -> None:
    if len(values) != lanes:
        raise UserError(f"{where}: {name} has {len(values)} numbers for {lanes} lanes")
