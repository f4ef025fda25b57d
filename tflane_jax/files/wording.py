"""Values, names and numbers of untrusted files as messages show them: short, and on one line."""

from __future__ import annotations

import os
import reprlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError

_LONGEST_NAME, _LONGEST_STEM = 200, 200
_NAMED = 3


def shown(value: Any) -> str:
    """Return at most 40 characters of a value for a message, whatever it is.

    Python refuses to write integers of more than 4300 digits, alone or in a list.
    """
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, int) and abs(value) >= 2**63:
        return "an integer of many digits"
    try:
        return f"{reprlib.repr(value):.40}"
    except (RecursionError, ValueError):
        return f"a value {kind(value)}"


def check_name(path: Path) -> None:
    """Raise UserError for the name of an input that is not UTF-8, as in old archives: reports could not name it."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise UserError(f"cannot read {str(path)!a}: {no_utf8(path, 'rename the file')}") from None


def no_utf8(path: Path, remedy: str) -> str:
    """Return why a name cannot be encoded as UTF-8: it is not, then with the remedy, or this process read it wrongly.

    Without a UTF-8 locale, Python reads every byte that is not ASCII as a surrogate, also those of a UTF-8 name.
    """
    try:
        os.fsencode(path).decode()
    except UnicodeError:
        return f"the name is not UTF-8; {remedy}"
    return (
        f"this process reads names in the encoding of its locale, {sys.getfilesystemencoding()}, and the name is "
        "UTF-8; set PYTHONUTF8=1 or a UTF-8 locale (LC_ALL=C.UTF-8)"
    )


def plain_name(path: Path) -> str:
    """Return a name for reports, in which bytes that are not UTF-8 are escaped."""
    return str(path).encode(errors="backslashreplace").decode()


def short_stem(path: Path) -> str:
    """Return the part of a file's name to which a suffix of some 50 bytes can be added: file systems allow 255."""
    return os.fsencode(path.stem)[:_LONGEST_STEM].decode(errors="ignore")


def file_name(value: Any, where: str) -> str:
    """Return a name from which names of files are made; raises UserError if it leads elsewhere or cannot be printed."""
    plain = (
        isinstance(value, str) and value.isprintable() and not {"/", "\\"} & set(value) and value not in ("", ".", "..")
    )
    if not plain or len(value.encode()) > _LONGEST_STEM:
        raise UserError(f"{where} is {shown(value)}, expected a name that can be that of a file")
    return value


def kind(value: Any) -> str:
    """Return of which type a value is, as the end of a sentence."""
    return "missing (null)" if value is None else f"of type {type(value).__name__}"


def place(index: tuple[int, ...]) -> str:
    """Return where an array holds a number, as the end of a sentence; "" for an array that is one number."""
    return f" at {list(index)}" if index else ""


def shape_text(shape: tuple[int | None, ...]) -> str:
    """Return an expected shape; None is any size."""
    return "(" + ", ".join("any" if size is None else str(size) for size in shape) + ("," * (len(shape) == 1)) + ")"


def named(name: Any) -> str:
    """Return the name of a frame, scene or image; in quotes where it has line breaks, escape codes or outer spaces."""
    text = str(name)
    plain = text.isprintable() and text == text.strip() and text
    return f"{text if plain else repr(text):.{_LONGEST_NAME}}"


def counted(number: int, thing: str) -> str:
    """Return a number of things in words: "1 frame", "2 frames"."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def first_of(names: Sequence[Any]) -> str:
    """Return the first few of several names."""
    return ", ".join(map(named, names[:_NAMED])) + (", ..." if len(names) > _NAMED else "")


def digits(number: np.floating | np.integer) -> str:
    """Return a number with six digits, or with as many as tell it from its neighbours."""
    short = f"{number:g}"
    return short if type(number)(short) == number else str(number)
