"""Where the reference data lies, and skipping where it does not."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def shared_root() -> Path:
    """Return the folder of real data and golden numbers (it may not exist)."""
    return Path(os.environ.get("TFLANE_SHARED", ROOT.parent / "shared"))


def shared_path(relative: str) -> Path:
    """Return a path under the shared folder; skip the calling test, saying why, where it is absent."""
    path = shared_root() / relative
    if not path.exists():
        pytest.skip(f"needs {relative} under TFLANE_SHARED (looked in {shared_root()})")
    return path
