"""The built-in world as a dataset: endless, seeded, without a download.

An example is a keyframe of a simulated scene. A scene is named by one integer, and each split owns a range of
integers, so that training, validation and test scenes are disjoint by construction.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Literal

from tflane_jax.datasets.base import ExampleConfig, FrameInfo
from tflane_jax.datasets.examples import make_example
from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv
from tflane_jax.scene import Example
from tflane_jax.scene.logs import Log
from tflane_jax.world.simulate import WorldConfig, simulate

# Scene ids of a split: [first, first + SCENES_PER_SPLIT).
SCENES_PER_SPLIT = 100_000_000
FIRST_SCENE = {"train": 0, "val": SCENES_PER_SPLIT, "test": 2 * SCENES_PER_SPLIT}


@dataclass(frozen=True)
class ProceduralConfig:
    """Which scenes of the built-in world, and how they become examples.

    Attributes:
        split: train owns the scene ids [0, 1e8), val [1e8, 2e8), test [2e8, 3e8).
        scenes: number of scenes; each gives `world.keyframes` examples.
        first: scenes of the split to skip.
        world: roads, traffic, tracker.
        example: what is in an example, and its capacities.
    """

    split: Literal["train", "val", "test"] = "train"
    scenes: int = 1000
    first: int = 0
    world: WorldConfig = field(default_factory=WorldConfig)
    example: ExampleConfig = field(default_factory=ExampleConfig)


class ProceduralDataset:
    """Examples made when they are asked for, in order of scene and time.

    Raises UserError where the scenes do not lie in the split's range of ids, or cameras are asked for and OpenCV, which
    draws their images, is not installed.
    """

    def __init__(self, config: ProceduralConfig):
        if config.scenes < 0 or config.first < 0 or config.first + config.scenes > SCENES_PER_SPLIT:
            raise UserError(
                f"{config.split} has scenes 0 to {SCENES_PER_SPLIT - 1}, not {config.first} to "
                f"{config.first + config.scenes - 1}: change `first` or `scenes`"
            )
        if config.example.cameras is not None:
            opencv()
        self.config = config
        self.name = f"procedural-{config.split}"

    def __len__(self) -> int:
        return self.config.scenes * self.config.world.keyframes

    def example(self, index: int) -> Example:
        """Return one example; the last few scenes stay in memory, so go through a scene's frames in order."""
        log, keyframe = self._frame(index)
        return make_example(log, keyframe, self.config.example)

    def info(self, index: int) -> FrameInfo:
        """Return where one example comes from."""
        log, keyframe = self._frame(index)
        moment = log.keyframes[keyframe]
        return FrameInfo(log.source, log.name, moment.timestamp_ns, moment.global_from_ego)

    def scene_id(self, index: int) -> int:
        """Return the world's scene number of one example; raises IndexError outside the dataset."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} examples, no number {index}")
        return FIRST_SCENE[self.config.split] + self.config.first + index // self.config.world.keyframes

    def _frame(self, index: int) -> tuple[Log, int]:
        return _simulated(self.scene_id(index), self.config.world), index % self.config.world.keyframes


@functools.lru_cache(maxsize=4)
def _simulated(scene_id: int, config: WorldConfig) -> Log:
    return simulate(scene_id, config)
