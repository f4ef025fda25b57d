"""The description of a checkpoint, manifest.json beside its arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

VERSION = 1


@dataclass(frozen=True)
class Manifest:
    """Description of a checkpoint.

    Attributes:
        step: updates made.
        config: the run's resolved configuration, plain JSON.
        metrics: of the evaluation at this step; empty where there was none.
        progress: what the loop restores beside the state, so that a resumed run gives the same records.
        files: CRC-32 of every file of the state, by path relative to the checkpoint.
        version: of this layout.
    """

    step: int
    config: dict[str, Any]
    metrics: dict[str, float] = field(default_factory=dict)
    progress: dict[str, Any] = field(default_factory=dict)
    files: dict[str, int] = field(default_factory=dict)
    version: int = VERSION


def wrong_entry(content: Any, step: int) -> str | None:
    """Return the name of the first entry of a manifest (JSON) that is absent, unknown or wrong, None for none."""
    if not isinstance(content, dict):
        return "it"
    fits: dict[str, Callable[[Any], bool]] = {
        "step": lambda value: type(value) is int and value == step,
        "version": lambda value: value == VERSION,
        **dict.fromkeys(("config", "progress"), lambda value: isinstance(value, dict)),
        **dict.fromkeys(("metrics", "files"), _holds_numbers),
    }
    names = ("step", "config", *content)  # the others have defaults
    return next((name for name in names if name not in fits or not fits[name](content.get(name))), None)


def _holds_numbers(value: Any) -> bool:
    return isinstance(value, dict) and all(
        type(v) is float or (type(v) is int and abs(v) < 2**63) for v in value.values()
    )
