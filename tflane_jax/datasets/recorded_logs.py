"""Recorded logs of every known format in one folder, as a dataset of lane graphs with their own tracks.

It reads what `road_maps` finds, so that a model that learned on the maps of some logs is tested on the recordings of
others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from tflane_jax.datasets.base import ExampleConfig, Split
from tflane_jax.datasets.data_source import Choice, DataSource
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.log_frames import LogFrames
from tflane_jax.datasets.overlap import frame_drives
from tflane_jax.datasets.procedural import REAL_LIKE_EXAMPLE
from tflane_jax.datasets.road_maps import MapFile, chosen_maps, content_of
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.scene import Example
from tflane_jax.scene.logs import Log

RECORDED_EXAMPLE = REAL_LIKE_EXAMPLE
"""The range and history of the preset `city`, with room for the most that was in a frame of nine logs."""


@dataclass(frozen=True)
class RecordedConfig:
    """Which logs, and how their key frames become examples.

    Attributes:
        root: folder of logs, see `road_maps.find_maps`, or one log.
        logs: their names; empty takes all.
        without: names of logs to leave out.
        traffic: name of a log of the folder whose traffic flow replaces that of every log; "" for their own.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    root: Path
    logs: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    traffic: str = ""
    example: ExampleConfig = field(default_factory=lambda: RECORDED_EXAMPLE)
    loading: StreamingConfig = StreamingConfig()


class RecordedDataset(LogFrames):
    """Key frames of recorded logs, sorted by log, then time.

    Maps and boxes are read when an example needs them, see `LogFrames`.

    Raises UserError where there is no log, a named one is missing, or the times and poses of one cannot be read.
    `example` raises it for damaged boxes or a damaged map.
    """

    name = "recorded"

    def __init__(self, config: RecordedConfig):
        self.config = config
        found = chosen_maps(config.root, config.logs, config.without)
        logs = [one for one in found if one.recorded or config.logs]
        super().__init__([one.outline() for one in logs], partial(_read, logs))
        self._giver = chosen_maps(config.root, (config.traffic,))[0].log() if config.traffic else None

    def example(self, index: int) -> Example:
        """Return one example. Traffic of another log is that of its frame of the same number, from 0 again after it."""
        log, number = self[index]
        example = make_example(log, number, self.config.example)
        if self._giver is None:
            return example
        other = make_example(self._giver, number % len(self._giver.keyframes), self.config.example)
        return replace(example, traffic_flow=other.traffic_flow)

    def drives(self) -> Iterator[Log]:
        """Yield the logs."""
        return self.logs()


def _read(logs: Sequence[MapFile], row: int) -> Log:
    return logs[row].log()


@dataclass(frozen=True)
class RecordedData:
    """Recorded logs for training, validation and test.

    Attributes:
        root: folder of logs.
        val, test: names of the logs of these splits; all others are training logs. A split without names has the
            training logs.
        example: what is in an example, and its capacities.
        loading: memory or disk, and workers.
    """

    root: Path = Path("data/maps")
    val: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    example: ExampleConfig = RECORDED_EXAMPLE
    loading: StreamingConfig = StreamingConfig()

    def source(self, split: Split) -> RecordedConfig:
        """Return the dataset of a split."""
        logs = {"train": (), "val": self.val, "test": self.test}[split]
        without = () if logs else tuple(sorted({*self.val, *self.test}))
        return RecordedConfig(self.root, logs, without, example=self.example, loading=self.loading)


def _choose(choice: Choice) -> RecordedConfig:
    """Return the logs of the root: those of the split where the run's own data name them, else all.

    Raises UserError where a split was asked for and nothing tells its logs.
    """
    assert choice.root is not None
    configured = choice.configured
    if isinstance(configured, RecordedConfig):
        return replace(configured, root=choice.root)
    example = replace(configured.example, cameras=None)
    # `--splits` is for exports: they refuse data without images, and say so.
    if choice.option == "--splits" or choice.root.name == choice.split:
        return RecordedConfig(choice.root, example=example)
    # Simulated scenes on maps (`RealMapConfig`) name the logs of a split too; training has all that others do not.
    logs, without = getattr(configured, "logs", ()), getattr(configured, "without", ())
    if choice.split_given and not (logs or (choice.split == "train" and without)):
        raise UserError(
            f"nothing tells which recorded logs of {choice.root} are the split {choice.split}: leave --split out to "
            "take all of them, or name a folder that holds only the logs to take with --root"
        )
    return RecordedConfig(choice.root, logs, without, example=example)


def _content(config: RecordedConfig) -> str:
    giver = chosen_maps(config.root, (config.traffic,)) if config.traffic else []
    return content_of([*chosen_maps(config.root, config.logs, config.without), *giver])


SOURCE = DataSource(
    name="recorded",
    data=RecordedData,
    config=RecordedConfig,
    example=Example,
    dataset=RecordedDataset,
    choose=_choose,
    title=lambda config: "-".join(("recorded", *config.logs[:1])),
    drives=lambda config: frame_drives(RecordedDataset(config)),
    root="a folder of logs of any known format",
    content=_content,
)
