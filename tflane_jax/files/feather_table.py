"""Columns of an untrusted feather file, checked as they are read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tflane_jax.errors import UserError, missing_extra

Kind = Literal["integer", "number", "text"]
"""What a column holds: whole numbers (int64), finite numbers (float64), or text (str)."""
_LONGEST_TEXT = 1000
# Files of a log have up to some 50,000 rows and a few MB. Those that are compressed unpack before rows are counted.
_MOST_ROWS, _MOST_BYTES = 10**7, 2**28


def read_columns(path: Path, columns: Mapping[str, Kind]) -> dict[str, np.ndarray]:
    """Return columns of a feather file; further columns are left out.

    Raises:
        UserError: pyarrow is missing, the file cannot be read or lacks a column, or a value is not of the column's
            kind. The message names file, column and row.
    """
    try:
        import pyarrow
        from pyarrow import feather
    except ImportError as error:
        raise missing_extra("reading Argoverse 2 needs pyarrow", "data") from error
    if not path.is_file():
        raise UserError(f"{path} is missing: download it with the Argoverse 2 sensor dataset")
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise UserError(f"{path} has {path.stat().st_size / 2**20:,.0f} MiB: it is no file of one log")
        table = feather.read_table(path)
        if table.num_rows > _MOST_ROWS:
            raise UserError(f"{path} has {table.num_rows:,} rows: it is no file of one log")
        # Of a damaged file, offsets and numbers of dictionary entries may point anywhere.
        table.validate(full=True)
    except (pyarrow.ArrowException, OSError) as error:
        raise UserError(f"{path} is not a readable feather file ({error}): download it again") from error
    if missing := [name for name in columns if name not in table.column_names]:
        raise UserError(f"{path} lacks the column(s) {', '.join(missing)}: it is no Argoverse 2 sensor-dataset file")
    return {name: _column(path, name, table[name], kind) for name, kind in columns.items()}


def _column(path: Path, name: str, column: Any, kind: Kind) -> np.ndarray:
    import pyarrow.types as types

    of_kind = {
        "integer": types.is_integer(column.type),
        "number": types.is_floating(column.type) or types.is_integer(column.type),
        "text": types.is_string(column.type)
        or types.is_large_string(column.type)
        or (types.is_dictionary(column.type) and types.is_string(column.type.value_type)),
    }[kind]
    if column.null_count:
        row = int(np.argmax(column.is_null().to_numpy(zero_copy_only=False)))
        raise UserError(f"{path}: column {name} is empty in row {row}: download it again")
    if not of_kind and len(column):
        what = {"integer": "whole numbers", "number": "numbers", "text": "text"}[kind]
        raise UserError(f"{path}: column {name} holds {column.type}, expected {what}: download it again")
    values = column.to_numpy()
    if kind == "text":
        # An array of texts gives each of them the room of the longest.
        if (longest := max(map(len, values), default=0)) > _LONGEST_TEXT:
            raise UserError(f"{path}: column {name} holds a text of {longest} characters: download it again")
        return values.astype(str)
    values = values.astype(np.int64 if kind == "integer" else np.float64)
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values)))
        raise UserError(f"{path}: column {name} holds {values[row]} in row {row}, expected finite numbers")
    return values
