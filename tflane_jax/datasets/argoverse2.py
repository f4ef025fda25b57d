"""Argoverse 2 sensor logs as a dataset of lane graphs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, Keyframes, check_log, find_logs, load_log
from tflane_jax.datasets.base import SPLITS, ExampleConfig, FrameInfo, Split
from tflane_jax.datasets.data_source import Choice, DataSource, FolderCheck
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.overlap import frame_drives
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.scene import Example
from tflane_jax.scene.logs import Log


@dataclass(frozen=True)
class Argoverse2Config:
    """Which logs, which of their frames, and how they become examples.

    Attributes:
        root: a dataset root (sensor/<split>/<log id>/), a split, a folder of logs, or one log; all logs below it.
        keyframes, openlane: see `load_log`.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    root: Path
    keyframes: Keyframes = "openlane_v2"
    openlane: Path | None = None
    example: ExampleConfig = field(default_factory=ExampleConfig)
    loading: StreamingConfig = StreamingConfig()


class Argoverse2Dataset:
    """Examples of every log below a folder, sorted by log id, then time.

    Raises UserError where there is no log or one cannot be read.
    """

    name = "argoverse2"

    def __init__(self, config: Argoverse2Config):
        self.config = config
        self.logs = tuple(
            load_log(folder, keyframes=config.keyframes, openlane=config.openlane) for folder in find_logs(config.root)
        )
        self._frames = [(log, i) for log in self.logs for i in range(len(log.keyframes))]

    def __len__(self) -> int:
        return len(self._frames)

    def example(self, index: int) -> Example:
        """Return one example."""
        log, keyframe = self._frames[index]
        return make_example(log, keyframe, self.config.example)

    def info(self, index: int) -> FrameInfo:
        """Return log id, time and pose of one example."""
        log, number = self._frames[index]
        keyframe = log.keyframes[number]
        return FrameInfo(log.source, log.name, keyframe.timestamp_ns, keyframe.global_from_ego, log.area)

    def drives(self) -> Iterator[Log]:
        """Yield the logs."""
        yield from self.logs


@dataclass(frozen=True)
class LogData:
    """Argoverse 2 logs for training, validation and test.

    Attributes:
        train, val, test: a log or a folder of logs for each split.
        keyframes: which frames become examples, see `load_log`.
        openlane: folder of the OpenLane-V2 split files, which hold the exact timestamps.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    train: Path
    val: Path
    test: Path
    keyframes: Keyframes = "openlane_v2"
    openlane: Path | None = None
    example: ExampleConfig = ExampleConfig()
    loading: StreamingConfig = StreamingConfig()

    def source(self, split: Split) -> Argoverse2Config:
        """Return the dataset of a split."""
        return Argoverse2Config(getattr(self, split), self.keyframes, self.openlane, self.example, self.loading)


def split_folder(root: Path, split: Split, *, required: bool) -> Path:
    """Return the folder of a split below `root`; `root` itself where it is not divided into splits.

    Args:
        root: a dataset root (sensor/<split>/<log id>/), a folder of splits, a folder of logs, or one log.
        split: train, val or test.
        required: whether a folder without splits is an error, unless its own name is that of the split.

    Raises UserError where `root` has splits but not this one, or none and one is required.
    """
    places = [root / "sensor", root]
    present = [place / name for place in places for name in SPLITS if (place / name).is_dir()]
    for folder in present:
        if folder.name == split:
            return folder
    if present:
        names = ", ".join(folder.name for folder in present)
        raise UserError(f"{root} has no split {split}, only {names}: choose one with --split")
    if required and root.is_dir() and root.name != split:
        raise UserError(
            f"{root} is not divided into splits, so --split {split} cannot choose among its logs: leave --split out to "
            f"take all of them, or name a folder that holds {split}/<log id>/{ANNOTATIONS}"
        )
    return root


def _choose(choice: Choice) -> Argoverse2Config:
    assert choice.root is not None
    root = split_folder(choice.root, choice.split, required=choice.split_given)
    return Argoverse2Config(root, openlane=choice.openlane, example=choice.configured.example)


def _title(config: Argoverse2Config) -> str:
    name = Path(config.root).name
    return f"argoverse2-{name}" if name in SPLITS else "argoverse2"


def check_argoverse2(root: Path) -> FolderCheck:
    """Read every log below a folder and count what is in it; raise UserError where there is none."""
    rows, faults = [], []
    for folder in find_logs(root):
        found = check_log(folder)
        faults += found
        row = {"log": folder.name, "key frames": 0, "annotated frames": 0, "road users": 0, "lane segments": 0}
        if not found:
            log = load_log(folder)
            row |= {"key frames": len(log.keyframes), "annotated frames": log.tracks.frames}
            row |= {"road users": len(log.tracks.uuid), "lane segments": len(log.map.segments)}
        rows.append(row | {"faults": len(found)})
    return FolderCheck("Argoverse 2", rows, faults)


SOURCE = DataSource(
    name="argoverse2",
    data=LogData,
    config=Argoverse2Config,
    example=Example,
    dataset=Argoverse2Dataset,
    choose=_choose,
    title=_title,
    drives=lambda config: frame_drives(Argoverse2Dataset(config)),
    root="a log or a folder of logs",
    check=check_argoverse2,
)
