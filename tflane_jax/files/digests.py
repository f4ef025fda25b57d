"""Hashes of files."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable
from pathlib import Path

from tflane_jax.errors import UserError


def files_content(files: Iterable[Path]) -> str:
    """Return a hash of the names and the content of files in any order, as `DataSource.content` gives it.

    All files are read, once in a process. Raises UserError for one that cannot be read.
    """
    return hashlib.sha256(b"".join(map(file_content, sorted(files)))).hexdigest()


def file_content(file: Path) -> bytes:
    """Return the name of a file and a hash of its content; raises UserError if it cannot be read.

    It is read once as long as its size and the time of its last change stay: scenes share large tables and maps.
    """
    try:
        state = file.stat()
        content = _digest(file, state.st_size, state.st_mtime_ns)
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from None
    return file.name.encode() + b"\0" + content + b"\0"


@functools.cache
def _digest(file: Path, size: int, changed_ns: int) -> bytes:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").digest()
