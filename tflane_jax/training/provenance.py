"""Where a run's numbers come from: code, versions, machine, command."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax

import tflane_jax
from tflane_jax.files.atomic import write_json

_PACKAGES = ("tflane_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "scipy")


def provenance() -> dict[str, Any]:
    """Return what is needed to know which program gave these numbers, as plain JSON."""
    device = jax.devices()[0]
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "git": _git(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": f"{device.platform}: {device.device_kind} x {jax.device_count()}",
    }


def add_provenance(folder: Path) -> None:
    """Append this start to the run folder's provenance.json."""
    path = folder / "provenance.json"
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        earlier = []
    write_json(path, [*earlier, provenance()])


def _git() -> dict[str, Any] | None:
    """Return commit and uncommitted changes of the checkout that runs; None for an installed package."""
    root = Path(tflane_jax.__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # A package installed inside some other project's checkout is not that project's code.
        if not git("ls-files", "--", str(root / "__init__.py")):
            return None
        return {"commit": git("rev-parse", "HEAD"), "uncommitted_changes": bool(git("status", "--porcelain", "-uno"))}
    except (OSError, subprocess.SubprocessError):
        return None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
