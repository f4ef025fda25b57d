"""Paths whose last part is the folder's name, also for `.` and `..`."""

from __future__ import annotations

import os
from pathlib import Path


def named_folder(path: Path) -> Path:
    """Return a path whose last part is the folder's name; `.` and `..` become absolute, others stay as they are.

    For formats in which the name of a folder, or what lies beside it, means something: `Path(".")` has an empty name
    and is its own parent.
    """
    path = Path(path)
    return path if path.name not in ("", "..") else Path(os.path.abspath(path))
