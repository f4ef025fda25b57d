"""OpenLane-V2's collections: pickles into which the official devkit gathers the files of a split, beside the folders.

Models of the official repositories read these; `openlane_v2` reads the files. A collection that was made of other files
explains numbers that do not agree. They are read as plain data: nothing in them is executed (`files.plain_pickle`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.datasets.openlane_frames import info_path
from tflane_jax.errors import UserError
from tflane_jax.files.fields import load_json, member, numbers
from tflane_jax.files.openlane import CENTERLINE, SEGMENT, FrameKey
from tflane_jax.files.plain_pickle import load_plain_pickle
from tflane_jax.files.wording import shown

# Frames whose pose is compared, evenly spread; bytes beyond which a pickle is not read.
_COMPARED, _LARGEST = 20, 8 * 2**30


def check_collections(root: Path, on_disk: Sequence[FrameKey]) -> tuple[list[str], list[str]]:
    """Return the faults of the collections in a folder, and what was skipped."""
    faults, skipped, there = [], [], set(on_disk)
    for path in sorted(root.glob("*.pkl")):
        if path.stat().st_size > _LARGEST:
            skipped.append(f"{path} has more than {_LARGEST // 2**30} GiB")
            continue
        try:
            content = load_plain_pickle(path)
            if not isinstance(content, Mapping):
                raise UserError(f"{path} is of type {type(content).__name__}, expected a mapping from frames")
            faults += _check(root, path, content, there)
        except UserError as error:
            faults.append(str(error))
    return faults, skipped


def _check(root: Path, path: Path, content: Mapping[Any, Any], there: set[FrameKey]) -> Iterator[str]:
    suffix = SEGMENT.suffix if "_ls" in path.stem else CENTERLINE.suffix
    keys = []
    for name in content:
        if not (isinstance(name, tuple) and len(name) == 3 and all(isinstance(part, str) for part in name)):
            raise UserError(f"{path}: {shown(name)} is no frame, expected (split, segment, timestamp)")
        keys.append(FrameKey(*name))
    absent = sorted(set(keys) - there)
    if absent:
        yield f"{path} holds {len(absent)} of {len(keys)} frames that the folder does not have (first {absent[0]})"
    segments = {(key.split, key.segment) for key in keys}
    missing = sorted(key for key in there - set(keys) if (key.split, key.segment) in segments)
    if missing:
        yield f"{path} lacks {len(missing)} frames of its segments (first {missing[0]}): collect it again"
    if not keys:
        yield f"{path} holds no frame"
    both = [key for key in keys if key in there]
    for key in both[:: max(len(both) // _COMPARED, 1)]:
        file = info_path(root, key, suffix)
        if file.is_file() and not np.array_equal(_translation(content[key], f"{path}: {key}"), _pose(file)):
            yield f"{path}: {key} has another pose than {file}: the collection was made of other files"
            return


def _pose(file: Path) -> np.ndarray:
    return _translation(load_json(file), str(file))


def _translation(record: Any, where: str) -> np.ndarray:
    return numbers(member(member(record, "pose", where), "translation", where), (3,), f"{where}: pose.translation")
