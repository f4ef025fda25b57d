"""Datasets built once and kept on disk as memory-mappable arrays.

An entry is a folder with one .npy file per leaf of an example and an `index.json`. Its name contains a fingerprint of
the dataset's configuration and of the code that makes examples, so a changed world never reads stale examples. An entry
appears whole or not at all: it is built under a lock beside its final path and then renamed.
"""

from __future__ import annotations

import contextlib
import copy
import errno
import hashlib
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tflane_jax.cores import working_cores
from tflane_jax.datasets.base import FrameInfo, IndexedExamples
from tflane_jax.datasets.leaves import example_from_leaves
from tflane_jax.datasets.parallel import fill, frame_leaves, leaf_path
from tflane_jax.datasets.source_digest import source_digest
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import rename_flushed
from tflane_jax.files.locks import is_at, take
from tflane_jax.scene import Example

# Errors of a folder that cannot be a cache.
_UNUSABLE = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG),
    *(errno.ELOOP, errno.EIO, errno.ESTALE, errno.ENOENT, errno.EINVAL),
)

_UNGUARDED = (
    'a script builds a dataset outside `if __name__ == "__main__":`, and worker processes import the script: put what '
    "it does below that line"
)


class Cacheable(IndexedExamples, Protocol):
    """A dataset that its configuration describes completely, and that can be pickled for worker processes."""

    @property
    def config(self) -> object:
        """Frozen dataclass; its repr is part of the fingerprint."""
        ...


def cache_root() -> Path:
    """Return the folder of all entries: $TFLANE_CACHE, or ~/.cache/tflane_jax."""
    named = os.environ.get("TFLANE_CACHE")
    try:
        root = Path(named).expanduser() if named else Path.home() / ".cache" / "tflane_jax"
    except RuntimeError as error:  # ~user without such a user, or no home folder
        raise UserError(f"TFLANE_CACHE is {named or 'not set'}: {error}; set it to a folder") from error
    if named and root.exists() and not root.is_dir():
        raise UserError(f"TFLANE_CACHE is {named}, which is no folder: set it to one")
    return root


def cached(
    dataset: Cacheable, *, root: Path | None = None, workers: int | None = None, progress: bool = True
) -> CachedDataset:
    """Return the dataset read from its cache entry, which is built first if it is missing or damaged.

    Args:
        dataset: its examples all have the same shapes.
        root: folder of the entries, default `cache_root()`.
        workers: processes that build, by default `cores.working_cores`; the result does not depend on it. For more
            than one the caller's script must be guarded by `if __name__ == "__main__":`.
        progress: show a bar with rate and time left while building.

    Raises:
        UserError: an empty dataset, a full disk, a folder that cannot be written, a worker that died.
    """
    if len(dataset) == 0:
        raise UserError(f"dataset {dataset.name} has no examples: ask for at least one scene")
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # A worker that imports the script again: it would wait for the lock of the builder that waits for it.
        raise SystemExit(_UNGUARDED)
    root = cache_root() if root is None else root
    mark = fingerprint(dataset)
    folder = root / f"{dataset.name.replace('/', '-')}-{mark[:16]}"
    with contextlib.suppress(DamagedEntry, FileNotFoundError):
        return CachedDataset(folder)
    try:
        root.mkdir(parents=True, exist_ok=True)
        with _only_builder(folder) as alone:
            # Another process may have finished it while this one waited for the lock.
            with contextlib.suppress(DamagedEntry, FileNotFoundError):
                return CachedDataset(folder)
            if alone:  # any such folder was left behind by a killed build
                for stale in folder.parent.glob(f"{folder.name}.building-*"):
                    shutil.rmtree(stale, ignore_errors=True)
            _build(dataset, folder, mark, workers or working_cores(), progress)
    except OSError as error:
        raise _explain(error, root) from error
    return CachedDataset(folder)


def fingerprint(dataset: Cacheable) -> str:
    """Return the hash of all that an entry depends on: configuration, code and the versions of libraries."""
    digest = hashlib.sha256()
    for text in (_kind(dataset), repr(dataset.config), source_digest()):
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()


def _kind(dataset: IndexedExamples) -> str:
    return f"{type(dataset).__module__}.{type(dataset).__qualname__}"


class DamagedEntry(Exception):
    """A cache entry is incomplete or altered."""


class CachedDataset:
    """A dataset read from a cache entry; arrays are memory-mapped and read on access.

    Raises FileNotFoundError if there is no entry, and `DamagedEntry` if a file is missing or has another length.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        if not folder.is_dir():
            raise FileNotFoundError(f"no cache entry at {folder}")
        try:
            self._index = json.loads((folder / "index.json").read_text(encoding="utf-8"))
            self.name: str = self._index["name"]
            self.config_text: str = self._index["config"]
            self._scenes: list[str] = self._index["scenes"]
            self._arrays = {name: self._map(name) for name in self._index["leaves"]}
            if not _is_whole(self._index, self._arrays):
                raise ValueError("index.json is not what was written")
        except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, RecursionError) as error:
            raise DamagedEntry(f"{folder}: {error}") from error

        self._parts: frozenset[str] | None = None

    def __reduce__(self):
        # Pickled maps would be whole arrays: another process opens the files itself.
        return _reopened, (self.folder, self._parts)

    def only(self, parts: Collection[str]) -> CachedDataset:
        """Return the same entry with only these fields of its examples."""
        chosen = copy.copy(self)
        chosen._parts = frozenset(parts)
        return chosen

    def _map(self, name: str) -> np.ndarray:
        path, expected = leaf_path(self.folder, name), self._index["leaves"][name]["bytes"]
        if path.stat().st_size != expected:
            raise ValueError(f"{path.name} has {path.stat().st_size} bytes, {expected} were written")
        return np.load(path, mmap_mode="r")

    def __len__(self) -> int:
        return len(self._scenes)

    def example(self, index: int) -> Example:
        """Return one example, read from disk."""
        return example_from_leaves({name: np.array(array[index]) for name, array in self._leaves().items()})

    def scene(self, index: int) -> str:
        """Return the scene of one example."""
        return self._scenes[index]

    def info(self, index: int) -> FrameInfo:
        """Return where one example comes from."""
        return FrameInfo(
            source=self._index["source"],
            scene=self._scenes[index],
            timestamp_ns=int(self._arrays["info.timestamp_ns"][index]),
            global_from_ego=np.array(self._arrays["info.global_from_ego"][index]),
        )

    def arrays(self, parts: Collection[str] | None = None, *, mapped: bool = False) -> Mapping[str, np.ndarray]:
        """Read the leaves of all examples, (len, ...) each, and check them against their checksums.

        Args:
            parts: fields of the examples to read, default all.
            mapped: leave them on disk, as read-only memory maps, instead of holding them in memory.

        Raises UserError where the content of a file has changed since it was written.
        """
        read = {}
        for name, array in self._leaves().items():
            if parts is None or name.split(".")[0] in parts:
                read[name] = array.view(np.ndarray) if mapped else np.array(array)
                self._check(name, read[name])
        return read

    def check(self) -> None:
        """Compare the files with their checksums, for examples that are read one by one; raises UserError."""
        for name, array in self._leaves().items():
            self._check(name, array.view(np.ndarray))

    def _check(self, name: str, array: Any) -> None:
        if zlib.crc32(array.reshape(-1).view(np.uint8)) != self._index["leaves"][name]["crc32"]:
            raise UserError(f"{leaf_path(self.folder, name)} is corrupt: delete {self.folder} and run again")

    def nbytes(self, parts: Collection[str]) -> int:
        """Return the bytes that these fields of all examples take in memory."""
        return sum(array.nbytes for name, array in self._leaves().items() if name.split(".")[0] in parts)

    def _leaves(self) -> dict[str, np.ndarray]:
        part = {name: name.split(".")[0] for name in self._arrays}
        wanted = set(part.values()) - {"info"} if self._parts is None else self._parts
        return {name: array for name, array in self._arrays.items() if part[name] in wanted}


def _reopened(folder: Path, parts: frozenset[str] | None) -> CachedDataset:
    try:
        entry = CachedDataset(folder)
    except (DamagedEntry, FileNotFoundError) as error:
        raise UserError(f"the examples in {folder} changed while they were used ({error}): run again") from error
    return entry if parts is None else entry.only(parts)


def _is_whole(index: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bool:
    """Return whether an index has entries of the right types, and arrays as many examples as it names."""
    scenes, sums = index["scenes"], [leaf["crc32"] for leaf in index["leaves"].values()]
    texts = [index["name"], index["config"], index["source"], *scenes]
    lengths = {len(array) for array in (*arrays.values(), arrays["info.timestamp_ns"], arrays["info.global_from_ego"])}
    typed = isinstance(scenes, list) and all(isinstance(text, str) for text in texts)
    return typed and lengths == {len(scenes)} and all(type(one) is int for one in sums)


def _build(dataset: Cacheable, folder: Path, mark: str, workers: int, progress: bool) -> None:
    """Build the entry beside its final path and rename it, unless it is there by then: not all disks have locks."""
    template, _ = frame_leaves(dataset, 0)
    needed = len(dataset) * sum(leaf.nbytes for leaf in template.values())
    if needed > shutil.disk_usage(folder.parent).free:
        raise OSError(errno.ENOSPC, f"{dataset.name} needs {needed / 1e9:.2f} GB")
    temporary = Path(tempfile.mkdtemp(prefix=f"{folder.name}.building-", dir=folder.parent))
    try:
        scenes = fill(temporary, dataset, template, workers=workers, progress=progress)
        index = {
            "name": dataset.name,
            "source": dataset.info(0).source,
            "kind": _kind(dataset),
            "config": repr(dataset.config),
            "fingerprint": mark,
            "leaves": {name: _summary(leaf_path(temporary, name)) for name in template},
            "scenes": scenes,
        }
        (temporary / "index.json").write_text(json.dumps(index, indent=1), encoding="utf-8")
        with contextlib.suppress(DamagedEntry, FileNotFoundError):
            CachedDataset(folder)
            return
        if folder.is_dir():  # damaged
            shutil.rmtree(folder)
        else:
            folder.unlink(missing_ok=True)
        rename_flushed(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _summary(path: Path) -> dict[str, int]:
    """Return size and checksum of a leaf's file."""
    values = np.load(path, mmap_mode="r")
    return {"bytes": path.stat().st_size, "crc32": zlib.crc32(values.reshape(-1).view(np.uint8))}


@contextlib.contextmanager
def _only_builder(folder: Path) -> Iterator[bool]:
    """Hold the entry's lock; give whether there are locks. Without, two processes may build one entry at once."""
    alone = True

    def without_locks(reason: str) -> None:
        nonlocal alone
        alone = False
        print(
            f"{folder.parent}: this file system has no locks ({reason}): processes that need the same examples at once "
            "may each make them",
            file=sys.stderr,
        )

    path = folder.with_name(folder.name + ".lock")
    with contextlib.ExitStack() as stack:
        while True:
            lock = stack.enter_context(open(path, "w"))
            if not take(lock, tell=without_locks):
                print(f"waiting for another process that builds {folder.name}", file=sys.stderr)
                take(lock, wait=True)
            # Whoever deletes an entry deletes its lock too, perhaps while this process waited for it.
            if is_at(lock.fileno(), path):
                break
        yield alone


def _on_the_way(name: Any, root: Path) -> bool:
    """Return whether a path is `root`, below it, or a folder above it, which is made before it."""
    path, root = Path(os.fsdecode(name)).absolute(), root.absolute()
    return path.is_relative_to(root) or root.is_relative_to(path)


def _explain(error: OSError, root: Path) -> Exception:
    """Return a UserError with a remedy for a failure to write below `root`; return any other error unchanged."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        remedy = "free space there, ask for fewer scenes, or set TFLANE_CACHE to a folder on another disk"
    elif error.errno in _UNUSABLE and (error.filename is None or _on_the_way(error.filename, root)):
        remedy = "set TFLANE_CACHE to a folder that can be written"
    else:
        return error
    return UserError(f"cannot keep the dataset in {root}: {error.strerror}; {remedy}")
