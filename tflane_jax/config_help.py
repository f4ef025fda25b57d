"""What the settings of a configuration mean, from the docstrings of their classes."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from functools import cache
from typing import Any

from tflane_jax.config_io import settings, value_text

_ENTRY = re.compile(r" {4}(\w+(?:, \w+)*): (.*)")
_SENTENCE = re.compile(r"(?<!Fig)(?<!Eq)(?<!Eqs)(?<! al)(?<=[\w)`\"'])[.;](?= |$)")
_WHOLE = 160
"""A text of so many characters stands whole, of a longer one its first sentence."""
_WIDTH, _COLUMN = 120, 62


def explained(config: Any) -> str:
    """Return every setting with its value and, behind it, what its class says of it, or the first sentence of that."""
    parts, lines = {"": config}, []
    for name, value in settings(config):
        if dataclasses.is_dataclass(value):
            parts[name] = value
        part, _, last = name.rpartition(".")
        lines += _row(f"{name} = {value_text(value)}", meanings(type(parts[part])).get(last, ""))
    return "\n".join(lines) + "\n"


def meaning(config: Any, name: str) -> str:
    """Return what the setting of that dotted name means, as in `explained`; "" for none."""
    *parts, last = name.split(".")
    for part in parts:
        config = getattr(config, part, None)
    return meanings(type(config)).get(last, "")


@cache
def meanings(kind: type) -> dict[str, str]:
    """Return what the docstring of a class, or of its bases, says of each attribute; of long texts a sentence."""
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
    return {
        name: (text if len(text) <= _WHOLE else _SENTENCE.split(text)[0]).rstrip(".") for name, text in found.items()
    }


def _row(setting: str, meaning: str) -> list[str]:
    comment = textwrap.wrap(meaning, _WIDTH - _COLUMN - 2, break_long_words=False, break_on_hyphens=False)
    if not comment:
        return [setting]
    left = [setting] if len(setting) < _COLUMN else [setting, ""]
    left += [""] * (len(comment) - 1)
    right = ([""] if len(setting) >= _COLUMN else []) + [f"# {line}" for line in comment]
    return [f"{first:<{_COLUMN}}{second}".rstrip() for first, second in zip(left, right, strict=True)]
