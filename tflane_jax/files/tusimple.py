"""TuSimple's label and prediction files: one JSON record a line, `lanes` as x at the rows `h_samples`.

Format: README of github.com/TuSimple/tusimple-benchmark, doc/lane_detection.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.files.fields import is_text, items, member, numbers, parse_json, read_text
from tflane_jax.files.wording import named, shown

NO_POINT = -2.0
"""x of a row in which a lane has no point."""
SIZE = (720, 1280)
"""Height and width of TuSimple's images, pixels."""
ROWS = np.arange(160.0, 720.0, 10.0)
"""(56,) rows of the test set's labels, pixels of an image of height `SIZE[0]`."""
NO_DRIVES = "TuSimple labels one image of each clip, and clips of one drive are drawn as if they were apart"
"""Why intervals over images are no intervals over drives."""
_WIDEST = 1e6  # pixels


@dataclass(frozen=True)
class RowLanes:
    """Lanes of one image, as x at fixed rows.

    Attributes:
        x: (L, H) pixels; negative where a lane has no point in a row.
        rows: (H,) the image rows, pixels (`h_samples`); None for predictions, which use those of the truth.
        run_time: duration of the prediction, milliseconds.
        place: file, line and image, for messages.
        size: height and width of the image, pixels; files do not tell it.
    """

    x: Float[np.ndarray, "l h"]
    rows: Float[np.ndarray, " h"] | None = None
    run_time: float = 0.0
    place: str = ""
    size: tuple[float, float] = SIZE


def read_predictions(path: Path) -> dict[str, RowLanes]:
    """Return the predicted lanes by `raw_file`; raises UserError that names file, line and field.

    Rows that a record repeats from the labels are kept, so that they can be compared.
    """
    found = {name: _lanes(record, where, predicted=True) for name, record, where in _records(path)}
    _check_not_fractions(found, path)
    return found


def read_truth(path: Path) -> dict[str, RowLanes]:
    """Return the labelled lanes by `raw_file`; raises UserError that names file, line and field."""
    found = {name: _lanes(record, where, predicted=False) for name, record, where in _records(path)}
    _check_not_fractions(found, path)
    return found


def read_truth_once(path: Path) -> dict[str, RowLanes]:
    """Return the labelled lanes as `read_truth`; raises UserError also for a lane that an image has twice.

    One prediction would match both, and FP would be negative. Lanes without a point are exempt: the official labels
    have images with several.
    """
    found = read_truth(path)
    for one in found.values():
        first: dict[bytes, int] = {}
        for i, x in enumerate(one.x):
            if (x >= 0.0).any() and first.setdefault(x.tobytes(), i) != i:
                raise UserError(f"{one.place}: lanes[{i}] is lanes[{first[x.tobytes()]}] once more: keep one of them")
    return found


def _records(path: Path) -> list[tuple[str, Any, str]]:
    """Return image, record and place of every line."""
    text = read_text(path, "file of JSON lines")
    if text.lstrip().startswith("["):
        raise UserError(f"{path} is one JSON list: TuSimple's files have one JSON record on each line, and no list")
    records, first = [], {}
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip():
            continue
        where = f"{path}, line {number}"
        record = parse_json(line.strip(), where, "JSON record", once=True)
        name = member(record, "raw_file", where)
        if not is_text(name) or not name:
            raise UserError(f"{where}: raw_file is {shown(name)}, expected the path of an image")
        if name in first:
            raise UserError(f"{where}: {named(name)} is there twice, first in line {first[name]}")
        first[name] = number
        records.append((name, record, f"{where} ({named(name)})"))
    return records


def _lanes(record: Any, where: str, *, predicted: bool) -> RowLanes:
    """Return the lanes of a record. A prediction has a run time and may leave out the rows; a label needs rows."""
    if predicted:
        run_time = _run_time(record, where)
        rows = _rows(record, where) if "h_samples" in record else None
    else:
        run_time, rows = 0.0, _rows(record, where)
        if not len(rows):
            raise UserError(f"{where}: h_samples is empty, expected the rows of the image at which lanes are labelled")
    count = None if rows is None else len(rows)
    lanes = [
        numbers(lane, (count,), f"{where}: lanes[{i}]", largest=_WIDEST)
        for i, lane in enumerate(items(record, "lanes", where))
    ]
    if other := [i for i, lane in enumerate(lanes) if len(lane) != len(lanes[0])]:
        sizes = f"{len(lanes[other[0]])} numbers, lanes[0] has {len(lanes[0])}"
        raise UserError(f"{where}: lanes[{other[0]}] has {sizes}: expected one x for each of h_samples")
    if count is None:
        count = len(lanes[0]) if lanes else 0
    return RowLanes(np.array(lanes, np.float64).reshape(len(lanes), count), rows, run_time, where)


def _run_time(record: Any, where: str) -> float:
    time = float(numbers(member(record, "run_time", where), (), f"{where}: run_time"))
    if time < 0.0:
        raise UserError(f"{where}: run_time is {time:g}, expected milliseconds")
    return time


def _rows(record: Any, where: str) -> Float[np.ndarray, " h"]:
    at = f"{where}: h_samples"
    rows = numbers(items(record, "h_samples", where), (None,), at, largest=_WIDEST)
    if len(rows) and rows[0] < 0:
        raise UserError(f"{at} holds {rows[0]:g}, expected rows of the image, 0 or more")
    if (wrong := np.diff(rows) <= 0).any():
        i = int(wrong.argmax())
        raise UserError(f"{at} holds {rows[i + 1]:g} after {rows[i]:g}: expected rows from top to bottom, each once")
    return rows


def _check_not_fractions(lanes: dict[str, RowLanes], path: Path) -> None:
    """Raise UserError if every x of a file is a fraction of the image's width."""
    present = [one.x[one.x >= 0.0] for one in lanes.values()]
    x = np.concatenate([np.zeros(0), *present])
    if len(x) > 1 and x.max() <= 1.0 and x.max() > 0.0:
        raise UserError(f"{path}: every x of its lanes lies between 0 and 1: multiply them by the image's width, 1280")
