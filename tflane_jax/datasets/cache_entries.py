"""The entries of the cache folder: what they are, how large, when last used; deleting them.

Beside the datasets of `cache`, the folder holds `markers` (`marker_cache`), `programs` (compiled ones) and `weights`
(files that were put there). Other files and folders are not ours: they are neither listed nor deleted.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tflane_jax.errors import UserError
from tflane_jax.files.locks import take

_KINDS = {"markers": "markers found in images", "programs": "compiled programs", "weights": "published weights"}
_DATASET = re.compile(r".+-[0-9a-f]{16}(\.building-.*)?")
BEING_BUILT = "being built by a process"


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
    def building(self) -> bool:
        """Whether a process was building it when it was listed."""
        return self.kind == BEING_BUILT

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
        found = [_entry(path, kind) for path in folders if (kind := _kind(path))]
    except OSError as error:
        raise UserError(f"cannot read the cache {root}: {error.strerror or error}") from error
    return sorted(filter(None, found), key=lambda entry: (-entry.size, entry.path.name))


def delete_entry(entry: Entry) -> None:
    """Delete an entry with its lock file; raises UserError if that fails or another process builds it."""
    lock = _lock_of(entry.path)
    try:
        with _holding(lock) as free:
            if not free:
                raise UserError(f"{entry.path.name} is being built by another process: wait for it")
            # Renamed first: a reader finds the whole entry or none.
            aside = lock.with_name(f"{lock.stem}.building-deleted-{os.getpid()}")
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
    with _holding(_lock_of(path)) as free:
        if not free:
            return BEING_BUILT
    return "left by a stopped build" if found[1] else "examples"


def _entry(path: Path, kind: str) -> Entry | None:
    """Return an entry; None for a build that ended while its files were counted."""
    states = []
    for each in path.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            if each.is_file():
                states.append(each.stat())
    if not states:
        try:
            states = [path.stat()]
        except FileNotFoundError:
            return None
    size = sum(state.st_blocks * 512 if hasattr(state, "st_blocks") else state.st_size for state in states)
    return Entry(path, kind, size, max(max(state.st_atime, state.st_mtime) for state in states))


def _lock_of(path: Path) -> Path:
    """Return the file that the builder of an entry holds, see `cache._only_builder`."""
    return path.with_name(f"{path.name.partition('.building-')[0]}.lock")


@contextlib.contextmanager
def _holding(lock: Path) -> Iterator[bool]:
    """Hold a lock file for the block if it is there and free; yield whether no other process holds it."""
    if not lock.exists():
        yield True
        return
    with open(lock, "a") as file:
        yield take(file)
