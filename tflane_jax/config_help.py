"""What the settings of a configuration mean, from the docstrings of their classes."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Sequence
from functools import cache
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from tflane_jax.config_io import settings, value_text

_ENTRY = re.compile(r" {4}(\w+(?:, \w+)*): (.*)")
_SENTENCE = re.compile(r"(?<!Fig)(?<!Eq)(?<!Eqs)(?<! al)(?<=[\w)`\"'])\.(?= |$)")
_WHOLE = 160
"""A text of so many characters stands whole, of a longer one its first sentence."""
_WIDTH, _COLUMN = 120, 62


def explained(config: Any) -> str:
    """Return every setting with its value and, behind it, what its class says of it, or the first sentence of that."""
    rows = (_row(f"{name} = {value_text(value)}", meaning(config, name)) for name, value in settings(config))
    return "".join(f"{line}\n" for row in rows for line in row)


def meaning(config: Any, name: str) -> str:
    """Return what the setting of that dotted name means, as in `explained`; "" for none."""
    *parts, last = name.split(".")
    for part in parts:
        config = getattr(config, part, None)
    return meanings(type(config)).get(last, "")


@cache
def meanings(kind: type) -> dict[str, str]:
    """Return what the docstring of a class, or of its bases, says of each attribute; of long texts a sentence.

    Behind it stand the words that are allowed, where it does not name them all.
    """
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        _, _, section = inspect.cleandoc(base.__dict__.get("__doc__") or "").partition("\nAttributes:\n")
        names: list[str] = []
        for line in section.splitlines():
            if (entry := _ENTRY.fullmatch(line)) is not None:
                elsewhere = entry[2].startswith("see `")  # what a base says is better
                names = [name for name in entry[1].split(", ") if not (elsewhere and name in found)]
                found |= dict.fromkeys(names, entry[2])
            elif line.startswith(" " * 8) and names:
                found |= {name: f"{found[name]} {line.strip()}" for name in names}
            elif line:
                break
    hints = get_type_hints(kind)
    short = {name: text if len(text) <= _WHOLE else _SENTENCE.split(text)[0] for name, text in found.items()}
    return {name: _with_words(text.rstrip("."), _words(hints.get(name))) for name, text in short.items()}


def _words(hint: Any) -> list[str]:
    """Return the words that a type allows, alone or in a tuple, as the help writes them; [] for any other type."""
    if get_origin(hint) in (Union, UnionType, tuple):
        return [word for part in get_args(hint) for word in _words(part)]
    return [f'"{word}"' for word in get_args(hint)] if get_origin(hint) is Literal else []


def _with_words(text: str, words: Sequence[str]) -> str:
    """Return a text, with the words behind it if it lacks one."""
    return text if all(word in text for word in words) else f"{text} (allowed: {', '.join(words)})"


def _row(setting: str, meaning: str) -> list[str]:
    """Return the setting with its meaning beside it, or below it where it is too long for that."""
    width = _WIDTH - _COLUMN - 2
    comment = [f"# {line}" for line in textwrap.wrap(meaning, width, break_long_words=False, break_on_hyphens=False)]
    if comment and len(setting) < _COLUMN:
        setting = f"{setting:<{_COLUMN}}{comment.pop(0)}"
    return [setting, *(" " * _COLUMN + line for line in comment)]
