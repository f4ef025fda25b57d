"""How far evaluated examples are from the frames that a model was trained on, where both show real places."""

from __future__ import annotations

import warnings
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.config import RunConfig
from tflane_jax.datasets import sources
from tflane_jax.datasets.base import MissingTracksWarning
from tflane_jax.datasets.overlap import Nearness, nearness
from tflane_jax.errors import UserError


def training_nearness(config: RunConfig, source: Any, root: Path | None = None) -> Nearness | None:
    """Return how far the examples of a source are from the training frames of a configuration.

    None where one of them shows no real place, where the examples are simulated, and where none of them is in a city
    of the training frames.

    Args:
        config: of the run.
        source: of the examples.
        root: folder of the data set whose training split the model learned, in the format of the source; of Argoverse
            2, the folder of the training logs; None: the configuration's.

    Raises UserError if the files of the training split cannot be read, or the source has no splits in a folder.
    """
    train = config.data.source("train") if root is None else _training_split(source, root)
    drives, evaluated = sources.source_of(train).drives, sources.source_of(source)
    if drives is None or evaluated.drives is None or not evaluated.recorded:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingTracksWarning)  # only positions are used
        trained = [drive for drive in drives(train) if len(drive.positions)]
    found = nearness(trained, sources.make_dataset(source)) if trained else None
    return found if found is not None and np.isfinite(found.distances).any() else None


def _training_split(source: Any, root: Path) -> Any:
    """Return the training split of a folder in the format of a source."""
    named = {one.name for one in fields(source)}
    # A source with names of its own logs has none of the training split's.
    if "root" not in named or named & {"logs", "scenes"} or sources.source_of(source).drives is None:
        raise UserError(
            f"{sources.source_name(source)} has no training split in a folder: leave out --training-root, which works "
            "with argoverse2, openlane-v2 and nuscenes"
        )
    # Of a data set with splits, the folder's own; of Argoverse 2, all logs in the folder. The logs that tell the
    # city of OpenLane-V2's frames may be missing.
    changes = {"root": root, "split": "train", "without_tracks": "empty"}
    return replace(source, **{name: value for name, value in changes.items() if name in named})
