"""Clips: successive frames of a scene as one training example."""

from __future__ import annotations

import jax
import numpy as np

from tflane_jax.datasets.streaming import Streamed
from tflane_jax.errors import UserError
from tflane_jax.scene import Example


def as_clips(data: Example | Streamed, length: int) -> Example:
    """Return the examples of a split as clips of `length` successive frames, another axis behind the first.

    Raises UserError where the clips would not lie within scenes, or the data are read while they are used.
    """
    if isinstance(data, Streamed):
        raise UserError("clips are made of data in memory, and these are too many for it: train with fewer scenes")
    frames = len(data.has_previous)
    begins = ~np.asarray(data.has_previous)
    inner = np.arange(frames) % length > 0
    if frames % length or (begins & inner).any():
        raise UserError(
            f"scenes do not split into clips of {length} frames: set data.world.keyframes to a multiple of task.clip"
        )
    return jax.tree.map(lambda leaf: leaf.reshape(frames // length, length, *leaf.shape[1:]), data)
