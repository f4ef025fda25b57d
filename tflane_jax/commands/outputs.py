"""What a command writes must replace neither what it reads nor a part of a run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_stem, check_writable
from tflane_jax.training.run_folder import is_part_of_run


def check_output(path: Path, reads: Iterable[Path] = ()) -> None:
    """Raise UserError if a file cannot be written there, is a run's own, or is one to read; nothing is created.

    Args:
        path: of the file to write.
        reads: files to read, and folders of data.
    """
    check_writable(path)
    if is_part_of_run(path):
        raise UserError(f"--out would write over {path}, which is a part of a run: choose another name")
    for each in reads:
        if _holds(each, path):
            where = "" if path.samefile(each) else f" of {each}"
            raise UserError(f"--out would write over {path}, a file{where} that is read: choose another name")


def check_table(stem: Path, reads: Iterable[Path] = ()) -> None:
    """Do the same for STEM.md and STEM.json."""
    check_stem(stem)
    reads = list(reads)
    for suffix in (".md", ".json"):
        check_output(stem.with_name(stem.name + suffix), reads)


def folders_of(*sources: Any) -> list[Path]:
    """Return the folders from which sources of `datasets.sources` read; the built-in world has none."""
    return [Path(source.root) for source in sources if getattr(source, "root", None) is not None]


def _holds(read: Path, path: Path) -> bool:
    """Return whether an existing file is the one that is read, or lies in the folder that is read."""
    try:
        return path.samefile(read) or (path.exists() and path.resolve().is_relative_to(read.resolve()))
    except OSError:
        return False
