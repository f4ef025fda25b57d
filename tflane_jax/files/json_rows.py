"""Rows of a JSON file that is one long list, read one after another so that unwanted rows take no memory."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.files.fields import read_text

_SPACE = re.compile(r"[ \t\n\r]*")


def json_rows(path: Path) -> Iterator[Any]:
    """Yield the entries of the list in a JSON file.

    Memory holds the text and the row at hand: a table of nuScenes has millions of rows of which few are wanted.

    Raises:
        UserError: the file cannot be read, is no JSON, or holds something other than one list; names the file and,
            where there is one, the line.
    """
    text = read_text(Path(path))
    place = _after_space(text, 0)
    if text[place : place + 1] != "[":
        raise UserError(f"{path} is no JSON list: it starts with {text[place : place + 10]!r}")
    decoder = json.JSONDecoder()
    place = _after_space(text, place + 1)
    more = text[place : place + 1] != "]"
    while more:
        try:
            row, place = decoder.raw_decode(text, place)
        except json.JSONDecodeError as error:
            raise UserError(f"{path} is no JSON file: {error.msg} in line {error.lineno}") from None
        except RecursionError:
            raise UserError(f"{path} is no JSON file of this kind: its lists are nested too deep") from None
        except ValueError as error:  # an integer of more than 4300 digits
            raise UserError(f"{path} is no JSON file that can be read: {str(error).partition(';')[0]}") from None
        yield row
        place = _after_space(text, place)
        more = text[place : place + 1] == ","
        if more:
            place = _after_space(text, place + 1)
        elif text[place : place + 1] != "]":
            line = text.count("\n", 0, place) + 1
            raise UserError(f"{path} is no JSON list: expected ',' or ']' in line {line}; is the file cut off?")
    if _after_space(text, place + 1) != len(text):
        raise UserError(f"{path} is no JSON list: something follows the list")


def _after_space(text: str, place: int) -> int:
    match = _SPACE.match(text, place)
    assert match is not None
    return match.end()
