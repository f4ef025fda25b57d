"""Scene files of nuScenes (`nuscenes_scene_files`) as a dataset of lane graphs with traffic flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from tflane_jax.datasets.base import SPLITS, ExampleConfig, Split
from tflane_jax.datasets.data_source import Choice, DataSource, FolderCheck, split_config
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.log_frames import LogFrames
from tflane_jax.datasets.nuscenes_scene_files import find_scene_files, read_scene_file, scene_file_outline
from tflane_jax.datasets.nuscenes_splits import official_split
from tflane_jax.datasets.overlap import frame_drives
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.scene import Example
from tflane_jax.scene.logs import Log

NUSCENES_SIZES = ExampleConfig(lanes=64, segments=96, areas=32, tracks=160)
"""Capacities of an example; the most in seven scenes were 40 centerlines, 61 segments, 10 areas and 103 road users."""


@dataclass(frozen=True)
class SceneFileConfig:
    """Which scenes, and how their key frames become examples.

    Attributes:
        root: a scene file, or a folder of them.
        scenes: names of the files without .npz; empty takes all.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    root: Path
    scenes: tuple[str, ...] = ()
    example: ExampleConfig = NUSCENES_SIZES
    loading: StreamingConfig = StreamingConfig()


class SceneFileDataset(LogFrames):
    """Key frames of scene files, sorted by file name, then time.

    Maps and boxes are read when an example needs them, see `LogFrames`.

    Raises UserError where there is no file, the poses of one cannot be read, or a named scene is missing. `example`
    raises it for damaged boxes or a damaged map.
    """

    name = "nuscenes-scenes"

    def __init__(self, config: SceneFileConfig):
        self.config = config
        files = {path.stem: path for path in find_scene_files(config.root)}
        if missing := set(config.scenes) - set(files):
            raise UserError(f"{config.root} has no scene {min(missing)}, only {', '.join(files)}")
        chosen = [path for name, path in files.items() if name in (config.scenes or files)]
        super().__init__(list(map(scene_file_outline, chosen)), partial(_read, chosen))

    def example(self, index: int) -> Example:
        """Return one example."""
        return make_example(*self[index], self.config.example)


def _read(files: Sequence[Path], row: int) -> Log:
    return read_scene_file(files[row])


@dataclass(frozen=True)
class SceneFileData:
    """Scene files for training, validation and test.

    Attributes:
        root: folder of the files.
        train, val, test: names of the scenes of each.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    root: Path
    train: tuple[str, ...]
    val: tuple[str, ...]
    test: tuple[str, ...]
    example: ExampleConfig = NUSCENES_SIZES
    loading: StreamingConfig = StreamingConfig()

    def source(self, split: Split) -> SceneFileConfig:
        """Return the dataset of a split."""
        return split_config(SceneFileConfig, self, scenes=getattr(self, split))


def check_scene_files(root: Path) -> FolderCheck:
    """Read every scene file of a folder and count what is in it; raise UserError where there is none."""
    rows, faults = [], []
    for path in find_scene_files(root):
        row = {"scene": path.stem, "key frames": 0, "road users": 0, "lanes": 0, "dividers": 0, "boundaries": 0}
        try:
            log = read_scene_file(path)
        except UserError as error:
            faults.append(str(error))
        else:
            row |= {"key frames": log.tracks.frames, "road users": len(log.tracks.uuid)}
            row |= {"lanes": len(log.map.segments), "dividers": len(log.map.dividers or ())}
            row["boundaries"] = len(log.map.road_boundaries)
        rows.append(row)
    return FolderCheck("nuScenes scene files", rows, faults)


def _choose(choice: Choice) -> SceneFileConfig:
    assert choice.root is not None
    example = replace(choice.configured.example, cameras=None)
    if not choice.split_given:
        return SceneFileConfig(choice.root, example=example)
    splits = {path.stem: official_split(path.stem, mini=False) for path in find_scene_files(choice.root)}
    chosen = tuple(name for name, split in splits.items() if split == choice.split)
    if not chosen:
        there = " or ".join(split for split in SPLITS if split in splits.values())
        remedy = f"{choice.option} {there}" + (", or leave it out to take all" if choice.option == "--split" else "")
        raise UserError(f"{choice.root} has no scene of nuScenes' split {choice.split}: choose {remedy}")
    return SceneFileConfig(choice.root, chosen, example)


SOURCE = DataSource(
    name="nuscenes-scenes",
    data=SceneFileData,
    config=SceneFileConfig,
    example=Example,
    dataset=SceneFileDataset,
    choose=_choose,
    title=lambda config: "nuscenes-scenes",
    drives=lambda config: frame_drives(SceneFileDataset(config)),
    root="a scene file (npz) or a folder of them",
    check=check_scene_files,
    tracks_hz=lambda config: 2.0,
)
