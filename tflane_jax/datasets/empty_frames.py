"""Training without the frames in which there is nothing to find."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from tflane_jax.datasets.streaming import Streamed
from tflane_jax.errors import UserError
from tflane_jax.scene import AreaType, Example


def has_truth(example: Example, truth: Collection[str], line_classes: int | None = None) -> Bool[np.ndarray, "*b"]:
    """Return whether an example, or each one of a batch, has any valid lane, segment, line or crossing.

    Args:
        example: arrays may have leading axes.
        truth: the fields of `Example` that count: "lanes", "segments", "areas" (crossings alone), "map_lines".
        line_classes: number of classes of map lines that count, the first ones of `LineClass`; None for all.
    """
    found = np.zeros(np.shape(example.has_previous), bool)
    for name in set(truth) & {"lanes", "segments", "areas", "map_lines"}:
        part: Any = getattr(example, name)
        if part is not None:
            valid = np.asarray(part.valid)
            if name == "areas":
                valid = valid & (np.asarray(part.category) == AreaType.PEDESTRIAN_CROSSING)
            if name == "map_lines" and line_classes is not None:
                valid = valid & (np.asarray(part.category) < line_classes)
            found |= valid.any(-1)
    return found


def without_empty(
    data: Example | Streamed, truth: Collection[str], line_classes: int | None = None
) -> Example | Streamed:
    """Return the training examples that have any truth; a clip needs one frame that has.

    Examples in memory are selected once. A `Streamed` knows what is in an example only when it has read it, and draws
    another one in place of an empty one, as LaneSegNet does; the result depends on seed and step alone.

    Args:
        data: examples or clips.
        truth, line_classes: see `has_truth`.

    Raises:
        UserError: no example in memory has any.
    """
    if isinstance(data, Streamed):
        return replace(data, wanted=partial(_any_truth, truth=tuple(truth), line_classes=line_classes))
    found = has_truth(data, truth, line_classes)
    found = found.reshape(len(found), -1).any(1)
    if not found.any():
        raise UserError("no training example has any lanes: set task.empty_frames=keep")
    return data if found.all() else jax.tree.map(lambda leaf: leaf[found], data)


def _any_truth(example: Example, truth: tuple[str, ...], line_classes: int | None) -> bool:
    return bool(has_truth(example, truth, line_classes).any())
