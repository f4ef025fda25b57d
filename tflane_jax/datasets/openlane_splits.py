"""OpenLane-V2 split files: which frames of which Argoverse 2 logs it holds."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.fields import as_list, is_time, load_json, member
from tflane_jax.files.wording import shown

SPLIT_FILE, LOG_FILE = "data_dict_subset_A.json", "subset_A_segment_to_av2_log.json"


@functools.lru_cache(maxsize=4)
def openlane_timestamps(folder: Path) -> dict[str, np.ndarray]:
    """Return the ascending frame timestamps (F,), int64 nanoseconds, of every Argoverse 2 log in subset A, by log id.

    Args:
        folder: holds OpenLane-V2/data_dict_subset_A.json, or that file itself, and subset_A_segment_to_av2_log.json:
            the log of each segment, by split. The second is not part of the download.

    Raises UserError where one of the files is missing or damaged.
    """
    below = folder / "OpenLane-V2" / SPLIT_FILE
    files = [below if below.is_file() else folder / SPLIT_FILE, folder / LOG_FILE]
    if not files[0].is_file():
        raise UserError(f"{below} is missing, OpenLane-V2's list of frames; {files[0]} will do too")
    if not files[1].is_file():
        raise UserError(
            f"{files[1]} is missing: the Argoverse 2 log of each segment, {{split: {{segment: log id}}}}, which is not "
            "part of OpenLane-V2's download (docs/argoverse2.md says how segments are numbered)"
        )
    frames, logs = (_by_split(path) for path in files)
    found = {}
    for split, segments in frames.items():
        for segment, names in segments.items():
            if (log := logs.get(split, {}).get(segment)) is None:
                continue
            where = f"{files[0]}: {split}: {segment}"
            if not isinstance(log, str):
                raise UserError(f"{files[1]}: {split}: {segment} is {shown(log)}, expected the id of a log")
            found[log] = np.sort([_time(name, where) for name in as_list(names, where)])
    return found


def _by_split(path: Path) -> Mapping[str, Mapping[str, Any]]:
    """Return a mapping from splits to mappings from segments."""
    content, where = load_json(path), str(path)
    for split in content if isinstance(content, Mapping) else ("train",):
        if not isinstance(segments := member(content, split, where), Mapping):
            raise UserError(f"{where}: {split} is {shown(segments)}, expected a mapping from segments")
    return content


def _time(name: Any, where: str) -> int:
    text = str(name).removesuffix(".json")
    if not is_time(text):
        raise UserError(f"{where}: {shown(name)} is no frame, expected <timestamp>.json")
    return int(text)
