"""nuScenes without its devkit, as a dataset of lane graphs with traffic flow: tables, map expansion, images.

<root>/v1.0-trainval/*.json          the thirteen tables (or v1.0-mini, ...)
<root>/maps/expansion/<city>.json    map expansion, version 1.3
<root>/samples/CAM_*/*.jpg           images of the key frames; read if `NuScenesSettings.image` is given
<root>/samples/LIDAR_TOP/*.pcd.bin   sweeps of the key frames; read if `NuScenesSettings.depth_cell` is given
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.base import ExampleConfig, FrameInfo, Split, checked_index
from tflane_jax.datasets.data_source import Choice, DataSource, first_or_nominal, split_config
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.log_frames import KEPT_LOGS
from tflane_jax.datasets.nuscenes_cameras import (
    CAMERAS,
    CameraPoses,
    CanBus,
    camera_fits,
    sample_cameras,
    vehicle_state,
)
from tflane_jax.datasets.nuscenes_can_bus import CAN_BUS_SIZE
from tflane_jax.datasets.nuscenes_check import check_nuscenes
from tflane_jax.datasets.nuscenes_depth import with_depth, without_depth
from tflane_jax.datasets.nuscenes_folder import find_tables
from tflane_jax.datasets.nuscenes_log import (
    ReferenceFrame,
    SceneFrames,
    Visibility,
    level_poses,
    scene_frames,
    scene_log,
)
from tflane_jax.datasets.nuscenes_map import MapExpansion, read_expansion
from tflane_jax.datasets.nuscenes_scenes import NUSCENES_SIZES
from tflane_jax.datasets.nuscenes_splits import listed_scenes, split_scenes
from tflane_jax.datasets.nuscenes_tables import shared_tables
from tflane_jax.datasets.openlane_example import camera_views, empty_views
from tflane_jax.datasets.openlane_frames import SUBSETS, FrameCamera
from tflane_jax.datasets.overlap import frame_drives
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.prepared_map import prepare_map
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.view_images import TOPONET_SUBSET_B, ImageConfig, ImageFit, fit_image
from tflane_jax.errors import UserError
from tflane_jax.geometry import relative_pose, transform_points
from tflane_jax.limits import Count, Rules
from tflane_jax.recent import Recent
from tflane_jax.scene import CameraViews, Example, VehicleState
from tflane_jax.scene.logs import KeyFrame, Log, Tracks, VectorMap

# Metres of map beyond the corners of the perception range, so that chains of lanes are merged as on the whole map.
_BEYOND = 60.0
# Cities whose maps are kept: all of them.
_CITIES = 4


@dataclass(frozen=True)
class NuScenesSettings:
    """How key frames become examples: the settings of one split and of a run have these in common.

    Attributes:
        root: folder of the data set.
        version: folder of the tables, such as "v1.0-mini"; None finds it, see `nuscenes_folder.find_tables`.
        splits: JSON file {split: [scene names]} in place of the official splits.
        misplaced: whether to use five official scenes that do not fit the map, as MapTR does: "keep" or "drop", see
            `nuscenes_splits.MISPLACED`.
        frame: origin of the examples: the vehicle's rear axle, or the lidar, as in MapTR (see
            `nuscenes_log.level_poses`). x is forward and y left in both.
        least_visibility: boxes of a lower level of visibility are `TrafficFlow.occluded`, as are those without lidar
            and radar points.
        camera_poses: "exposure", where the vehicle was when a camera exposed; "calibration" leaves its motion out, as
            MapTRv2's lift does.
        can_bus: messages of the vehicle from the folder `can_bus`, by the "plain" rules or those of the "reference"
            (`nuscenes_can_bus.can_bus`), for published weights that read them (`BevFormerConfig.motion`).
        image: scaling and cropping of the camera images; None does not read them.
        depth_cell: side of the square cells for which images have the depth of the lidar's nearest point, pixels
            (MapTRv2 learns it in cells of 32); None does not read the sweeps.
        example: what is in an example, and its capacities. `example.cameras` must be None: cameras are real here.
        loading: memory or disk, and workers; no example depends on it.
    """

    root: Path
    _: KW_ONLY
    version: str | None = None
    splits: Path | None = None
    misplaced: Literal["keep", "drop"] = "keep"
    frame: ReferenceFrame = "ego"
    least_visibility: Visibility = "v0-40"
    camera_poses: CameraPoses = "exposure"
    can_bus: CanBus = "none"
    image: ImageConfig | None = None
    depth_cell: Count | None = None
    example: ExampleConfig = NUSCENES_SIZES
    loading: StreamingConfig = StreamingConfig()


@dataclass(frozen=True)
class NuScenesConfig(NuScenesSettings):
    """One split.

    Attributes:
        split: official split by scene name; the official test split has no annotations.
    """

    split: Split = "train"


class NuScenesDataset:
    """Key frames of one split, sorted by scene, then time.

    Logs and maps are made when they are first asked for; maps and the logs last asked for are kept. Raises UserError
    for tables that are missing or damaged and for a split without scenes.
    """

    def __init__(self, config: NuScenesConfig):
        self.config = config
        self.name = f"nuscenes-{config.split}"
        if config.example.cameras is not None:
            raise UserError("nuScenes has real cameras: set example.cameras=None and give `image`")
        self.tables = shared_tables(find_tables(config.root, config.version))
        scenes = self.tables.scenes()
        names = split_scenes(
            scenes, config.split, mini=self.tables.mini, file=config.splits, misplaced=config.misplaced
        )
        self.scenes = {name: scenes[name] for name in names}
        self._places = [(name, i) for name in names for i in range(len(self.tables.samples(scenes[name])))]
        self._map = Recent(self._read_map, _CITIES)
        self.frames = Recent(self._read_frames, len(names))
        """Scene name -> moments and poses of the scene."""
        self.log = Recent(self._log, KEPT_LOGS)
        """Scene name -> the scene as a log with the part of the city's map around it."""

    def __len__(self) -> int:
        return len(self._places)

    def example(self, index: int) -> Example:
        """Return one key frame."""
        config, (name, number) = self.config, self._place(index)
        example = make_example(self.log(name), number, config.example)
        if config.image is None:
            return example
        views = camera_views(self._cameras(index), self._fits, config.image)
        frames = self.frames(name)
        sample, pose = frames.samples[number], self._frame_from_ego(name, number)
        if config.depth_cell is not None:
            views = with_depth(self.tables, sample, frames.global_from_ego[number], views, config.depth_cell)
        state = vehicle_state(self.tables, self.scenes[name], sample, pose, config.can_bus)
        return replace(example, cameras=replace(views, vehicle=state))

    def views(self, index: int) -> CameraViews | None:
        """Return the images of a key frame whose files are there, for pictures; None without any.

        Raises UserError for an image that cannot be read.
        """
        cameras = [one if one is not None and one.image.is_file() else None for one in self._cameras(index)]
        image = self.config.image or TOPONET_SUBSET_B
        return camera_views(cameras, camera_fits(self.tables, image), image) if any(cameras) else None

    def _cameras(self, index: int) -> tuple[FrameCamera | None, ...]:
        name, number = self._place(index)
        frames, pose = self.frames(name), self._frame_from_ego(name, number)
        vehicle = frames.global_from_ego[number]
        return sample_cameras(self.tables, frames.samples[number], vehicle, pose, self.config.camera_poses)

    def _frame_from_ego(self, name: str, number: int) -> np.ndarray | None:
        return self.frames(name).frame_from_ego[number] if self.config.frame == "lidar" else None

    def info(self, index: int) -> FrameInfo:
        """Return scene, time and (level) pose of one key frame."""
        name, number = self._place(index)
        frames = self.frames(name)
        time, pose = int(frames.timestamps_ns[number]), frames.global_from_frame[number]
        return FrameInfo("nuscenes", name, time, pose, self.tables.location(self.scenes[name]))

    def token(self, index: int) -> str:
        """Return the sample token of one key frame."""
        name, number = self._place(index)
        return self.frames(name).samples[number]["token"]

    def in_lidar_axes(self, index: int, points: Float[np.ndarray, "*b d"]) -> Float[np.ndarray, "*b d"]:
        """Return points (x, y or x, y, z) of an example as MapTR's files have them: level, around the lidar, x right.

        Heights stay those above the ground.
        """
        name, number = self._place(index)
        frames = self.frames(name)
        ego_from_lidar = self.tables.calibration(frames.samples[number])
        (global_from_lidar,) = level_poses(frames.global_from_ego[[number]], ego_from_lidar[None])
        lidar_from_here = relative_pose(global_from_lidar, frames.global_from_frame[number])
        plane = lidar_from_here[np.ix_([0, 1, 3], [0, 1, 3])]
        x, y = np.moveaxis(transform_points(plane, points[..., :2]), -1, 0)
        return np.concatenate([np.stack([-y, x], -1), points[..., 2:]], -1)

    def _log(self, name: str) -> Log:
        frames = self.frames(name)
        location, scene = self.tables.location(self.scenes[name]), self.scenes[name]
        area = self._map(location).around(frames.global_from_frame[:, :2, 3], _reach(self.config.example))
        log = scene_log(self.tables, scene, frames, area, least_visibility=self.config.least_visibility)
        prepare_map(log.map, bike_lanes=self.config.example.bike_lanes == "include")
        return log

    def _read_map(self, location: str) -> MapExpansion:
        return read_expansion(self.tables.map_path(location))

    def _read_frames(self, name: str) -> SceneFrames:
        return scene_frames(self.tables, self.scenes[name], self.config.frame)

    @cached_property
    def _fits(self) -> tuple[ImageFit | None, ...]:
        assert self.config.image is not None
        return camera_fits(self.tables, self.config.image)

    def _place(self, index: int) -> tuple[str, int]:
        return self._places[checked_index(index, len(self), self.name)]


def _reach(config: ExampleConfig) -> float:
    ranges = (config.range, config.ground)
    return max(float(np.hypot(np.abs(r.x).max(), np.abs(r.y).max())) for r in ranges) + _BEYOND


def nominal_example(config: NuScenesConfig) -> Example:
    """Return an example in which nothing is valid, with the official image sizes: shapes that need no data."""
    pose = np.eye(4)
    tracks, moments = Tracks.empty(1), (KeyFrame(0, pose, 0),)
    log = Log("none", "nuscenes", VectorMap({}), np.zeros(1, np.int64), pose[None], tracks, tracks, moments)
    example = make_example(log, 0, config.example)
    if config.image is None:
        return example
    sizes = SUBSETS["B"].sizes
    fits = [fit_image(*size, config.image, front=place == 0) for place, size in enumerate(sizes)]
    views = without_depth(empty_views(fits, config.image), config.depth_cell)
    bus = None if config.can_bus == "none" else np.zeros(CAN_BUS_SIZE, np.float32)
    pose = pose.astype(np.float32)
    return replace(example, cameras=replace(views, vehicle=VehicleState(pose, pose, bus)))


@dataclass(frozen=True)
class NuScenesData(NuScenesSettings):
    """nuScenes, read from disk while training; `depth_cell` is of training images, others need no depth.

    Attributes:
        train, val, test: which official split serves as each; the official test split has no annotations.
        augmentation: of training images, or None.
    """

    train: Split = "train"
    val: Split = "val"
    test: Split = "val"
    augmentation: PhotometricConfig | None = None

    def limits(self) -> Rules:
        """Depth belongs to images."""
        yield "depth_cell", self.depth_cell is None or self.image is not None, "None without images (image)"

    def source(self, split: Split) -> NuScenesConfig:
        """Return the dataset of a split."""
        depth_cell = self.depth_cell if split == "train" else None
        return split_config(NuScenesConfig, self, split=getattr(self, split), depth_cell=depth_cell)


def _choose(choice: Choice) -> NuScenesConfig:
    assert choice.root is not None
    if isinstance(choice.configured, NuScenesConfig):  # its splits stay as configured: the official test has no truth
        return replace(choice.configured, root=choice.root, depth_cell=None)
    example = choice.configured.example
    image = getattr(choice.configured, "image", None)
    if image is None and example.cameras is not None:
        image = TOPONET_SUBSET_B
    # Sizes stay as configured; rendered cameras give way to the real ones.
    split = choice.split if choice.split_given or choice.split != "test" else "val"
    return NuScenesConfig(choice.root, split, image=image, example=replace(example, cameras=None))


def _views(config: NuScenesConfig, numbers: Sequence[int]) -> list[CameraViews | None]:
    dataset = NuScenesDataset(config)
    return [dataset.views(number) for number in numbers]


def _content(config: NuScenesConfig) -> str:
    """Return the hash of the scenes that a file of splits names; the tables are too large to be read for it."""
    if config.splits is None:
        return ""
    names = sorted(listed_scenes(config.splits, config.split))
    return hashlib.sha256(json.dumps(names).encode()).hexdigest()


SOURCE = DataSource(
    name="nuscenes",
    data=NuScenesData,
    config=NuScenesConfig,
    example=Example,
    dataset=NuScenesDataset,
    streams=lambda config: config.image is not None,
    sample=first_or_nominal(NuScenesDataset, nominal_example),
    choose=_choose,
    title=lambda config: f"nuscenes-{config.split}",
    drives=lambda config: frame_drives(NuScenesDataset(config)),
    root="its folder",
    check=check_nuscenes,
    views=_views,
    interval=lambda config: 0.5,
    cameras=lambda config: None if config.image is None else CAMERAS,
    tracks_hz=lambda config: 2.0,
    content=_content,
)
