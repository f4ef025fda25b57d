"""TuSimple lane detection: label files and clips -> `RoadImage`.

A label file has one JSON record a line: `raw_file`, `h_samples` (48 or 56 image rows) and `lanes`, one x per row and
lane, -2 where the lane has no point. Examples always have the 56 rows of the test set (`datasets.lane_rows`); rows
that a file does not label are absent. Source: https://github.com/TuSimple/tusimple-benchmark. Images of other cameras
may have other sizes; rows and x are pixels of the image.

The folder may hold label files and `clips` itself, in `LaneDetection` (LSTR's layout), or, in either, in `train_set`
and `test_set`, as the archives are often unpacked.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tflane_jax.cores import working_cores
from tflane_jax.datasets.augmentation import AugmentationConfig
from tflane_jax.datasets.base import SPLITS, FrameInfo, Split, checked_index
from tflane_jax.datasets.data_source import Choice, DataSource, FolderCheck, loading_of
from tflane_jax.datasets.lane_rows import LabelledImages, lane_lines
from tflane_jax.datasets.loading import IN_MEMORY
from tflane_jax.datasets.photos import HEIGHT, WIDTH
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.datasets.tusimple_files import (
    LabelSplit,
    absent_splits,
    check_label_files,
    find_label_files,
    further_files,
    image_folder,
)
from tflane_jax.errors import UserError
from tflane_jax.files.fields import file_within
from tflane_jax.files.images import read_image, resize
from tflane_jax.files.tusimple import NO_DRIVES, RowLanes, read_truth
from tflane_jax.processes import is_first
from tflane_jax.progress import progress_bar
from tflane_jax.scene import LaneLines, RoadImage


@dataclass(frozen=True)
class TuSimpleConfig:
    """Which frames, and how they become examples.

    Attributes:
        root: folder with the label files and `clips`, or with folders `LaneDetection`, `train_set` or `test_set`
            that hold them; the last two may be in `LaneDetection`.
        split: "train" (label files 0313, 0601) and "val" (0531) are LSTR's parts of the official training set; "test";
            "all" is the whole training set and any further `label_data_*.json`. Missing files are left out.
        label_files: file names in these folders to read instead of the split's files; each must exist.
        height, width: size of an example's image, pixels.
        capacity: lines in an example; of more, those with the fewest points are left out.
        loading: memory or disk, and workers.
    """

    root: str = "data/tusimple/LaneDetection"
    split: LabelSplit = "all"
    label_files: tuple[str, ...] = ()
    height: int = HEIGHT
    width: int = WIDTH
    capacity: int = 8
    loading: StreamingConfig = StreamingConfig()


class _Frame(NamedTuple):
    """A labelled frame.

    Attributes:
        name: of its image, as in the label file.
        lanes: labels.
        folder: from which the name starts.
    """

    name: str
    lanes: RowLanes
    folder: Path

    @property
    def image(self) -> Path:
        return self.folder / self.name


class TuSimpleDataset:
    """Labelled frames in the order of the label files.

    Attributes:
        name: for messages and run records.
        label_files: label files that were found.
        absent_files: names of the split's label files that are missing.

    Raises UserError where no label file is found, a label file is malformed, two files label the same frame, no frame
    is labelled, or images are missing.
    """

    def __init__(self, config: TuSimpleConfig) -> None:
        root = Path(config.root)
        self.config = config
        self.name = f"tusimple-{'custom' if config.label_files else config.split}"
        self.label_files, self.absent_files = find_label_files(root, config.split, config.label_files)
        frames: dict[str, _Frame] = {}
        for file in self.label_files:
            read = read_truth(file)
            twice = next((name for name in read if name in frames), None)
            if twice is not None:
                raise UserError(f"{file} labels {twice}, which an earlier label file labels too: leave one of them out")
            for name in read:
                file_within(root, name, f"{file}: raw_file")
            folder = image_folder(root, file, list(read))
            frames |= {name: _Frame(name, lanes, folder) for name, lanes in read.items()}
        self._frames = list(frames.values())
        self._sizes: dict[str, tuple[int, int]] = {}  # of the images read so far
        if not self._frames:
            raise UserError(f"{', '.join(map(str, self.label_files))}: no labelled frames")
        missing = [frame.name for frame in self._frames if not frame.image.is_file()]
        if missing:
            shown = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
            raise UserError(
                f"{root}: {len(missing)} of {len(self)} labelled images are missing ({shown}): unpack TuSimple's "
                "clips there, or keep only the records of the images at hand in a label file of your own"
            )

    def __len__(self) -> int:
        return len(self._frames)

    def summary(self) -> str:
        """Return one line of text: number of frames, label files found, label files missing."""
        found = ", ".join(file.name for file in self.label_files)
        absent = f"; not found: {', '.join(self.absent_files)}" if self.absent_files else ""
        return f"{self.name}: {len(self)} frames of {found}{absent}"

    def example(self, index: int) -> RoadImage:
        """Return one frame; raises UserError where its image cannot be read."""
        frame = self._frames[checked_index(index, len(self), self.name)]
        image = read_image(frame.image)
        height, width = self._sizes[frame.name] = image.shape[:2]
        image = resize(image, self.config.height, self.config.width)
        lines = lane_lines(frame.lanes, height=height, width=width, capacity=self.config.capacity)
        return RoadImage(image, np.ones(image.shape[:2], bool), lines)

    def truth(self, index: int) -> RowLanes:
        """Return the labels for TuSimple's metric: pixels of the original image, lanes without a point included.

        Reads the image for its size if `example` has not; raises UserError where it cannot be read.
        """
        frame = self._frames[checked_index(index, len(self), self.name)]
        if frame.name not in self._sizes:
            self._sizes[frame.name] = read_image(frame.image).shape[:2]
        return replace(frame.lanes, size=self._sizes[frame.name])

    def raw_file(self, index: int) -> str:
        """Return the name that label and prediction files give a frame."""
        return self._frames[checked_index(index, len(self), self.name)].name

    def info(self, index: int) -> FrameInfo:
        """Return where one frame comes from; TuSimple gives neither time nor pose."""
        return FrameInfo("tusimple", self.raw_file(index), 0, np.eye(4))


def load_road_images(dataset: TuSimpleDataset, *, progress: bool = True, workers: int | None = None) -> RoadImage:
    """Read a whole dataset into memory, the examples stacked along a new first axis.

    An image of 360 x 640 takes 0.7 MB, a full frame for augmentation 2.8 MB; the 3,626 of the training set take 2.5 or
    10 GB. `image_valid` is a read-only view of one value. `workers` threads decode the images, by default one per core
    and at most 8.
    """
    count, config = len(dataset), dataset.config
    images = np.empty((count, config.height, config.width, 3), np.uint8)
    workers = min(working_cores(), 8) if workers is None else workers

    def load(index: int) -> LaneLines:
        example = dataset.example(index)
        images[index] = example.image
        return example.lines

    shown = progress and is_first()  # of several processes, which all read the same
    with ThreadPoolExecutor(workers) as pool:
        bar = progress_bar(
            pool.map(load, range(count)), f"loading {dataset.name}", unit="image", total=count, disable=not shown
        )
        try:
            lines = list(bar)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    stacked = LaneLines(*(np.stack([getattr(line, name) for line in lines]) for name in LaneLines.__dataclass_fields__))
    return RoadImage(images, np.broadcast_to(True, images.shape[:3]), stacked)


@dataclass(frozen=True)
class TuSimpleData:
    """TuSimple for training, validation and test.

    Attributes:
        root: folder with clips and label files, see `TuSimpleConfig`.
        train, val, test: which label files each split reads, see `TuSimpleConfig.split`.
        augmentation: of training images, or None.
        loading: memory or disk, and workers; "auto" keeps up to 6 GiB of decoded images in memory.
    """

    root: Path
    train: LabelSplit = "train"
    val: LabelSplit = "val"
    test: LabelSplit = "test"
    augmentation: AugmentationConfig | None = AugmentationConfig()
    loading: StreamingConfig = StreamingConfig()

    def source(self, split: Split) -> TuSimpleConfig:
        """Return the dataset of a split."""
        return TuSimpleConfig(str(self.root), getattr(self, split), loading=self.loading)


def _load(dataset: TuSimpleDataset, progress: bool, parts: Collection[str], loading: StreamingConfig) -> LabelledImages:
    large = len(dataset) * dataset.config.height * dataset.config.width * 3 > IN_MEMORY
    streams = loading.where == "disk" or (loading.where == "auto" and large)
    images = Streamed(dataset, loading) if streams else load_road_images(dataset, progress=progress)
    return LabelledImages(images, _Labels(dataset))


@dataclass(frozen=True)
class _Labels(Sequence[RowLanes]):
    """Labels that are asked for one by one, because those of an image that was not read yet need it."""

    dataset: TuSimpleDataset

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index):
        return self.dataset.truth(index)


def _choose(choice: Choice) -> TuSimpleConfig:
    """Return the official split of the named folder.

    A configuration may read other label files as its "test" split, because its own folder has no better ones; that
    mapping must not turn `--split test --root FOLDER` into an evaluation on the training frames of FOLDER.
    """
    assert choice.root is not None
    return TuSimpleConfig(str(choice.root), choice.split, loading=loading_of(choice.configured))


def _content(config: TuSimpleConfig) -> str:
    """Return the hash of the label files, of which each has the names of its images and their lanes."""
    files, _ = find_label_files(Path(config.root), config.split, config.label_files)
    return hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()


def check_tusimple(root: Path) -> FolderCheck:
    """Count the labelled frames of each split, and of label files that only "all" reads.

    Faults are missing images and malformed records. Label files that are not there are none: many people have a part.

    Raises UserError where there is no label file at all; it names the folder above or below that has some.
    """
    if not root.is_dir():
        raise UserError(f"{root} is no folder: name TuSimple's, with its label files and clips")
    check_label_files(root)
    rows, faults, absent = [], [], absent_splits(root)
    skipped = [f"split {split}: there is no {' and no '.join(names)}" for split, names in absent.items()]
    parts = {split: TuSimpleConfig(str(root), split) for split in SPLITS if split not in absent}
    if further := further_files(root):
        parts["all, further files"] = TuSimpleConfig(str(root), label_files=further)
    for part, config in parts.items():
        try:
            dataset = TuSimpleDataset(config)
        except UserError as error:
            faults.append(str(error))
            continue
        skipped += [f"split {part}: there is no {name}" for name in dataset.absent_files]
        rows.append({"split": part, "frames": len(dataset), "label files": len(dataset.label_files)})
    return FolderCheck("TuSimple", rows, faults, skipped)


SOURCE = DataSource(
    name="tusimple",
    data=TuSimpleData,
    config=TuSimpleConfig,
    example=RoadImage,
    dataset=TuSimpleDataset,
    load=_load,
    choose=_choose,
    title=lambda config: f"tusimple-{config.split}",
    no_drives=NO_DRIVES,
    root="the folder with clips and label files, or with train_set and test_set",
    check=check_tusimple,
    content=_content,
)
