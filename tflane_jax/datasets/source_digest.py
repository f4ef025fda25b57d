"""What code makes the examples of the cache, and reads the boards of its images, as one hash."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import types
from pathlib import Path
from typing import Any

import tflane_jax

# Packages whose code determines the examples; `files` reads the maps of recorded logs.
_SOURCES = ("scene", "geometry", "files", "world", "markers", "datasets")
# Libraries by which it draws, searches images, merges areas and finds neighbours; OpenCV has several names.
_OPENCV = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless")
_LIBRARIES = ("numpy", "scipy", "shapely", *_OPENCV)


@functools.cache
def source_digest() -> str:
    """Return the hash of the code that makes examples, without comments, docstrings and layout, and of libraries."""
    package = Path(tflane_jax.__file__).parent
    found = [path for name in _SOURCES for path in (package / name, *(package / name).rglob("*.py"))]
    digest = hashlib.sha256()
    for file in sorted(path for path in found if path.is_file()):
        digest.update(file.relative_to(package).as_posix().encode() + b"\0")
        digest.update(_code(file.read_text(encoding="utf-8")).encode() + b"\0")
    for name in _LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            digest.update(f"{name} {importlib.metadata.version(name)}".encode() + b"\0")
    return digest.hexdigest()


def _code(source: str) -> str:
    """Return the compiled program of a source as text; each version of Python has its own.

    Comments, asserts, line breaks and what docstrings say are no part of it. `ast.dump` would take twice as long: a
    second for all files.
    """
    return repr(_instructions(compile(source, "", "exec", dont_inherit=True, optimize=2)))


def _instructions(code: types.CodeType) -> tuple[Any, ...]:
    names = (code.co_qualname, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    counts = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
    return *names, *counts, code.co_code, code.co_exceptiontable, *map(_constant, code.co_consts)


def _constant(value: Any) -> Any:
    if isinstance(value, types.CodeType):
        return _instructions(value)
    # Each process keeps a set of strings in another order.
    return sorted(map(repr, value)) if isinstance(value, frozenset) else value
