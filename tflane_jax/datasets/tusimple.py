"""TuSimple lane detection: label files and clips -> `RoadImage` (specs/data_formats.md section 5).

A label is one x for each of 48 or 56 image rows, -2 where the lane has none. Examples always have the 56 rows of the
test set, 160, 170, ..., 710 of 720; rows that a file does not label are absent.
"""

from __future__ import annotations

import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from tqdm import tqdm

from tflane_jax.datasets.base import FrameInfo, TruncationWarning
from tflane_jax.datasets.photos import HEIGHT, WIDTH
from tflane_jax.errors import UserError
from tflane_jax.files.images import read_image, resize
from tflane_jax.files.tusimple import NO_POINT, RowLanes, read_truth
from tflane_jax.scene import LaneLines, RoadImage

ROWS = np.arange(160.0, 720.0, 10.0)
"""Rows of the points of a line (56), pixels of an image `ROWS_HEIGHT` high."""
ROWS_HEIGHT = 720

Split = Literal["train", "val", "test", "all"]

_TRAIN, _VAL = ("label_data_0313.json", "label_data_0601.json"), ("label_data_0531.json",)
_SPLIT_FILES: dict[Split, tuple[str, ...]] = {
    "train": _TRAIN,
    "val": _VAL,
    "test": ("test_label.json",),
    "all": tuple(sorted(_TRAIN + _VAL)),
}


@dataclass(frozen=True)
class TuSimpleConfig:
    """Which frames, and how they become examples.

    Attributes:
        root: folder with the label files and `clips`.
        split: LSTR's parts of the official training set, train (0313, 0601) and val (0531); test; all is the whole
            training set, and any further `label_data_*.json`. Files that are not there are left out.
        label_files: names under `root` that take the place of the split's; each must be there.
        height, width: of the example's image, pixels.
        capacity: lines in an example; where there are more, those with the fewest points are left out.
    """

    root: str = "data/tusimple/LaneDetection"
    split: Split = "all"
    label_files: tuple[str, ...] = ()
    height: int = HEIGHT
    width: int = WIDTH
    capacity: int = 8


class TuSimpleDataset:
    """Labelled frames in the order of the label files.

    Attributes:
        name: for messages and run records.
        label_files: that were found.
        absent_files: of the split that were not.

    Raises UserError where no label file is found, one is malformed, labels no frame or one that another labels too, or
    images are missing.
    """

    def __init__(self, config: TuSimpleConfig) -> None:
        root = Path(config.root)
        self.config = config
        self.name = f"tusimple-{'custom' if config.label_files else config.split}"
        self.label_files, self.absent_files = _label_files(root, config)
        labels: dict[str, RowLanes] = {}
        for file in self.label_files:
            read = read_truth(file)
            twice = next((name for name in read if name in labels), None)
            if twice is not None:
                raise UserError(f"{file} labels {twice}, which an earlier label file labels too: leave one of them out")
            labels |= read
        self._labels = list(labels.items())
        if not labels:
            raise UserError(f"{', '.join(map(str, self.label_files))}: no labelled frames")
        missing = [name for name in labels if not (root / name).is_file()]
        if missing:
            shown = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
            raise UserError(
                f"{root}: {len(missing)} of {len(labels)} labelled images are missing ({shown}): unpack TuSimple's "
                "clips there, or keep only the records of the images at hand in a label file of your own"
            )

    def __len__(self) -> int:
        return len(self._labels)

    def summary(self) -> str:
        """Return one line for people: frames, label files, and which of the split were not found."""
        found = ", ".join(file.name for file in self.label_files)
        absent = f"; not found: {', '.join(self.absent_files)}" if self.absent_files else ""
        return f"{self.name}: {len(self)} frames of {found}{absent}"

    def example(self, index: int) -> RoadImage:
        """Return one frame; raises UserError where its image cannot be read."""
        name, truth = self._labels[self._checked(index)]
        image = read_image(Path(self.config.root) / name)
        height, width = image.shape[:2]
        image = resize(image, self.config.height, self.config.width)
        lines = lane_lines(truth, height, width, capacity=self.config.capacity)
        return RoadImage(image, np.ones(image.shape[:2], bool), lines)

    def truth(self, index: int) -> RowLanes:
        """Return the labels as the metric reads them: pixels of the original image, absent lanes included."""
        return self._labels[self._checked(index)][1]

    def raw_file(self, index: int) -> str:
        """Return the name that label and prediction files give a frame."""
        return self._labels[self._checked(index)][0]

    def info(self, index: int) -> FrameInfo:
        """Return where one frame comes from; TuSimple gives neither its time nor its pose."""
        return FrameInfo("tusimple", self.raw_file(index), 0, np.eye(4))

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} examples, no number {index}")
        return index


def load_road_images(dataset: TuSimpleDataset, *, progress: bool = True, workers: int | None = None) -> RoadImage:
    """Read a whole dataset into memory, the examples stacked along a new first axis.

    An image of 360 x 640 takes 0.7 MB, the 3,626 of the training set 2.5 GB; `image_valid` is a read-only view of one
    value. `workers` threads decode, by default one for each core.
    """
    count, config = len(dataset), dataset.config
    images = np.empty((count, config.height, config.width, 3), np.uint8)
    workers = min(os.cpu_count() or 1, 8) if workers is None else workers

    def load(index: int) -> LaneLines:
        example = dataset.example(index)
        images[index] = example.image
        return example.lines

    with ThreadPoolExecutor(workers) as pool:
        bar = tqdm(pool.map(load, range(count)), f"loading {dataset.name}", count, unit="image", disable=not progress)
        try:
            lines = list(bar)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    stacked = LaneLines(*(np.stack([getattr(line, name) for line in lines]) for name in LaneLines.__dataclass_fields__))
    return RoadImage(images, np.broadcast_to(True, images.shape[:3]), stacked)


def lane_lines(truth: RowLanes, height: int, width: int, *, capacity: int = 8) -> LaneLines:
    """Return labels as lines with points on `ROWS`, from left to right by each line's first point.

    Labels of other rows, or of images of another height, are interpolated between rows that are next to each other and
    both labelled. Lanes without a point are no lines. Where there are more lines than `capacity`, those with the fewest
    points are left out with a `TruncationWarning`.

    Args:
        truth: x in pixels.
        height, width: of the image, pixels.
        capacity: lines.
    """
    assert truth.rows is not None, "labels have rows"
    x, valid = _at_rows(truth, ROWS * (height / ROWS_HEIGHT))
    kept = np.flatnonzero(valid.any(1))
    if len(kept) > capacity:
        message = f"an image has {len(kept)} lines and room for {capacity}: raise `capacity`"
        warnings.warn(message, TruncationWarning, stacklevel=2)
        kept = kept[np.argsort(-valid[kept].sum(1), kind="stable")[:capacity]]
    first = x[kept, valid[kept].argmax(1)]
    kept = kept[np.argsort(first, kind="stable")]
    lines = LaneLines.empty(capacity, len(ROWS))
    n = len(kept)
    lines.points[..., 1] = ROWS / ROWS_HEIGHT
    lines.points[:n, :, 0] = np.where(valid[kept], x[kept] / width, 0.0)
    lines.point_valid[:n] = valid[kept]
    lines.valid[:n] = True
    return lines


def row_lanes(lines: LaneLines, height: float = ROWS_HEIGHT, width: float = 1280.0) -> RowLanes:
    """Return lines whose point p stands at `ROWS[p]` as the metric reads them, pixels of an image of that size.

    Points left of the image are absent, as the metric understands them. Raises ValueError where a point stands at
    another row (of augmented lines, say).
    """
    points = np.asarray(lines.points, np.float64)[np.asarray(lines.valid)]
    valid = np.asarray(lines.point_valid)[np.asarray(lines.valid)]
    u, v = points[..., 0], points[..., 1]
    if valid.shape[1] != len(ROWS) or (valid & ~(np.abs(v * ROWS_HEIGHT - ROWS) < 0.01)).any():
        raise ValueError("the lines' points do not stand at TuSimple's rows: give lines that were not augmented")
    return RowLanes(np.where(valid & (u >= 0.0), u * width, NO_POINT), ROWS * (height / ROWS_HEIGHT))


def _label_files(root: Path, config: TuSimpleConfig) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Return the files to read, and the names of those that are not there."""
    if not root.is_dir():
        raise UserError(f"there is no folder {root}: set `root` to TuSimple's folder of label files and clips")
    names = config.label_files or _SPLIT_FILES[config.split]
    present = sorted(path.name for path in root.glob("*.json"))
    if config.split == "all" and not config.label_files:
        names = tuple(sorted({*names, *(name for name in present if name.startswith("label_data_"))}))
    found = tuple(root / name for name in names if (root / name).is_file())
    absent = tuple(name for name in names if not (root / name).is_file())
    if not found or (config.label_files and absent):
        raise UserError(
            f"{root} lacks the label file{'s' * (len(absent) != 1)} {', '.join(absent)} of "
            f"{'`label_files`' if config.label_files else f'split {config.split}'} (it has "
            f"{', '.join(present) or 'none'}): download them, or choose another split or `label_files`"
        )
    return found, absent


def _at_rows(
    truth: RowLanes, rows: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "l p"], Bool[np.ndarray, "l p"]]:
    """Return x at other rows, and where there is one."""
    assert truth.rows is not None
    order = np.argsort(truth.rows, kind="stable")
    labelled = np.asarray(truth.rows, np.float64)[order]
    x = np.asarray(truth.x, np.float64)
    if len(labelled) == 0 or len(x) == 0:
        return np.zeros((len(x), len(rows))), np.zeros((len(x), len(rows)), bool)
    x = x[:, order]
    below = np.searchsorted(labelled, rows).clip(max=len(labelled) - 1)
    above = np.maximum(below - 1, 0)
    exact = labelled[below] == rows
    between = (labelled[above] < rows) & (rows < labelled[below])
    share = (rows - labelled[above]) / np.where(between, labelled[below] - labelled[above], 1.0)
    mixed = (1.0 - share) * x[:, above] + share * x[:, below]
    present = x >= 0.0
    valid = present[:, below] & (exact | (between & present[:, above]))
    return np.where(exact, x[:, below], mixed), valid
