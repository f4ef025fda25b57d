"""Where configurations are found: a Python file, or the name of one that the package ships.

A checkout keeps the shipped configurations in `configs/` beside the package, a wheel in `tflane_jax/configs/`.
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path

import tflane_jax
from tflane_jax.errors import UserError

_PACKAGE = Path(tflane_jax.__file__).resolve().parent
_FOLDERS = (_PACKAGE / "configs", _PACKAGE.parent / "configs")


def split_reference(reference: str) -> tuple[str, str]:
    """Split `path.py:ablation` or `system/name:ablation` into file or name, and ablation ("" without one)."""
    path, separator, ablation = reference.partition(".py:")
    if separator:
        return f"{path}.py", ablation
    if reference.endswith(".py"):
        return reference, ""
    name, _, ablation = reference.partition(":")
    return name, ablation


def shipped_configs() -> dict[str, Path]:
    """Return name -> file of every configuration that comes with the package, such as `tf_lane/toponet_tfm`."""
    folder = next((folder for folder in _FOLDERS if folder.is_dir()), None)
    if folder is None:
        return {}
    paths = (path for path in sorted(folder.rglob("*.py")) if not path.name.startswith("_"))
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in paths}


def is_shipped(path: Path) -> bool:
    """Return whether a file is one of the package's configurations."""
    return any(path.resolve().is_relative_to(folder) for folder in _FOLDERS)


def find_config(name: str) -> Path:
    """Return the file of a configuration: an existing file first, else the shipped one of that name.

    Raises:
        UserError: neither exists; the message lists the shipped names closest to it.
    """
    if not name:
        raise UserError("the name of the config file is empty: name a Python file or a shipped configuration")
    path = Path(name)
    if path.is_file():
        return path
    shipped = shipped_configs()
    if name in shipped:
        return shipped[name]
    if os.path.lexists(path):
        kind = "a folder" if path.is_dir() else "no regular file" if path.exists() else "a link that leads nowhere"
        raise UserError(f"config file {name} is {kind}: name a Python file (.py)")
    raise UserError(f"config file {name} does not exist: {_hint(name, shipped)}")


def _hint(name: str, shipped: dict[str, Path]) -> str:
    if Path(f"{name}.py").is_file():
        return f"did you mean {name}.py?"
    wanted = name.removesuffix(".py").rpartition("configs/")[2]
    if wanted in shipped:
        return f"the shipped configuration is called {wanted}"
    close = difflib.get_close_matches(wanted, shipped, 3)
    close = close or [known for known in shipped if known.rpartition("/")[2] == wanted.rpartition("/")[2]]
    return f"did you mean {' or '.join(close)}?" if close else f"the package ships {', '.join(shipped)}"
