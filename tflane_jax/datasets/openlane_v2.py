"""OpenLane-V2, either subset, in either flavour: frame files and images -> `Example`.

Not in the files: the visibility of lanes (set to 1), the 3-D position of traffic elements (set to 0) and the
boundaries of merged centerlines (left and right are the centerline itself). Examples have no bird's-eye-view evidence.
Of the priors they have traffic flow, where the logs are at hand of which the segments are parts (`openlane_tracks`),
virtual markers (`openlane_markers`) and the official SD map (`openlane_sd_map`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.base import FrameInfo, Split, checked_index
from tflane_jax.datasets.data_source import Choice, DataSource, first_or_nominal, split_config
from tflane_jax.datasets.openlane_annotation import read_annotation
from tflane_jax.datasets.openlane_can_bus import vehicle_state
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_choice import preset_of, subset_of
from tflane_jax.datasets.openlane_example import area_set, blank, camera_views, element_set, empty_views, lane_graph
from tflane_jax.datasets.openlane_frames import (
    SUBSETS,
    FrameFile,
    frames_content,
    info_path,
    list_frames,
    read_frame,
    read_pose,
    source_logs,
    without_map_changes,
)
from tflane_jax.datasets.openlane_markers import SegmentBoards, SegmentFrame, segment_frame
from tflane_jax.datasets.openlane_sd_map import SegmentSdMaps
from tflane_jax.datasets.openlane_settings import OPENLANE_V2_SIZES, OpenLaneV2Config, OpenLaneV2Settings
from tflane_jax.datasets.openlane_tracks import SourceTracks
from tflane_jax.datasets.overlap import frame_drives
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.view_images import TOPONET_SUBSET_A, ImageConfig, ImageFit, fit_image
from tflane_jax.errors import UserError
from tflane_jax.files.images import read_image
from tflane_jax.files.openlane import CENTERLINE, SEGMENT, FieldNames, FrameKey
from tflane_jax.geometry import relative_pose
from tflane_jax.limits import Rules
from tflane_jax.scene import CameraViews, Example


class OpenLaneV2Dataset:
    """Frames of one split, sorted by segment, then time.

    Raises UserError where there are none. `example` raises it for a file that is missing, damaged, or differs from the
    others.
    """

    def __init__(self, config: OpenLaneV2Config):
        self.config = config
        self.name = f"openlane_v2-{config.subset}-{config.split}"
        self.root = Path(config.root)
        self.keys = list_frames(self.root, config.split, config.subset, config.data_dict)
        missing = [key for key in self.keys if not info_path(self.root, key, self._suffixes[0]).is_file()]
        if missing:
            raise UserError(
                f"{self.root}: {len(missing)} of {len(self.keys)} frames are missing ({missing[0]}{self._suffixes[0]}"
                ".json, ...): unpack them, name a split file of those at hand (data.data_dict, or --data-dict of "
                "eval, predict and submit), or take what is there (data_dict folders)"
            )
        if config.map_changes == "drop":
            self.keys = without_map_changes(self.root, self.keys, self._suffixes[0])
        self._tracks: SourceTracks | None = None
        if config.tracks is not None:
            logs = source_logs(self.root, self.keys, self._suffixes[0])
            self._tracks = SourceTracks(config.tracks, config.subset, logs)
            self.keys = self._tracks.known(self.keys, config.without_tracks)
        self._poses: dict[int, np.ndarray] = {}
        self._sd_maps = None if config.example.sd_map is None else SegmentSdMaps(self.root, self.keys)
        self._first: dict[str, int] = {}
        for index, key in enumerate(self.keys):
            self._first.setdefault(key.scene, index)
        wanted = config.example.markers
        self._boards = (
            None if wanted is None else SegmentBoards(config.boards, wanted, config.example.range, self._segment)
        )

    def __len__(self) -> int:
        return len(self.keys)

    def example(self, index: int) -> Example:
        """Return one frame."""
        key = self.keys[checked_index(index, len(self), self.name)]
        config, files = self.config.example, self._files(index)
        truth, pose = self._truth(key, files), files[0].global_from_ego
        flow = markers = sd_map = None
        if self._tracks is not None:
            flow = self._tracks.flow(key, pose, config)
        if self._boards is not None:
            markers = self._boards.observations(key.scene, index - self._first[key.scene])
        if self._sd_maps is not None and config.sd_map is not None:
            sd_map = self._sd_maps.around(key, pose, config.sd_map)
        before = index > 0 and self.keys[index - 1].segment == key.segment
        return replace(
            truth,
            traffic_flow=flow,
            markers=markers,
            sd_map=sd_map,
            previous_from_ego=relative_pose(self._pose(index - 1) if before else pose, pose).astype(np.float32),
            has_previous=np.asarray(before),
            cameras=self._views(files[0]),
        )

    def _truth(self, key: FrameKey, files: list[FrameFile]) -> Example:
        """Return an example with nothing but what a frame's files annotate; traffic elements are those of the first."""
        if (bare := [file.path for file in files if file.annotation is None]) and key.split != "test":
            raise UserError(f"{bare[0]} has no annotation: of the splits, only test may have such frames")
        found = {
            names: read_annotation(file.annotation, names, f"{file.path}: annotation")
            for file, names in zip(files, self._names, strict=True)
            if file.annotation is not None
        }
        config, example = self.config.example, _blank(self.config, None)
        lanes, segments, areas = example.lanes, example.segments, example.areas
        kept: dict[FieldNames, Int[np.ndarray, " n"]] = {}
        if CENTERLINE in found:
            lanes, kept[CENTERLINE] = lane_graph(found[CENTERLINE], config.lanes, config.lane_points)
        if SEGMENT in found:
            segments, kept[SEGMENT] = lane_graph(found[SEGMENT], config.segments, config.segment_points)
            areas = area_set(found[SEGMENT], config.areas, config.area_points, config.crossings)
        elements, first = example.traffic_elements, self._names[0]
        if first in found and elements is not None:
            elements = element_set(found[first], elements, kept[first], self._fits[0])
        return replace(example, lanes=lanes, segments=segments, areas=areas, traffic_elements=elements)

    def first_unlabelled(self) -> Path | None:
        """Return the first frame's file if it has no annotation."""
        file = self._files(0)[0]
        return None if file.annotation is not None else file.path

    def info(self, index: int) -> FrameInfo:
        """Return segment, time and pose of one frame, and its city, which only the source logs tell."""
        key = self.keys[checked_index(index, len(self), self.name)]
        area = "" if self._tracks is None else self._tracks.area(key)
        return FrameInfo("openlane_v2", key.scene, self._time(index), self._pose(index), area)

    def scene(self, index: int) -> str:
        """Return the segment of one frame; reads no file."""
        return self.keys[checked_index(index, len(self), self.name)].scene

    def in_files(self, boxes: Float[np.ndarray, "e 2 2"]) -> Float[np.ndarray, "e 2 2"]:
        """Return boxes of examples, of the front camera, in pixels of its files."""
        return boxes if self._fits[0] is None else self._fits[0].in_file(boxes)

    def _time(self, index: int) -> int:
        return int(self.keys[index].timestamp) * SUBSETS[self.config.subset].tick_ns

    @property
    def _names(self) -> tuple[FieldNames, ...]:
        """Names of the fields of each file that is read of a frame."""
        files = {"centerline": (CENTERLINE,), "lane_segment": (SEGMENT,), "both": (CENTERLINE, SEGMENT)}
        return files[self.config.flavour]

    @property
    def _suffixes(self) -> list[str]:
        return [names.suffix for names in self._names]

    def _files(self, index: int) -> list[FrameFile]:
        files = [read_frame(self.root, self.keys[index], self.config.subset, suffix) for suffix in self._suffixes]
        self._poses[index] = files[0].global_from_ego
        return files

    def _pose(self, index: int) -> Float[np.ndarray, "4 4"]:
        if index not in self._poses:
            self._poses[index] = read_pose(self.root, self.keys[index], self._suffixes[0])
        return self._poses[index]

    @cached_property
    def _sizes(self) -> tuple[tuple[int, int] | None, ...]:
        """Width and height of each camera's images, from the first frame that has the camera.

        Where images are not read, they may be missing and are taken to have the official sizes.
        """
        official = SUBSETS[self.config.subset].sizes
        sizes: list[tuple[int, int] | None] = [None] * len(official)
        for index in range(len(self)):
            for place, camera in enumerate(self._files(index)[0].cameras):
                if camera is not None and sizes[place] is None:
                    there = self.config.image is not None or camera.image.is_file()
                    height, width = read_image(camera.image).shape[:2] if there else official[place][::-1]
                    sizes[place] = width, height
            if None not in sizes:
                break
        if not any(sizes):
            raise UserError(f"{self.root}: no frame of {self.name} has a camera")
        return tuple(sizes)

    @cached_property
    def _fits(self) -> tuple[ImageFit | None, ...]:
        """Scaling and cropping of each camera's images."""
        image = self.config.image
        if image is None:
            return (None,) * len(SUBSETS[self.config.subset].cameras)
        return tuple(
            None if size is None else fit_image(*size, image, front=place == 0)
            for place, size in enumerate(self._sizes)
        )

    def _views(self, file: FrameFile) -> CameraViews | None:
        if self.config.image is None:
            return None
        views = camera_views(file.cameras, self._fits, self.config.image)
        return replace(views, vehicle=vehicle_state(file.global_from_ego, self.config.can_bus))

    def _segment(self, scene: str) -> list[SegmentFrame]:
        """Return the frames of a segment as boards need them."""
        rows = range(self._first[scene], len(self))
        frames = takewhile(lambda index: self.scene(index) == scene, rows)
        names = self._names[0]
        return [segment_frame(self._files(index)[0], names, self._time(index), self._sizes) for index in frames]


def nominal_example(config: OpenLaneV2Config) -> Example:
    """Return an example in which nothing is valid, with the official image sizes: shapes that need no data."""
    views = None
    if config.image is not None:
        sizes = SUBSETS[config.subset].sizes
        fits = [fit_image(*size, config.image, front=place == 0) for place, size in enumerate(sizes)]
        views = replace(empty_views(fits, config.image), vehicle=vehicle_state(np.eye(4), config.can_bus))
    return _blank(config, views)


def _blank(config: OpenLaneV2Config, views: CameraViews | None) -> Example:
    governed = "segments" if config.flavour == "lane_segment" else "lanes"
    return blank(config.example, governed=governed, views=views, traffic=config.tracks is not None)


@dataclass(frozen=True)
class OpenLaneV2Data(OpenLaneV2Settings):
    """OpenLane-V2, or any dataset in its layout, read from disk while training; `map_changes` is of the training split.

    Attributes:
        train, val, test: which official split serves as each; the official test split has no annotations.
        image: scaling and cropping of the images, which training needs.
        augmentation: of training images, or None.
    """

    train: Split = "train"
    val: Split = "val"
    test: Split = "val"
    image: ImageConfig = field(default=TOPONET_SUBSET_A, kw_only=True)
    augmentation: PhotometricConfig | None = PhotometricConfig()

    def limits(self) -> Rules:
        """Lanes are learned as the files have them: neither cut to a box nor chosen by kind."""
        box = OPENLANE_V2_SIZES.range
        whole = bool(self.example.range.contains(np.stack([box.x, box.y], -1)).all())
        yield "example.range", whole, f"at least x {box.x}, y {box.y}: labels are not cut to it"
        yield "example.bike_lanes", self.example.bike_lanes == "include", "'include': labels do not tell bicycle lanes"
        yield "example.cameras", self.example.cameras is None, "None: `image` says how the files' images are read"

    def source(self, split: Split) -> OpenLaneV2Config:
        """Return the dataset of a split."""
        map_changes = self.map_changes if split == "train" else "keep"
        return split_config(OpenLaneV2Config, self, split=getattr(self, split), map_changes=map_changes)


def _choose(choice: Choice) -> OpenLaneV2Config:
    assert choice.root is not None
    if isinstance(choice.configured, OpenLaneV2Config):  # its splits stay as configured: the official test has no truth
        return replace(choice.configured, root=choice.root)
    subset = subset_of(choice.root)
    image = preset_of(choice.root, choice.split, subset)
    flavour = "centerline" if choice.truth == ("lanes",) else "both" if "lanes" in choice.truth else "lane_segment"
    example = choice.configured.example
    return OpenLaneV2Config(choice.root, choice.split, subset=subset, flavour=flavour, image=image, example=example)


def _unlabelled(config: OpenLaneV2Config) -> str:
    """Return why a split has no truth; a frame of another split that has none is an error when it is read."""
    if config.split != "test" or (found := OpenLaneV2Dataset(config).first_unlabelled()) is None:
        return ""
    return f"{found} has no annotation, as the official test split has none: name train or val in its place"


SOURCE = DataSource(
    name="openlane-v2",
    data=OpenLaneV2Data,
    config=OpenLaneV2Config,
    example=Example,
    dataset=OpenLaneV2Dataset,
    streams=lambda config: True,
    sample=first_or_nominal(OpenLaneV2Dataset, nominal_example),
    choose=_choose,
    title=lambda config: f"openlane-v2-{config.subset}-{config.split}",
    drives=lambda config: frame_drives(OpenLaneV2Dataset(config)),
    root="its folder",
    check=check_openlane_v2,
    tracks=True,
    interval=lambda config: 0.5,
    cameras=lambda config: None if config.image is None else SUBSETS[config.subset].cameras,
    unlabelled=_unlabelled,
    tracks_hz=lambda config: 0.0 if config.tracks is None else SUBSETS[config.subset].tracks_hz,
    content=lambda config: frames_content(Path(config.root), config.split, config.subset, config.data_dict),
)
