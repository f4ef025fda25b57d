"""Fields of untrusted files, checked as they are read.

Every function returns the value or raises UserError. `where` names the place in the file for the message.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.plain_pickle import load_plain_pickle


def load_file(path: Path) -> Any:
    """Return the content of a .json or .pkl file; raises UserError that names the file."""
    if path.suffix == ".json":
        return load_json(path)
    if path.suffix in (".pkl", ".pickle"):
        return load_plain_pickle(path)
    raise UserError(f"{path}: expected a .json or .pkl file")


def load_json(path: Path) -> Any:
    """Return the content of a JSON file; raises UserError that names the file and the line of the mistake."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path} is no JSON file: it is not text") from None
    except json.JSONDecodeError as error:
        raise UserError(f"{path} is no JSON file: {error.msg} in line {error.lineno}") from None


def member(record: Any, name: str, where: str) -> Any:
    """Return an entry of a mapping."""
    if not isinstance(record, Mapping):
        raise UserError(f"{where} is {_kind(record)}, expected a mapping with the entry {name!r}")
    if name not in record:
        shown = ", ".join(map(repr, list(record)[:6]))
        raise UserError(f"{where} lacks the entry {name!r} (it has {shown or 'none'})")
    return record[name]


def items(record: Any, name: str, where: str) -> Sequence[Any]:
    """Return an entry that is a list."""
    value = member(record, name, where)
    if isinstance(value, (str, bytes, Mapping)) or not isinstance(value, (Sequence, np.ndarray)):
        raise UserError(f"{where}: {name} is {_kind(value)}, expected a list")
    return value  # pyright: ignore[reportReturnType]


def numbers(value: Any, shape: tuple[int | None, ...], where: str) -> np.ndarray:
    """Return an array of finite numbers: float32 stays, every other type becomes float64. Text is no number.

    None in `shape` is any size. An empty list fits every shape in which some size is 0 or None.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind in "SU":  # numpy would read "1.5" as a number
            raise TypeError("text")
        array = array if array.dtype == np.float32 else array.astype(np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{where} is {_kind(value)}, expected numbers of shape {_shape(shape)}") from None
    if array.size == 0 and not all(shape):
        array = array.reshape([size or 0 for size in shape])
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise UserError(f"{where} has shape {array.shape}, expected {_shape(shape)}")
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise UserError(f"{where} holds {array[index]} at {list(index)}: numbers must be finite")
    return array


def line_points(value: Any, where: str) -> np.ndarray:
    """Return a line's points (n, 3), n >= 1."""
    points = numbers(value, (None, 3), where)
    if len(points) == 0:
        raise UserError(f"{where} is empty: a line has at least one point")
    return points


def scores(values: Sequence[Any], where: str) -> np.ndarray:
    """Return confidences, which must lie between 0 and 1."""
    array = numbers(values, (len(values),), where)
    outside = (array < 0.0) | (array > 1.0)
    if outside.any():
        i = int(outside.argmax())
        raise UserError(f"{where}: number {i} is {array[i]:g}, expected 0 to 1 (apply the sigmoid first)")
    return array


def whole_number(value: Any, low: int, high: int, where: str) -> int:
    """Return a whole number from `low` to `high`."""
    try:
        number = int(value)
    except (TypeError, ValueError):
        number = None
    if number is None or number != value or not low <= number <= high:
        raise UserError(f"{where} is {value!r:.40}, expected a whole number from {low} to {high}")
    return number


def _kind(value: Any) -> str:
    return "missing (null)" if value is None else f"of type {type(value).__name__}"


def _shape(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if size is None else str(size) for size in shape) + ("," * (len(shape) == 1)) + ")"
