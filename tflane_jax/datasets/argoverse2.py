"""Argoverse 2 sensor logs as a dataset of lane graphs, with the images of the ring cameras, if the logs have them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.datasets.argoverse2_cameras import RING, LogImages, has_images, ring_fits
from tflane_jax.datasets.argoverse2_log import (
    ANNOTATIONS,
    Keyframes,
    check_log,
    find_logs,
    load_log,
    log_outline,
)
from tflane_jax.datasets.base import SPLITS, ExampleConfig, Split
from tflane_jax.datasets.data_source import Choice, DataSource, FolderCheck, split_config
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.log_frames import LogFrames
from tflane_jax.datasets.openlane_example import camera_views
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.datasets.overlap import frame_drives
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.road_maps import content_of, map_of_log
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.view_images import ImageConfig, ImageFit
from tflane_jax.errors import UserError
from tflane_jax.scene import CameraViews, Example
from tflane_jax.scene.logs import KeyFrame, Log
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig

_PICTURES = ImageConfig(scale=0.5)
"""Of images that no model reads: whole, at half the size."""


@dataclass(frozen=True, kw_only=True)
class Argoverse2Settings:
    """How frames become examples: the settings of one folder of logs and of a run have these in common.

    Attributes:
        keyframes: which frames become examples, see `load_log`.
        openlane: folder of the OpenLane-V2 split files, which hold the exact timestamps, see `load_log`.
        example: what is in an example, and its capacities. `example.cameras` draws images of map and boxes.
        loading: memory or disk, and workers.
        image: scaling and cropping of the recorded images of the ring cameras, which then take the place of drawn ones;
            None does not read them.
    """

    keyframes: Keyframes = "openlane_v2"
    openlane: Path | None = None
    example: ExampleConfig = ExampleConfig()
    loading: StreamingConfig = StreamingConfig()
    image: ImageConfig | None = None


@dataclass(frozen=True)
class Argoverse2Config(Argoverse2Settings):
    """Which logs.

    Attributes:
        root: a dataset root (sensor/<split>/<log id>/), a split, a folder of logs, or one log; all logs below it.
    """

    root: Path


class Argoverse2Dataset(LogFrames):
    """Examples of every log below a folder, sorted by log id, then time.

    Boxes and maps are read when an example needs them, see `LogFrames`.

    Raises UserError where there is no log, or the times and poses of one cannot be read, with `image` also where a log
    has no images. `example` raises it for damaged boxes or a damaged map.
    """

    name = "argoverse2"

    def __init__(self, config: Argoverse2Config):
        self.config = config
        if config.image is not None and config.example.cameras is not None:
            raise UserError("image reads recorded images, example.cameras draws others: set one of them to None")
        self._folders = find_logs(config.root)
        which = config.keyframes, config.openlane
        outlines = [log_outline(folder, *which) for folder in self._folders]
        super().__init__(outlines, partial(_read, self._folders, *which))
        wanted = config.image is not None
        self._images = [LogImages(folder) if wanted else None for folder in self._folders]
        self._fits = ring_fits(filter(None, self._images), config.image) if config.image is not None else ()

    def example(self, index: int) -> Example:
        """Return one example; a camera without an image at that time is not valid."""
        config, (row, moment) = self.config, self.place(index)
        example, images = make_example(*self[index], config.example), self._images[row]
        if images is None or config.image is None:
            return example
        cameras = images.at(moment)
        return replace(example, cameras=camera_views(cameras, self._fits, config.image))

    def views(self, indices: Sequence[int]) -> list[CameraViews | None]:
        """Return the images of some examples for pictures; None for an example whose images are not there.

        Raises UserError for an image or a calibration that cannot be read.
        """
        places = [self.place(index) for index in indices]
        there = {row: LogImages(self._folders[row]) for row, _ in places if has_images(self._folders[row])}
        image = self.config.image or _PICTURES
        fits = ring_fits(there.values(), image)
        return [_views(there[row], moment, fits, image) if row in there else None for row, moment in places]

    def drives(self) -> Iterator[Log]:
        """Yield the logs."""
        return self.logs()


def _read(folders: Sequence[Path], keyframes: Keyframes, openlane: Path | None, row: int) -> Log:
    return load_log(folders[row], keyframes=keyframes, openlane=openlane)


def _views(
    images: LogImages, moment: KeyFrame, fits: Sequence[ImageFit | None], config: ImageConfig
) -> CameraViews | None:
    cameras = images.at(moment)
    return camera_views(cameras, fits, config) if any(camera is not None for camera in cameras) else None


@dataclass(frozen=True)
class LogData(Argoverse2Settings):
    """Argoverse 2 logs for training, validation and test.

    Attributes:
        train, val, test: a log or a folder of logs for each split.
        augmentation: of training images, or None.
    """

    train: Path
    val: Path
    test: Path
    augmentation: PhotometricConfig | None = None

    def source(self, split: Split) -> Argoverse2Config:
        """Return the dataset of a split."""
        return split_config(Argoverse2Config, self, root=getattr(self, split))


def _split_folder(choice: Choice) -> Path:
    """Return the folder of a split below the root; the root itself where it is not divided into splits.

    Raises UserError where the root has splits but not this one, or none although one was asked for, unless the root's
    own name is that of the split.
    """
    root, split, option = choice.root, choice.split, choice.option
    assert root is not None
    places = [root / "sensor", root]
    present = [place / name for place in places for name in SPLITS if (place / name).is_dir()]
    for folder in present:
        if folder.name == split:
            return folder
    if present:
        names = ", ".join(folder.name for folder in present)
        which = f"add {option} {names}" if len(present) == 1 else f"choose one with {option}"
        raise UserError(f"{root} has no split {split}, only {names}: {which}")
    if choice.split_given and root.is_dir() and root.name != split:
        if option == "--split":
            remedy = "leave --split out to take all of them, or "
        else:
            remedy = f"add {option} {root.name}, or " if root.name in SPLITS else ""
        raise UserError(
            f"{root} is not divided into splits, so {option} {split} cannot choose among its logs: {remedy}name a "
            f"folder that holds {split}/<log id>/{ANNOTATIONS}"
        )
    return root


def _choose(choice: Choice) -> Argoverse2Config:
    root, example = _split_folder(choice), choice.configured.example
    image = _recorded(choice.configured, root)
    if image is not None:  # recorded images take the place of drawn ones
        example = replace(example, cameras=None)
    if isinstance(configured := choice.configured, Argoverse2Config):  # a run on such logs keeps its other settings
        openlane = choice.openlane or configured.openlane
        return replace(configured, root=root, openlane=openlane, example=example, image=image)
    return Argoverse2Config(root, openlane=choice.openlane, example=example, image=image)


def _recorded(configured: Any, root: Path) -> ImageConfig | None:
    """Return how a model that was trained on the data `configured` reads the images of the logs; None for not at all.

    It reads them where its own images are of this ring: recorded ones as in training, drawn ones of other data as
    recorded ones of the same focal length if every log has images.
    """
    drawn = configured.example.cameras
    if isinstance(configured, Argoverse2Config) or (
        isinstance(configured, OpenLaneV2Config) and configured.subset == "A"
    ):
        return configured.image
    if drawn is None or not _is_ring(drawn) or not all(map(has_images, find_logs(root))):
        return None
    return _like_drawn(drawn)


def _is_ring(drawn: CameraRigConfig) -> bool:
    return tuple(mount.name for mount in drawn.cameras) == RING


def _like_drawn(drawn: CameraRigConfig) -> ImageConfig:
    """Return the scaling with which recorded images have the focal lengths of drawn ones, pixels."""
    ratio = np.median([mount.focal for mount in drawn.cameras]) / np.median([mount.focal for mount in ARGOVERSE2_RING])
    return ImageConfig(scale=float(drawn.scale * ratio), divisor=drawn.multiple)


def _title(config: Argoverse2Config) -> str:
    name = Path(config.root).name
    return f"argoverse2-{name}" if name in SPLITS else "argoverse2"


def check_argoverse2(root: Path) -> FolderCheck:
    """Read every log below a folder and count what is in it; raise UserError where there is none."""
    rows, faults = [], []
    for folder in find_logs(root):
        found = check_log(folder)
        row = {"log": folder.name, "key frames": 0, "annotated frames": 0, "road users": 0, "lane segments": 0}
        row |= {"cameras": 0, "missing images": 0}
        if not found:
            log = load_log(folder)
            row |= {"key frames": len(log.keyframes), "annotated frames": log.tracks.frames}
            row |= {"road users": len(log.tracks.uuid), "lane segments": len(log.map.segments)}
            if has_images(folder):
                row |= _checked_images(folder, log, found)
        faults += found
        rows.append(row | {"faults": len(found)})
    return FolderCheck("Argoverse 2", rows, faults)


def _checked_images(folder: Path, log: Log, faults: list[str]) -> dict[str, int]:
    """Return how many ring cameras have images, and how many of their images at key frames are missing."""
    try:
        images = LogImages(folder)
        at = [images.at(moment) for moment in log.keyframes]
    except UserError as error:
        faults.append(str(error))
        return {}
    there = [row for row, camera in enumerate(images.cameras) if camera is not None]
    return {"cameras": len(there), "missing images": sum(frame[row] is None for frame in at for row in there)}


def _pictures(config: Argoverse2Config, numbers: Sequence[int]) -> list[CameraViews | None]:
    return Argoverse2Dataset(config).views(numbers)


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
    streams=lambda config: config.image is not None,
    views=_pictures,
    cameras=lambda config: None if config.image is None else RING,
    tracks_hz=lambda config: 10.0,
    content=lambda config: content_of([map_of_log(folder) for folder in find_logs(config.root)]),
)
