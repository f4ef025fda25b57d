"""A new dataset of made-up examples, all of one size. `test_sources` adds its one entry to the list of sources."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.fakes import fake_example
from tflane_jax.datasets.base import SPLITS, ExampleConfig, FrameInfo, Split
from tflane_jax.datasets.data_source import Choice, DataSource, FolderCheck
from tflane_jax.errors import UserError
from tflane_jax.scene import Example


@dataclass(frozen=True)
class ToyConfig:
    """One split: `<root>/<split>.txt` holds the number of examples."""

    root: Path
    split: Split = "train"
    example: ExampleConfig = ExampleConfig()


class ToyDataset:
    """Fake examples, numbered from 1000 in the test split."""

    def __init__(self, config: ToyConfig):
        file = config.root / f"{config.split}.txt"
        if not file.is_file():
            raise UserError(f"{file} is missing")
        self.config, self.name = config, f"toy-{config.split}"
        self._count = int(file.read_text())

    def __len__(self) -> int:
        return self._count

    def example(self, index: int) -> Example:
        sensor = self.config.example.sensor
        assert sensor is not None
        bev = np.zeros((sensor.grid.rows, sensor.grid.columns, 4), np.uint8)
        return fake_example(index + 1000 * SPLITS.index(self.config.split)).replace(bev=bev, hidden=bev[..., 0] > 0)

    def info(self, index: int) -> FrameInfo:
        return FrameInfo("toy", f"{self.config.split} scene", index, np.eye(4))


@dataclass(frozen=True)
class ToyData:
    """All splits of a folder."""

    root: Path
    example: ExampleConfig = ExampleConfig()

    def source(self, split: Split) -> ToyConfig:
        return ToyConfig(self.root, split, self.example)


def choose(choice: Choice) -> ToyConfig:
    assert choice.root is not None
    return ToyConfig(choice.root, choice.split, choice.configured.example)


def check(root: Path) -> FolderCheck:
    present = [split for split in SPLITS if (root / f"{split}.txt").is_file()]
    rows = [{"split": split, "frames": len(ToyDataset(ToyConfig(root, split)))} for split in present]
    return FolderCheck("Toy", rows, [f"{root} has no {split}.txt" for split in SPLITS if split not in present])


SOURCE = DataSource(
    name="toy",
    data=ToyData,
    config=ToyConfig,
    example=Example,
    dataset=ToyDataset,
    choose=choose,
    title=lambda config: f"toy-{config.split}",
    root="the toy's folder",
    check=check,
)
