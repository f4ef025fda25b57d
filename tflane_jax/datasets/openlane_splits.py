"""OpenLane-V2 split files: which frames of which Argoverse 2 logs it holds ."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError

SPLIT_FILE, LOG_FILE = "OpenLane-V2/data_dict_subset_A.json", "subset_A_segment_to_av2_log.json"


@functools.lru_cache(maxsize=4)
def openlane_timestamps(folder: Path) -> dict[str, np.ndarray]:
    """Return the ascending frame timestamps (F,), int64 nanoseconds, of every Argoverse 2 log in subset A, by log id.

    Args:
        folder: holds OpenLane-V2/data_dict_subset_A.json and subset_A_segment_to_av2_log.json (segment to log id).

    Raises UserError where one of the files is missing or damaged.
    """
    frames, logs = (_read_json(Path(folder) / name) for name in (SPLIT_FILE, LOG_FILE))
    return {
        logs[split][segment]: np.sort([int(name.removesuffix(".json")) for name in names])
        for split, segments in frames.items()
        for segment, names in segments.items()
        if segment in logs.get(split, {})
    }


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise UserError(f"{path} is missing: it is one of the OpenLane-V2 split files") from error
    except ValueError as error:
        raise UserError(f"{path} is not valid json ({error}): download it again") from error
