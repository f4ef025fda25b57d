"""Names of folders, also of `.` and `..`, and the right level where a folder above or below was named."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

_ABOVE = 3
"""Levels above a named folder at which a data set's own is looked for."""


def named_folder(path: Path) -> Path:
    """Return a path whose last part is the folder's name; `.` and `..` become absolute, others stay as they are.

    For formats in which the name of a folder, or what lies beside it, means something: `Path(".")` has an empty name
    and is its own parent.
    """
    path = Path(path)
    return path if path.name not in ("", "..") else Path(os.path.abspath(path))


def folder_nearby(root: Path, holds: Callable[[Path], bool]) -> Path | None:
    """Return the folder that a user meant who named one of another level; None without one.

    Args:
        root: the named folder.
        holds: whether a folder is of the right kind. It is asked of those up to three levels above and one below.
    """
    above = Path(os.path.abspath(root)).parents[:_ABOVE]
    below = sorted(path for path in root.glob("*") if path.is_dir())
    return next((folder for folder in (*above, *below) if holds(folder)), None)
