"""Clips: successive frames of a scene as one training example, in memory or read from disk."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import Protocol, runtime_checkable

import jax
import numpy as np

from tflane_jax.datasets.base import FrameInfo
from tflane_jax.datasets.streaming import Streamed
from tflane_jax.errors import UserError
from tflane_jax.scene import Example, stack_examples


@runtime_checkable
class KnownScenes(Protocol):
    """A dataset that tells an example's scene without reading a file."""

    def scene(self, index: int) -> str:
        """Return the scene of one example."""
        ...


@dataclass
class ClipDataset:
    """Clips of the frames of a dataset on disk.

    Attributes:
        name: of the frames' dataset.
        frames: the data.
        starts: first frame of each clip.
        length: frames of a clip.
    """

    name: str
    frames: Streamed
    starts: tuple[int, ...]
    length: int

    def __len__(self) -> int:
        return len(self.starts)

    def example(self, index: int) -> Example:
        """Return the frames of a clip, stacked."""
        start = self.starts[index]
        return stack_examples([self.frames.example(frame) for frame in range(start, start + self.length)])

    def info(self, index: int) -> FrameInfo:
        """Return where the first frame of a clip comes from."""
        return self.frames.dataset.info(self.starts[index])


def as_clips(data: Example | Streamed, length: int) -> Example | Streamed:
    """Return the examples of a split as clips of `length` successive frames, another axis behind the first.

    Of data on disk, the last frames of a scene that fill no clip are left out. Scene boundaries come from
    `KnownScenes`, or else from every frame's `info`.

    Raises UserError where clips of data in memory would not lie within scenes, or no scene on disk is long enough.
    """
    if isinstance(data, Streamed):
        return _streamed_clips(data, length)
    frames = len(data.has_previous)
    begins = ~np.asarray(data.has_previous)
    inner = np.arange(frames) % length > 0
    if frames % length or (begins & inner).any():
        raise UserError(
            f"scenes do not split into clips of {length} frames: set data.world.keyframes to a multiple of task.clip, "
            "or data.loading.where=disk, which leaves out the last frames of a scene that fill no clip"
        )
    return jax.tree.map(lambda leaf: leaf.reshape(frames // length, length, *leaf.shape[1:]), data)


def _streamed_clips(data: Streamed, length: int) -> Streamed:
    dataset = data.dataset
    scene_of = dataset.scene if isinstance(dataset, KnownScenes) else lambda index: dataset.info(index).scene
    starts: list[int] = []
    first = 0
    for _, scene in groupby(range(len(data)), scene_of):
        count = len(list(scene))
        starts += [first + length * clip for clip in range(count // length)]
        first += count
    if not starts:
        raise UserError(f"no scene of {dataset.name} has {length} frames: set task.clip to fewer")
    return Streamed(ClipDataset(dataset.name, data, tuple(starts), length), data.config)
