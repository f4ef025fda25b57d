"""The built-in world as a dataset of lane graphs: endless, seeded, without a download.

An example is a keyframe of a simulated scene. A scene is named by one integer; each split owns a range of integers, so
training, validation and test scenes are disjoint by construction.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from tflane_jax.datasets.base import ExampleConfig, FrameInfo, Split, checked_index
from tflane_jax.datasets.cache import CachedDataset, cached
from tflane_jax.datasets.data_source import Choice, DataSource
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.limits import Count, Rules
from tflane_jax.scene import Example
from tflane_jax.scene.logs import Log
from tflane_jax.world.bev.sensor import BevSensorConfig
from tflane_jax.world.cameras.ring import CameraRigConfig
from tflane_jax.world.presets import CITY, HILLS, REAL_LIKE, STREET
from tflane_jax.world.simulate import HISTORY, WorldConfig, simulate

# Scene ids of a split: [first, first + SCENES_PER_SPLIT).
SCENES_PER_SPLIT = 100_000_000
FIRST_SCENE = {"train": 0, "val": SCENES_PER_SPLIT, "test": 2 * SCENES_PER_SPLIT}


@dataclass(frozen=True)
class ProceduralConfig:
    """Which scenes of the built-in world, and how they become examples.

    Attributes:
        split: train owns the scene ids [0, 1e8), val [1e8, 2e8), test [2e8, 3e8).
        scenes: number of scenes; each gives `world.keyframes` examples.
        first: number of scenes to skip at the start of the split's range.
        world: roads, traffic, tracker.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers. It is no part of the repr, because cached examples do not depend on it.
    """

    split: Split = "train"
    scenes: int = 1000
    first: int = 0
    world: WorldConfig = field(default_factory=WorldConfig)
    example: ExampleConfig = field(default_factory=ExampleConfig)
    loading: StreamingConfig = field(default=StreamingConfig(), repr=False)


class SimulatedDataset:
    """Examples of simulated scenes, made on request, in order of scene and time; a subclass simulates a scene.

    Raises UserError for scenes outside the split's range of ids, or for cameras without OpenCV, which draws the images.

    Attributes:
        source: name of the source.
        config: with `split`, `scenes`, `first`, `world` and `example`.
    """

    source: ClassVar[str]

    def __init__(self, config: Any):
        if config.scenes < 0 or config.first < 0 or config.first + config.scenes > SCENES_PER_SPLIT:
            raise UserError(
                f"{config.split} has scenes 0 to {SCENES_PER_SPLIT - 1}, not {config.first} to "
                f"{config.first + config.scenes - 1}: change `first` or `scenes`"
            )
        if config.example.cameras is not None:
            opencv()
        self.config = config
        self.name = f"{self.source}-{config.split}"

    def __len__(self) -> int:
        return self.config.scenes * self.config.world.keyframes

    def example(self, index: int) -> Example:
        """Return one example. The last few scenes stay in memory, so reading a scene's frames in order is fast."""
        log, keyframe = self._frame(index)
        return make_example(log, keyframe, self.config.example)

    def info(self, index: int) -> FrameInfo:
        """Return where one example comes from."""
        log, keyframe = self._frame(index)
        moment = log.keyframes[keyframe]
        return FrameInfo(self.source, log.name, moment.timestamp_ns, moment.global_from_ego)

    def drives(self) -> Iterator[Log]:
        """Yield the simulated logs of all scenes."""
        for scene in range(self.config.scenes):
            yield self._frame(scene * self.config.world.keyframes)[0]

    def scene_id(self, index: int) -> int:
        """Return the world's scene number of one example; raises IndexError outside the dataset."""
        checked_index(index, len(self), self.name)
        return FIRST_SCENE[self.config.split] + self.config.first + index // self.config.world.keyframes

    def simulated(self, scene_id: int) -> Log:
        """Return the log of a scene."""
        raise NotImplementedError

    def history(self, world: WorldConfig) -> int:
        """Return how many frames before a key frame a scene needs."""
        example = self.config.example
        if example.history_hz is None:
            return max(HISTORY, example.history)
        return example.history * example.history_stride(world.rate_hz)

    def _frame(self, index: int) -> tuple[Log, int]:
        return self.simulated(self.scene_id(index)), index % self.config.world.keyframes


class ProceduralDataset(SimulatedDataset):
    """The built-in world."""

    source = "procedural"

    def simulated(self, scene_id: int) -> Log:
        """Return the log of a scene."""
        return _simulated(scene_id, self.config.world, self.history(self.config.world))


@functools.lru_cache(maxsize=4)
def _simulated(scene_id: int, config: WorldConfig, history: int) -> Log:
    return simulate(scene_id, config, history)


def scene_limits(world: WorldConfig, example: ExampleConfig, name: str) -> Rules:
    """Yield the limits of key frames, histories and markers in scenes of the built-in world.

    Args:
        world: of the scenes.
        example: what examples hold of them.
        name: of `world` in the data, with a dot behind.
    """
    ratio = 1.0 if example.history_hz is None else world.rate_hz / example.history_hz
    stride = max(round(ratio), 1)
    divides = abs(ratio - stride) <= 0.05 * stride
    yield "example.history_hz", divides, f"{world.rate_hz:g} Hz ({name}rate_hz) divided by a whole number, or None"
    history = max(HISTORY, example.history) if example.history_hz is None else example.history * stride
    most = max(world.frames - history, 0)
    allowed = f"at most {most}: scenes of {world.duration_s:g} s ({name}duration_s) have {world.frames} frames, "
    allowed += f"{history} of them before the first key frame (example.history, example.history_hz)"
    yield f"{name}keyframes", world.keyframes <= most, allowed
    level = world.terrain is None or example.markers is None
    yield f"{name}terrain", level, "None, or example.markers None: markers are simulated on level ground only"


@dataclass(frozen=True)
class WorldData:
    """The built-in world for training, validation and test.

    Attributes:
        train, val, test: number of scenes of each split.
        world: roads, traffic, tracker.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    train: Count = 2000
    val: Count = 100
    test: Count = 200
    world: WorldConfig = WorldConfig()
    example: ExampleConfig = ExampleConfig()
    loading: StreamingConfig = StreamingConfig()

    def limits(self) -> Rules:
        """Scenes are long enough for their key frames; markers stand on level ground."""
        yield from scene_limits(self.world, self.example, "world.")

    def source(self, split: Split) -> ProceduralConfig:
        """Return the dataset of a split."""
        scenes = getattr(self, split)
        return ProceduralConfig(split, scenes, world=self.world, example=self.example, loading=self.loading)

    @classmethod
    def city(cls, train: int = 3000, val: int = 25, test: int = 300) -> WorldData:
        """Return the preset `city`: every kind of junction, perceived within +-50 m x +-25 m."""
        return cls(train, val, test, CITY, CITY_EXAMPLE)

    @classmethod
    def street(cls, train: int = 3000, val: int = 25, test: int = 300) -> WorldData:
        """Return the preset `street`: simple roads, perceived within +-30 m x +-15 m.

        The host must perceive the same box: `task.model.range` equal to `STREET_EXAMPLE.range`, and
        `task.model.encoder.range` equal to `STREET_EXAMPLE.ground`.
        """
        return cls(train, val, test, STREET, STREET_EXAMPLE)

    @classmethod
    def hills(cls, train: int = 3000, val: int = 25, test: int = 300) -> WorldData:
        """Return the preset `hills`: `city` on hilly ground, with heights in tracks, lanes and images.

        The host must perceive the same box, whose heights reach farther: `task.model.range` equal to
        `HILLS_EXAMPLE.range`.
        """
        return cls(train, val, test, HILLS, HILLS_EXAMPLE)

    @classmethod
    def real_like(cls, train: int = 3000, val: int = 25, test: int = 300) -> WorldData:
        """Return the preset `real-like`: as many lanes, connectors and road users in a frame as in recorded logs.

        The host perceives the box of `city`; examples have room for more of everything.
        """
        return cls(train, val, test, REAL_LIKE, REAL_LIKE_EXAMPLE)


CITY_EXAMPLE = ExampleConfig(history_hz=2.0, tracks=192)
"""20 frames at 2 Hz, so 10 s."""
HILLS_EXAMPLE = replace(CITY_EXAMPLE, range=replace(CITY_EXAMPLE.range, z=(-6.0, 6.0)))
"""The same sizes; heights against the vehicle's own, tilted plane."""
REAL_LIKE_EXAMPLE = replace(CITY_EXAMPLE, lanes=64, segments=128, areas=48, tracks=224, elements=32)
"""The range and history of `city`, with room for the most that was in a frame of nine recorded logs."""
STREET_EXAMPLE = replace(
    CITY_EXAMPLE,
    range=PerceptionRange((-30.0, 30.0), (-15.0, 15.0)),
    # Cells of 0.48 m; 64 x 128 can be halved four times and more.
    sensor=BevSensorConfig(grid=BevGrid(PerceptionRange((-30.72, 30.72), (-15.36, 15.36)), rows=64, columns=128)),
)
"""The same history; MapTR's box, and a raster that extends it by half a feature cell, as that of `city` does."""


# Scenes of --data procedural and world-cameras where the configuration has other data.
_SCENES = 100
_PRESET = (_SCENES, _SCENES, _SCENES)


def _choose(choice: Choice) -> ProceduralConfig:
    if isinstance(choice.configured, ProceduralConfig):
        return choice.configured
    return ProceduralConfig(choice.split, scenes=_SCENES, example=choice.configured.example)


def _choose_cameras(choice: Choice) -> ProceduralConfig:
    example: ExampleConfig = choice.configured.example
    cameras = example.cameras or CameraRigConfig(scale=0.3)
    return ProceduralConfig(choice.split, scenes=_SCENES, example=replace(example, cameras=cameras))


# What a preset decides of an example; a host's points, priors, cameras and forms of the truth stay as configured.
_OF_PRESET = ("range", "lanes", "segments", "areas", "tracks", "elements", "history", "history_hz")


def _chooser(preset: Callable[[int, int, int], WorldData]) -> Callable[[Choice], ProceduralConfig]:
    def choose(choice: Choice) -> ProceduralConfig:
        source, given = preset(*_PRESET).source(choice.split), choice.configured.example
        own = {name: getattr(source.example, name) for name in _OF_PRESET}
        sensor = None if given.sensor is None else source.example.sensor
        return replace(source, example=replace(given, sensor=sensor, **own))

    return choose


def _interval(config: ProceduralConfig) -> float | None:
    """Return the mean distance of the key frames of a scene, seconds."""
    world = config.world
    if world.keyframes < 2:
        return None
    driven = world.frames - 1 - ProceduralDataset(config).history(world)
    return driven / (world.keyframes - 1) / world.rate_hz


def _open(config: ProceduralConfig, progress: bool) -> CachedDataset:
    return cached(ProceduralDataset(config), progress=progress)


SOURCE = DataSource(
    name="procedural",
    data=WorldData,
    config=ProceduralConfig,
    example=Example,
    dataset=ProceduralDataset,
    choose=_choose,
    title=lambda config: f"procedural-{config.split}",
    open=_open,
    # Not from the cache: one example is made sooner than all of them.
    sample=lambda config: ProceduralDataset(config).example(0),
    build=lambda config, progress: len(_open(config, progress)),
    interval=_interval,
    tracks_hz=lambda config: config.world.rate_hz,
)
CAMERAS = replace(SOURCE, name="world-cameras", choose=_choose_cameras)
"""The same world with a ring of cameras, under a name of its own for `tflane data show`."""
CITY_SOURCE = replace(SOURCE, name="city", choose=_chooser(WorldData.city))
HILLS_SOURCE = replace(SOURCE, name="hills", choose=_chooser(WorldData.hills))
REAL_LIKE_SOURCE = replace(SOURCE, name="real-like", choose=_chooser(WorldData.real_like))
STREET_SOURCE = replace(SOURCE, name="street", choose=_chooser(WorldData.street))
