"""TuSimple's label and prediction files: one JSON record a line, `lanes` as x at the rows `h_samples`.

Format: README of github.com/TuSimple/tusimple-benchmark, doc/lane_detection.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.files.fields import items, member, numbers

NO_POINT = -2.0
"""x of a row in which a lane has no point."""


@dataclass(frozen=True)
class RowLanes:
    """Lanes of one image, as x at fixed rows.

    Attributes:
        x: (L, H) pixels; negative where a lane has no point in a row.
        rows: (H,) the image rows, pixels (`h_samples`); None for predictions, which use those of the truth.
        run_time: duration of the prediction, milliseconds.
    """

    x: Float[np.ndarray, "l h"]
    rows: Float[np.ndarray, " h"] | None = None
    run_time: float = 0.0


def read_predictions(path: Path) -> dict[str, RowLanes]:
    """Return the predicted lanes by `raw_file`; raises UserError that names file, line and field."""
    return {name: _lanes(record, where, timed=True) for name, record, where in _records(path)}


def read_truth(path: Path) -> dict[str, RowLanes]:
    """Return the labelled lanes by `raw_file`; raises UserError that names file, line and field."""
    return {name: _lanes(record, where, timed=False) for name, record, where in _records(path)}


def _records(path: Path) -> list[tuple[str, Any, str]]:
    """Return image, record and place of every line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path} is no file of JSON lines: it is not text") from None
    records, first = [], {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        where = f"{path}, line {number}"
        try:
            record = json.loads(line)
        except json.JSONDecodeError as error:
            raise UserError(f"{where} is no JSON record: {error.msg} at character {error.pos}") from None
        name = member(record, "raw_file", where)
        if not isinstance(name, str):
            raise UserError(f"{where}: raw_file is of type {type(name).__name__}, expected a path")
        if name in first:
            raise UserError(f"{where}: {name} is there twice, first in line {first[name]}")
        first[name] = number
        records.append((name, record, f"{where} ({name})"))
    return records


def _lanes(record: Any, where: str, *, timed: bool) -> RowLanes:
    lanes = items(record, "lanes", where)
    if timed:
        time = float(numbers(member(record, "run_time", where), (), f"{where}: run_time"))
        return RowLanes(numbers(lanes, (None, None), f"{where}: lanes"), run_time=time)
    rows = numbers(items(record, "h_samples", where), (None,), f"{where}: h_samples")
    return RowLanes(numbers(lanes, (None, len(rows)), f"{where}: lanes"), rows)
