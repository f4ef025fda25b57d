"""Fields of untrusted files, checked as they are read.

Every function returns the value or raises UserError. `where` names the place in the file for the message.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.plain_pickle import load_plain_pickle
from tflane_jax.files.wording import digits, kind, place, shape_text, shown

_SPACE = re.compile(r"[ \t\n\r]*")
PICKLE_SUFFIXES = (".pkl", ".pickle")
_FARTHEST = 1e5
"""Largest coordinate of a line, metres in the vehicle's frame."""
_ROUNDING = 1e-3
"""By how much a confidence may be beyond 0 to 1 for its message to speak of rounding."""
_MOST, _DEEPEST = 10_000_000, 32
"""Numbers in one entry, and lists in lists, that no file of these formats has."""


def load_file(path: Path) -> Any:
    """Return the content of a .json or .pkl file; a JSON object that has an entry twice is refused.

    Raises UserError that names the file.
    """
    if path.suffix == ".json":
        return parse_json(read_text(path), str(path), once=True)
    if path.suffix in PICKLE_SUFFIXES:
        return load_plain_pickle(path)
    raise UserError(f"{path}: expected a .json or .pkl file")


def load_json(path: Path) -> Any:
    """Return the content of a JSON file; raises UserError that names the file and the line of the mistake."""
    return parse_json(read_text(path), str(path))


def load_members(path: Path, names: Sequence[str]) -> Mapping[str, Any]:
    """Return entries of the object in a JSON file, which is parsed only as far as the last of them.

    What is missing in the file is missing in the result, for `member` to name. Raises UserError as `load_json` does for
    a mistake before the last entry; later ones are not seen.
    """
    text, decoder, found, at = read_text(path), json.JSONDecoder(), {}, 0
    try:
        while not found.keys() >= set(names):
            at = _past(text, at, "," if at else "{")
            name, at = decoder.raw_decode(text, at)
            value, at = decoder.raw_decode(text, _past(text, at, ":"))
            found[name] = value
    except (ValueError, TypeError, RecursionError):  # the object ends here, or the text is invalid, which this reports:
        found = parse_json(text, str(path))
    return {name: found[name] for name in names if name in found} if isinstance(found, Mapping) else found


def _past(text: str, at: int, sign: str) -> int:
    """Return the place of the next value, after a sign and spaces around it."""
    start = _SPACE.match(text, at).end()  # pyright: ignore[reportOptionalMemberAccess] - it matches nothing, too
    if not text.startswith(sign, start):
        raise ValueError
    return _SPACE.match(text, start + len(sign)).end()  # pyright: ignore[reportOptionalMemberAccess]


def read_text(path: Path, what: str = "JSON file") -> str:
    """Return the content of a UTF-8 file; raises UserError that names it where it cannot be read or is no text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    except MemoryError:
        raise UserError(f"cannot read {path}: it does not fit into memory") from None
    except UnicodeDecodeError:
        raise UserError(f"{path} is no {what}: it is not text") from None


def parse_json(text: str, where: str, what: str = "JSON file", *, once: bool = False) -> Any:
    """Return the value of a JSON text.

    Args:
        text: the whole file, or one line of it.
        where: names it in the message.
        what: it should be.
        once: refuse objects that have an entry twice, of which Python would keep the last.

    Raises:
        UserError: names the line and the character of the mistake.
    """
    try:
        return json.loads(text, object_pairs_hook=_once(where) if once else None)
    except json.JSONDecodeError as error:
        line = f"line {error.lineno}, " if "\n" in text else ""
        raise UserError(f"{where} is no {what}: {error.msg} in {line}character {error.colno}") from None
    except RecursionError:
        raise UserError(f"{where} is no {what} of this kind: its lists are nested too deep") from None
    except ValueError as error:  # an integer of more than 4300 digits
        raise UserError(f"{where} is no {what} that can be read: {str(error).partition(';')[0]}") from None


def _once(where: str) -> Callable[[list[tuple[str, Any]]], dict[str, Any]]:
    def record(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        entries = dict(pairs)
        if len(entries) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise UserError(f"{where}: an object has the entry {shown(twice)} twice: keep one of them")
        return entries

    return record


def member(record: Any, name: str, where: str) -> Any:
    """Return an entry of a mapping."""
    if not isinstance(record, Mapping):
        raise UserError(f"{where} is {kind(record)}, expected a mapping with the entry {name!r}")
    if name not in record:
        there = ", ".join(map(shown, list(record)[:6]))
        raise UserError(f"{where} lacks the entry {name!r} (it has {there or 'none'})")
    return record[name]


def items(record: Any, name: str, where: str) -> Sequence[Any]:
    """Return an entry that is a list."""
    return as_list(member(record, name, where), f"{where}: {name}")


def as_list(value: Any, where: str) -> Sequence[Any]:
    """Return a value that is a list, a tuple or an array."""
    if not (isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim > 0)):
        raise UserError(f"{where} is {kind(value)}, expected a list")
    return value  # pyright: ignore[reportReturnType]


def numbers(value: Any, shape: tuple[int | None, ...], where: str, *, largest: float = np.inf) -> np.ndarray:
    """Return an array of finite numbers: float32 stays, every other type becomes float64.

    Text, complex numbers, truth values (one among numbers too) and dates are no numbers.

    Args:
        value: a number, nested lists or an array.
        shape: of the array; None is any size. An empty list fits every shape in which some size is 0 or None.
        where: names the place in the file.
        largest: absolute value that is allowed.
    """
    array = _as_array(value, shape, where)
    if array.size == 0 and not all(shape):
        array = array.reshape([size or 0 for size in shape])
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise UserError(f"{where} has shape {array.shape}, expected {shape_text(shape)}")
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise UserError(f"{where} holds {array[index]}{place(index)}: numbers must be finite")
    if (np.abs(array) > largest).any():
        index = tuple(int(i) for i in np.argwhere(np.abs(array) > largest)[0])
        raise UserError(f"{where} holds {array[index]:g}{place(index)}: beyond {largest:g} in size")
    return array


def _as_array(value: Any, shape: tuple[int | None, ...], where: str) -> np.ndarray:
    expected = f"expected numbers of shape {shape_text(shape)}"
    if value is None:
        raise UserError(f"{where} is {kind(value)}, {expected}")
    _check_size(value, shape, where)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RecursionError):
        raise UserError(f"{where} is {kind(value)}, {_ragged(value) or expected}") from None
    if array.dtype.kind in "iuf":
        if _has_truth_value(value):
            raise UserError(f"{where} holds a truth value, {expected}")
        return array if array.dtype == np.float32 else array.astype(np.float64, copy=False)
    if array.dtype.kind == "O" and array.size:  # such as integers of more than 64 bits
        wrong = [item for item in array.flat if not _is_number(item)]
        if wrong:
            raise UserError(f"{where} holds a value {kind(wrong[0])}, {expected}")
        try:
            return array.astype(np.float64)
        except OverflowError:
            raise UserError(f"{where} holds an integer of hundreds of digits: no such number is possible") from None
    if array.size == 0:
        return array.astype(np.float64)
    names = {"S": "text", "U": "text", "c": "complex numbers", "b": "truth values"}
    if array.ndim == 0 or array.dtype.kind not in names:
        raise UserError(f"{where} is {kind(value)}, {expected}")
    raise UserError(f"{where} is {kind(value)}, {expected}, not {names[array.dtype.kind]}")


def _check_size(value: Any, shape: tuple[int | None, ...], where: str) -> None:
    """Raise UserError for nested lists that are too large for an array.

    Lists of a pickle may hold the same list many times, so that a few bytes stand for billions of numbers.
    """
    level = [] if isinstance(value, np.ndarray) else [value]
    for _ in range(_DEEPEST):
        kinds = set(map(type, level))
        if kinds.isdisjoint((list, tuple, np.ndarray)):
            return
        rows = level if kinds <= {list, tuple} else [row for row in level if isinstance(row, (list, tuple))]
        held = sum(row.size for row in level if isinstance(row, np.ndarray)) if np.ndarray in kinds else 0
        if held + sum(map(len, rows)) > _MOST:
            break
        level = list(itertools.chain.from_iterable(rows))
    raise UserError(
        f"{where} holds more than {_MOST} numbers, or lists nested more than {_DEEPEST} deep, expected numbers of "
        f"shape {shape_text(shape)}"
    )


def _has_truth_value(value: Any) -> bool:
    """Return whether one is among the numbers of nested lists, where numpy would make it 0 or 1."""
    level = [value]
    while level:
        kinds = set(map(type, level))
        arrays = (row for row in level if isinstance(row, np.ndarray)) if np.ndarray in kinds else ()
        if kinds & {bool, np.bool_} or any(array.dtype == bool for array in arrays):
            return True
        if not kinds <= {list, tuple}:
            level = [row for row in level if isinstance(row, (list, tuple))]
        level = list(itertools.chain.from_iterable(level))
    return False


def _is_number(value: Any) -> bool:
    return isinstance(value, (float, np.floating)) or is_whole(value)


def is_whole(value: Any) -> bool:
    """Return whether a value is a whole number. Truth values and numpy's durations are none, though of its types."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))


def _ragged(value: Any) -> str | None:
    """Return which of a list's rows differs in length from the first, None if that is not its fault."""
    if not isinstance(value, (list, tuple)):
        return None
    sizes = [f"of {len(row)}" if isinstance(row, (list, tuple)) else "no list" for row in value]
    other = next((i for i, size in enumerate(sizes) if size != sizes[0]), None)
    if other is None:
        return None
    return f"expected numbers, and rows of one length: row 0 is {sizes[0]}, row {other} {sizes[other]}"


def line_points(value: Any, where: str, least: int = 1) -> np.ndarray:
    """Return a line's points (n, 3), metres in the vehicle's frame, n of at least `least`."""
    points = numbers(value, (None, 3), where)
    if len(points) < least:
        has = "has one point" if len(points) else "is empty"
        raise UserError(f"{where} {has}: a line has at least {'one point' if least == 1 else f'{least} points'}")
    if (far := np.abs(points) > _FARTHEST).any():
        index = tuple(int(i) for i in np.argwhere(far)[0])
        raise UserError(f"{where} holds {points[index]:g}{place(index)}: expected metres from the vehicle, not a map's")
    return points


def scores(values: Sequence[Any], where: str) -> np.ndarray:
    """Return confidences, which must lie between 0 and 1."""
    if _has_truth_value(list(values)):
        raise UserError(f"{where} holds a truth value, expected numbers from 0 to 1")
    return fractions(values, (len(values),), where)


def fractions(value: Any, shape: tuple[int | None, ...], where: str, *, largest: float = 1.0) -> np.ndarray:
    """Return an array of numbers from 0 to 1, or to another largest one; truth values count as such."""
    array = numbers(_as_numbers(value, shape, where), shape, where)
    if (outside := (array < 0.0) | (array > largest)).any():
        index = tuple(int(i) for i in np.argwhere(outside)[0])
        number = f"number {index[0]}" if len(index) == 1 else f"entry {list(index)}"
        allowed = f"0 to {largest:g}" if np.isfinite(largest) else "0 or more"
        raise UserError(f"{where}: {number} is {digits(array[index])}, expected {allowed}{_remedy(array)}")
    return array


def _remedy(array: np.ndarray) -> str:
    """Return what numbers that should be from 0 to 1 seem to be, and what to do then; "" if that is unknown."""
    if array.min() >= -_ROUNDING and array.max() <= 1.0 + _ROUNDING:
        return " (a rounding error? limit it to that range)"
    return " (apply the sigmoid first)" if array.min() < 0.0 else ""


def truth_values(value: Any, shape: tuple[int | None, ...], where: str) -> np.ndarray:
    """Return an array of truth values, which the file may give as 0 and 1."""
    array = numbers(_as_numbers(value, shape, where), shape, where)
    if (other := (array != 0) & (array != 1)).any():
        index = tuple(int(i) for i in np.argwhere(other)[0])
        raise UserError(f"{where} holds {digits(array[index])}{place(index)}, expected 0 or 1")
    return array == 1


def _as_numbers(value: Any, shape: tuple[int | None, ...], where: str) -> Any:
    """Return numbers as an array, truth values as 0 and 1; anything else as it is, for `numbers` to refuse."""
    _check_size(value, shape, where)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RecursionError):
        return value
    if array.dtype.kind in "iuf":
        return array
    return array.astype(np.int64) if array.dtype == bool else value


def is_text(value: Any) -> bool:
    """Return whether a value is a text that can be written; half a character (a surrogate) cannot."""
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_name(value: Any) -> bool:
    """Return whether a value is a text that can be written, or a whole number of at most 64 bits."""
    # Python refuses to write integers of more than 4300 digits.
    return is_text(value) or (is_whole(value) and abs(int(value)) < 2**64)


def is_time(text: str) -> bool:
    """Return whether a text is a whole number that fits in 64 bits, as a time in nanoseconds does."""
    return text.isdecimal() and len(text) <= 19 and int(text) <= np.iinfo(np.int64).max


def file_within(folder: Path, name: Any, where: str) -> Path:
    """Return the file of a relative name in a folder; a name that leads out of the folder is refused."""
    if not is_text(name) or not name.isprintable():
        raise UserError(f"{where} is {shown(name)}, expected the name of a file")
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise UserError(f"{where}: {shown(name)} is not within the folder {folder}: use a relative name")
    return folder / name


def whole_number(value: Any, low: int, high: int, where: str) -> int:
    """Return a whole number from `low` to `high`."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if not _is_number(value) or not low <= value <= high or value != int(value):
        raise UserError(f"{where} is {shown(value)}, expected a whole number from {low} to {high}")
    return int(value)
