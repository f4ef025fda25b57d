"""Front views of the built-in world as a dataset of road images: endless, seeded, without a download.

One integer names one image with its lane lines. Each split owns a range of integers, so training, validation and test
images are disjoint by construction.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import jax
import numpy as np

from tflane_jax.datasets.augmentation import AugmentationConfig
from tflane_jax.datasets.base import FrameInfo, Split, checked_index
from tflane_jax.datasets.cache import cached
from tflane_jax.datasets.data_source import Choice, DataSource
from tflane_jax.datasets.lane_rows import LabelledImages, row_lanes
from tflane_jax.datasets.leaves import image_from_leaves
from tflane_jax.datasets.procedural import FIRST_SCENE, SCENES_PER_SPLIT
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.files.tusimple import RowLanes
from tflane_jax.limits import Count
from tflane_jax.scene import LaneLines, RoadImage
from tflane_jax.world.front_view.lines import CAPACITY, ROW_FRACTIONS
from tflane_jax.world.front_view.views import FrontWorldConfig, front_view, scene_weather


@dataclass(frozen=True)
class FrontViewConfig:
    """Which front views of the built-in world.

    Attributes:
        split: train owns the scene ids [0, 1e8), val [1e8, 2e8), test [2e8, 3e8).
        images: number of images, one per scene.
        first: number of scenes to skip at the start of the split's range.
        world: camera, road, traffic, weather, and one `severity` of them all (0 to 1).
        loading: memory or disk, and workers. It is no part of the repr, because cached images do not depend on it.
    """

    split: Split = "train"
    images: int = 4000
    first: int = 0
    world: FrontWorldConfig = FrontWorldConfig()
    loading: StreamingConfig = field(default=StreamingConfig(), repr=False)


class FrontViewDataset:
    """Road images made on request.

    Raises UserError for images outside the split's range of ids.
    """

    def __init__(self, config: FrontViewConfig):
        if config.images < 0 or config.first < 0 or config.first + config.images > SCENES_PER_SPLIT:
            raise UserError(
                f"{config.split} has images 0 to {SCENES_PER_SPLIT - 1}, not {config.first} to "
                f"{config.first + config.images - 1}: change `first` or `images`"
            )
        self.config = config
        self.name = f"front-views-{config.split}"

    def __len__(self) -> int:
        return self.config.images

    def example(self, index: int) -> RoadImage:
        """Return one image with its lane lines."""
        return front_view(self.scene_id(index), self.config.world)

    def truth(self, index: int) -> RowLanes:
        """Return the lane lines of one image for TuSimple's metric, in pixels of a TuSimple image (720 x 1280)."""
        return row_lanes(self.example(index).lines)

    def info(self, index: int) -> FrameInfo:
        """Return where one image comes from; a front view has no time and no pose."""
        return FrameInfo("front-views", f"front-{self.scene_id(index):09d}", 0, np.eye(4))

    def weather(self, index: int) -> str:
        """Return the kind of weather of one image, such as "low sun" (see `world.render.weather.Sky`)."""
        return scene_weather(self.scene_id(index), self.config.world).kind.value

    def scene_id(self, index: int) -> int:
        """Return the world's number of one image; raises IndexError outside the dataset."""
        checked_index(index, len(self), self.name, "images")
        return FIRST_SCENE[self.config.split] + self.config.first + index


class _StoredViews(FrontViewDataset):
    """The same images as the cache holds them: without the mask, which is true everywhere."""

    def example(self, index: int) -> RoadImage:
        # `replace` of dataclasses: pyright does not know flax's.
        return replace(super().example(index), image_valid=None)  # type: ignore[arg-type]


def load_road_images(config: FrontViewConfig, *, progress: bool = True, workers: int | None = None) -> RoadImage:
    """Return all images of the configuration, stacked along a new first axis.

    They are made once, in parallel, and kept under the cache root (see `datasets.cache`). The images are read-only
    memory maps of the file on disk, so a large set needs little memory; `image_valid` is a broadcast view.

    Args:
        config: which images.
        progress: show a bar with rate and time left while they are made.
        workers: processes that make them, by default `cores.working_cores`. For more than one the caller's script must
            be guarded by `if __name__ == "__main__":`.

    Raises:
        UserError: ids outside the split, a severity outside [0, 1], a full disk, or a folder that cannot be written.
    """
    dataset = _StoredViews(config)
    camera, count = config.world.camera, len(dataset)
    shape = (count, camera.height, camera.width)
    if count:
        stored = image_from_leaves(cached(dataset, progress=progress, workers=workers).arrays(mapped=True))
    else:
        flags = np.zeros((0, CAPACITY, len(ROW_FRACTIONS)), bool)
        points = np.zeros((*flags.shape, 2), np.float32)
        lines = LaneLines(points, flags, np.zeros((0, CAPACITY), bool))
        stored = RoadImage(image=np.zeros((*shape, 3), np.uint8), image_valid=None, lines=lines)  # type: ignore
    return replace(stored, image_valid=np.broadcast_to(True, shape))


@dataclass(frozen=True)
class FrontViewData:
    """Front-view images of the built-in world for training, validation and test.

    Attributes:
        train, val, test: number of images of each split.
        world: camera, road, traffic and weather of the images.
        augmentation: of training images, or None.
        loading: memory or disk, and workers; "auto" leaves the images on disk, mapped into memory.
    """

    train: Count = 4000
    val: Count = 100
    test: Count = 400
    world: FrontWorldConfig = FrontWorldConfig()
    augmentation: AugmentationConfig | None = AugmentationConfig()
    loading: StreamingConfig = StreamingConfig()

    def source(self, split: Split) -> FrontViewConfig:
        """Return the dataset of a split."""
        return FrontViewConfig(split, images=getattr(self, split), world=self.world, loading=self.loading)


def _load(
    dataset: FrontViewDataset, progress: bool, parts: Collection[str], loading: StreamingConfig
) -> LabelledImages:
    images = load_road_images(dataset.config, progress=progress)
    if loading.where == "memory":
        images = replace(images, image=np.array(images.image))
    lines = (jax.tree.map(lambda leaf, i=i: leaf[i], images.lines) for i in range(len(images.image)))
    return LabelledImages(images, tuple(row_lanes(each) for each in lines))


def _choose(choice: Choice) -> FrontViewConfig:
    if isinstance(choice.configured, FrontViewConfig):
        return choice.configured
    return FrontViewConfig(choice.split, images=100)


SOURCE = DataSource(
    name="front-views",
    data=FrontViewData,
    config=FrontViewConfig,
    example=RoadImage,
    dataset=FrontViewDataset,
    load=_load,
    choose=_choose,
    title=lambda config: f"front-views-{config.split}",
    build=lambda config, progress: len(load_road_images(config, progress=progress).image),
)
