"""The entries of the cache folder: what they are, how large, when last used; deleting them.

Beside the datasets of `cache`, the folder holds `markers` (`marker_cache`), `programs` (compiled ones) and `weights`
(files that were put there). Other files and folders are not ours: they are neither listed nor deleted.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from tflane_jax.errors import UserError

_KINDS = {"markers": "markers found in images", "programs": "compiled programs", "weights": "published weights"}
_DATASET = re.compile(r".+-[0-9a-f]{16}(\.building-.*)?")


@dataclass(frozen=True)
class Entry:
    """A folder of the cache.

    Attributes:
        path: of the folder.
        kind: what it holds, in words.
        size: bytes of its files.
        used: when one of them was last read or written, seconds since 1970. File systems update it at most once a day.
    """

    path: Path
    kind: str
    size: int
    used: float

    @property
    def made(self) -> bool:
        """Whether tflane makes the content anew where it is missing."""
        return self.path.name != "weights"

    @property
    def days(self) -> float:
        """Days since it was last used."""
        return max(time.time() - self.used, 0.0) / 86_400.0


def cache_entries(root: Path) -> list[Entry]:
    """Return the entries of a cache folder, the largest first; raises UserError if it cannot be read."""
    if not root.is_dir():
        return []
    try:
        folders = [path for path in root.iterdir() if path.is_dir() and not path.is_symlink()]
        entries = [_entry(path, kind) for path in folders if (kind := _kind(path))]
    except OSError as error:
        raise UserError(f"cannot read the cache {root}: {error.strerror or error}") from error
    return sorted(entries, key=lambda entry: (-entry.size, entry.path.name))


def delete_entry(entry: Entry) -> None:
    """Delete an entry with its lock file; raises UserError if that fails or another process builds it."""
    lock = entry.path.with_name(f"{entry.path.name.partition('.building-')[0]}.lock")
    try:
        if _is_held(lock):
            raise UserError(f"{entry.path.name} is being built by another process: wait for it")
        # Renamed first: a reader finds the whole entry or none.
        aside = entry.path.with_name(f"{entry.path.name.partition('.building-')[0]}.building-deleted-{os.getpid()}")
        entry.path.rename(aside)
        shutil.rmtree(aside)
        lock.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"cannot delete {entry.path}: {error.strerror or error}") from error


def _kind(path: Path) -> str:
    if path.name in _KINDS:
        return _KINDS[path.name]
    if (found := _DATASET.fullmatch(path.name)) is None:
        return ""
    return "left by a stopped build" if found[1] else "examples"


def _entry(path: Path, kind: str) -> Entry:
    states = [each.stat() for each in path.rglob("*") if each.is_file()] or [path.stat()]
    size = sum(state.st_blocks * 512 if hasattr(state, "st_blocks") else state.st_size for state in states)
    return Entry(path, kind, size, max(max(state.st_atime, state.st_mtime) for state in states))


def _is_held(lock: Path) -> bool:
    try:
        import fcntl
    except ImportError:  # Windows: builds hold no lock
        return False
    if not lock.exists():
        return False
    with open(lock, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
