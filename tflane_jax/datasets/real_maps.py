"""Recorded maps under the built-in world: one log gives any number of different frames.

The ego vehicle and traffic are simulated on the maps of logs; evidence, cameras, markers, SD maps and tracks are those
of the built-in world. A fraction of the scenes can have generated roads instead.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from tflane_jax.datasets.base import ExampleConfig, Split
from tflane_jax.datasets.cache import CachedDataset, cached
from tflane_jax.datasets.data_source import Choice, DataSource, FolderCheck
from tflane_jax.datasets.overlap import DrivenPath
from tflane_jax.datasets.procedural import SimulatedDataset, scene_limits
from tflane_jax.datasets.recorded_logs import RECORDED_EXAMPLE, RecordedConfig
from tflane_jax.datasets.road_maps import MapFile, chosen_maps, content_of, find_maps
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.limits import Count, Fraction, Rules
from tflane_jax.scene import Example
from tflane_jax.scene.logs import Log
from tflane_jax.world.presets import CITY, REAL_MAPS
from tflane_jax.world.roads.map_networks import prepare_roads
from tflane_jax.world.roads.road_map import RoadMap, driving_side
from tflane_jax.world.simulate import Place, WorldConfig, simulate

# Stream of a scene's number that decides between maps and generated roads.
_ROOT = 20_261_122


@dataclass(frozen=True)
class RealMapConfig:
    """Which maps, which scenes on them, and how they become examples.

    Attributes:
        maps: folder of logs, see `road_maps.find_maps`, or one log.
        logs: names of the logs to take; empty takes all.
        without: names of logs to leave out.
        split: owns scene numbers as in `ProceduralConfig`.
        scenes: number of scenes; each gives `world.keyframes` examples.
        first: number of scenes to skip.
        generated: fraction of the scenes on generated roads.
        world: traffic, tracker and key frames of the scenes on maps.
        generated_world: all of the scenes on generated roads.
        example: what is in an example, and its capacities.
        content: hashes of the maps' files, filled in when they are opened: examples of other files are others.
        loading: as of `ProceduralConfig`.
    """

    maps: Path
    logs: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    split: Split = "train"
    scenes: int = 1000
    first: int = 0
    generated: float = 0.0
    world: WorldConfig = REAL_MAPS
    generated_world: WorldConfig = CITY
    example: ExampleConfig = field(default_factory=lambda: RECORDED_EXAMPLE)
    content: tuple[str, ...] = ()
    loading: StreamingConfig = field(default=StreamingConfig(), repr=False)


class RealMapDataset(SimulatedDataset):
    """Scenes on recorded maps, named after their log and number.

    Raises UserError like `SimulatedDataset`, and where there is no map, a named one is missing or all are left out.
    """

    source = "real-maps"

    def __init__(self, config: RealMapConfig):
        if not 0.0 <= config.generated <= 1.0:
            raise UserError(f"generated is a fraction of the scenes between 0 and 1, not {config.generated}")
        if config.world.keyframes != config.generated_world.keyframes:
            raise UserError(
                f"world has {config.world.keyframes} key frames, generated_world {config.generated_world.keyframes}: "
                "give both the same number"
            )
        super().__init__(config)
        self.maps = tuple(chosen_maps(config.maps, config.logs, config.without))
        self._content = {one: one.content() for one in self.maps}
        self.config = replace(config, content=tuple(self._content.values()))

    def place(self, scene_id: int) -> MapFile | None:
        """Return the map of a scene; None for generated roads."""
        rng = np.random.default_rng([_ROOT, scene_id])
        fraction, number = rng.random(), int(rng.integers(len(self.maps)))
        return None if fraction < self.config.generated else self.maps[number]

    def simulated(self, scene_id: int) -> Log:
        """Return the log of a scene."""
        place = self.place(scene_id)
        world = self.config.generated_world if place is None else self.config.world
        content = "" if place is None else self._content[place]
        return _simulated(scene_id, world, self.history(world), place, content, sees(self.config.example))


def sees(example: ExampleConfig) -> float:
    """Return the distance up to which an example must be complete, metres: to the farthest corner of its range."""
    return math.hypot(*(max(abs(low), abs(high)) for low, high in (example.range.x, example.range.y)))


@functools.lru_cache(maxsize=64)
def _read(place: MapFile, content: str) -> RoadMap:
    """Return the map; `content` is that of its files, so that an edited map is read again."""
    return place.read()


@functools.lru_cache(maxsize=4)
def _simulated(
    scene_id: int, world: WorldConfig, history: int, place: MapFile | None, content: str, metres: float
) -> Log:
    return simulate(scene_id, world, history, None if place is None else Place(_read(place, content), metres))


@dataclass(frozen=True)
class RealMapData:
    """Recorded maps under the built-in world for training, validation and test.

    Logs that neither `val_logs` nor `test_logs` names are training maps. A split without names of its own is simulated
    on the training maps, from other scene numbers: its scores then say nothing about other places.

    Attributes:
        maps: folder of logs: Argoverse 2, nuScenes, OpenLane-V2, or lanes as GeoJSON.
        train, val, test: number of scenes of each split.
        val_logs, test_logs: names of the logs of these splits.
        without: names of logs that no split takes, unless `val_logs` or `test_logs` names them.
        test_on: whether the test split is simulated on maps, or is what was recorded: the logs' own key frames and
            tracks, see `recorded_logs`.
        test_traffic: name of a log whose recorded tracks replace those of the test split's logs, a control: plausible
            traffic in the wrong place; "" for their own.
        generated: fraction of the training scenes on generated roads.
        world: traffic, tracker and key frames of the scenes on maps.
        generated_world: all of the scenes on generated roads.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    maps: Path = Path("data/maps")
    train: Count = 2000
    val: Count = 25
    test: Count = 100
    val_logs: tuple[str, ...] = ()
    test_logs: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    test_on: Literal["maps", "recordings"] = "maps"
    test_traffic: str = ""
    generated: Fraction = 0.0
    world: WorldConfig = REAL_MAPS
    generated_world: WorldConfig = CITY
    example: ExampleConfig = RECORDED_EXAMPLE
    loading: StreamingConfig = StreamingConfig()

    def limits(self) -> Rules:
        """Scenes are long enough for their key frames; traffic of another log needs recordings."""
        of_recordings = not self.test_traffic or self.test_on == "recordings"
        yield "test_traffic", of_recordings, "'' where test_on is not recordings: on maps, traffic is simulated"
        yield from scene_limits(self.world, self.example, "world.")
        if self.generated > 0.0:
            yield from scene_limits(self.generated_world, self.example, "generated_world.")

    def source(self, split: Split) -> RealMapConfig | RecordedConfig:
        """Return the dataset of a split."""
        if split == "test" and self.test_on == "recordings":
            without = () if self.test_logs else tuple(sorted({*self.val_logs, *self.without}))
            logs, traffic = self.test_logs, self.test_traffic
            return RecordedConfig(self.maps, logs, without, traffic, self.example, self.loading)
        logs = {"train": (), "val": self.val_logs, "test": self.test_logs}[split]
        return RealMapConfig(
            self.maps,
            logs=logs,
            without=() if logs else tuple(sorted({*self.val_logs, *self.test_logs, *self.without})),
            split=split,
            scenes=getattr(self, split),
            generated=self.generated if split == "train" else 0.0,
            world=self.world,
            generated_world=self.generated_world,
            example=self.example,
            loading=self.loading,
        )


def _drives(config: RealMapConfig) -> list[DrivenPath]:
    """Return the drives of the logs on whose maps the scenes are; nothing if all roads are generated.

    GeoJSON maps have coordinates of their own, which no recording shares.
    """
    found = chosen_maps(config.maps, config.logs, config.without) if config.generated < 1.0 else []
    maps = [_read(one, one.content()) for one in found]
    return [DrivenPath(one.name, one.area, one.places) for one in maps if one.source != "geojson"]


# Scenes of --data real-maps where the configuration has other data.
_SCENES = 100


def _choose(choice: Choice) -> RealMapConfig:
    assert choice.root is not None
    if isinstance(choice.configured, RealMapConfig):
        return replace(choice.configured, maps=choice.root)
    # Recordings of a split (`RealMapData.test_on`) name its logs, too.
    logs, without = getattr(choice.configured, "logs", ()), getattr(choice.configured, "without", ())
    example = choice.configured.example
    return RealMapConfig(choice.root, logs, without, split=choice.split, scenes=_SCENES, example=example)


def _open(config: RealMapConfig, progress: bool) -> CachedDataset:
    return cached(RealMapDataset(config), progress=progress)


def check_real_maps(root: Path) -> FolderCheck:
    """Read every map below a folder and count what the world finds on it; raise UserError where there is none."""
    rows, faults = [], []
    for one in find_maps(root):
        row: dict[str, str | int | float] = {"map": one.name, "format": one.kind}
        try:
            road_map = one.read()
            roads = prepare_roads(road_map, REAL_MAPS.roads.sidewalk)
        except UserError as error:
            faults.append(str(error))
        else:
            row |= {
                "km of lane": sum(roads.length.values()) / 1e3,
                "intersections": sum(len(junction.minor) > 2 for junction in roads.junctions),
                "crossings": len(roads.crossings),
                "parking places": len(roads.parking),
                "traffic keeps": driving_side(road_map.map) or "right, assumed",
                "complete m": road_map.complete,
                "places for examples, m of lane": 3 * len(roads.spots(sees(RECORDED_EXAMPLE))),
            }
        rows.append(row)
    return FolderCheck("recorded maps", rows, faults)


SOURCE = DataSource(
    name="real-maps",
    data=RealMapData,
    config=RealMapConfig,
    example=Example,
    dataset=RealMapDataset,
    choose=_choose,
    title=lambda config: f"real-maps-{config.split}",
    root="a log, or a folder of logs, whose maps the world drives on",
    open=_open,
    # Not from the cache: one example is made sooner than all of them.
    sample=lambda config: RealMapDataset(config).example(0),
    build=lambda config, progress: len(_open(config, progress)),
    drives=_drives,
    recorded=False,
    check=check_real_maps,
    tracks_hz=lambda config: config.world.rate_hz,
    content=lambda config: content_of(chosen_maps(config.maps, config.logs, config.without)),
)
