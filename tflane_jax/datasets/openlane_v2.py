"""OpenLane-V2, either subset, in either flavour: frame files and images -> `Example`.

What the files do not tell: whether a lane is seen (visibility is 1), where a traffic element stands (its position is
zero), and the boundaries of merged centerlines (left and right are the centerline itself). There is no bird's-eye-view
evidence and no prior.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.base import ExampleConfig, FrameInfo, TruncationWarning
from tflane_jax.datasets.openlane_annotation import Annotation, read_annotation
from tflane_jax.datasets.openlane_frames import (
    SUBSETS,
    FrameFile,
    Split,
    SubsetName,
    info_path,
    list_frames,
    read_frame,
)
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.view_images import TOPONET_SUBSET_A, ImageConfig, ImageFit, canvas_size, fit_image
from tflane_jax.errors import UserError
from tflane_jax.files.images import read_image
from tflane_jax.files.openlane import CENTERLINE, DENSE_POINTS, SEGMENT
from tflane_jax.geometry import invert_pose, relative_pose
from tflane_jax.geometry.polylines import resample_lines
from tflane_jax.scene import Areas, CameraViews, Example, LaneGraph, TrafficElements

Flavour = Literal["centerline", "lane_segment", "both"]
OPENLANE_V2_SIZES = ExampleConfig(lanes=128, segments=192, areas=64, elements=48)
"""Room in an example; a frame of Argoverse 2 has some 60 centerlines, 75 segments and 11 elements (specs 2.3)."""


@dataclass(frozen=True)
class OpenLaneV2Config:
    """Which frames, and how they become examples.

    Attributes:
        root: folder of the dataset.
        split: the test split has no annotations, its examples no valid lane.
        subset: A is from Argoverse 2 (7 cameras), B from nuScenes (6).
        flavour: which files are read: centerlines (`Example.lanes`), lane segments with areas (`Example.segments`), or
            both. Traffic elements and what they govern come from the first of them: the rows of
            `TrafficElements.lane` are centerlines, of "lane_segment" segments.
        data_dict: split file under `root`, see `openlane_frames.list_frames`.
        image: what happens to the images; None leaves them unread (`Example.cameras` is None, boxes are in pixels of
            the files).
        example: capacities and points; what does not fit is left out, farthest first, with a `TruncationWarning`.
        loading: workers; changes no example.
    """

    root: Path
    split: Split = "train"
    subset: SubsetName = "A"
    flavour: Flavour = "centerline"
    data_dict: str | None = None
    image: ImageConfig | None = TOPONET_SUBSET_A
    example: ExampleConfig = OPENLANE_V2_SIZES
    loading: StreamingConfig = StreamingConfig()


class OpenLaneV2Dataset:
    """Frames of one split by segment, then time.

    Raises UserError where there are none; `example` raises it where a file is missing, damaged, or not as the others.
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
                ".json, ...): unpack them, name a split file of those at hand (data_dict), or take what is there "
                '(data_dict="folders")'
            )
        self._poses: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.keys)

    def example(self, index: int) -> Example:
        """Return one frame."""
        config, key, files = self.config.example, self.keys[self._checked(index)], self._files(index)
        annotations = [
            None if file.annotation is None else read_annotation(file.annotation, names, f"{file.path}: annotation")
            for file, names in zip(files, self._names, strict=True)
        ]
        lanes, segments = LaneGraph.empty(config.lanes, config.lane_points), None
        kept_lanes = kept_segments = np.zeros(0, int)
        areas = Areas.empty(config.areas, config.area_points)
        by_flavour = dict(zip(self._names, annotations, strict=True))
        if (found := by_flavour.get(CENTERLINE)) is not None:
            lanes, kept_lanes = lane_graph(found, config.lanes, config.lane_points)
        segments = LaneGraph.empty(config.segments, config.segment_points)
        if (found := by_flavour.get(SEGMENT)) is not None:
            segments, kept_segments = lane_graph(found, config.segments, config.segment_points)
            areas = area_set(found, config.areas, config.area_points)
        governed = (segments, kept_segments) if self._names[0] is SEGMENT else (lanes, kept_lanes)
        elements = TrafficElements.empty(config.elements, len(governed[0].valid))
        if annotations[0] is not None:
            elements = element_set(annotations[0], elements, governed[1], self._fits[0])
        before = index > 0 and self.keys[index - 1].segment == key.segment
        pose = files[0].global_from_ego
        return Example(
            bev=None,
            hidden=None,
            traffic_flow=None,
            markers=None,
            sd_map=None,
            lanes=lanes,
            segments=segments,
            areas=areas,
            traffic_elements=elements,
            previous_from_ego=relative_pose(self._pose(index - 1) if before else pose, pose).astype(np.float32),
            has_previous=np.asarray(before),
            cameras=None if self.config.image is None else self._views(files[0]),
        )

    def info(self, index: int) -> FrameInfo:
        """Return segment, time and pose of one frame."""
        key = self.keys[self._checked(index)]
        time = int(key.timestamp) * SUBSETS[self.config.subset].tick_ns
        return FrameInfo("openlane_v2", key.scene, time, self._pose(index))

    @property
    def _names(self):
        return {"centerline": (CENTERLINE,), "lane_segment": (SEGMENT,), "both": (CENTERLINE, SEGMENT)}[
            self.config.flavour
        ]

    @property
    def _suffixes(self) -> list[str]:
        return [names.suffix for names in self._names]

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} examples, no number {index}")
        return index

    def _files(self, index: int) -> list[FrameFile]:
        files = [read_frame(self.root, self.keys[index], self.config.subset, suffix) for suffix in self._suffixes]
        self._poses[index] = files[0].global_from_ego
        return files

    def _pose(self, index: int) -> Float[np.ndarray, "4 4"]:
        return self._poses[index] if index in self._poses else self._files(index)[0].global_from_ego

    @cached_property
    def _fits(self) -> tuple[ImageFit | None, ...]:
        """What happens to the images of each camera, by the sizes in the first frame that has the camera."""
        if self.config.image is None:
            return (None,) * len(SUBSETS[self.config.subset].cameras)
        fits: list[ImageFit | None] = [None] * len(SUBSETS[self.config.subset].cameras)
        for index in range(len(self)):
            for place, camera in enumerate(self._files(index)[0].cameras):
                if camera is not None and fits[place] is None:
                    height, width = read_image(camera.image).shape[:2]
                    fits[place] = fit_image(width, height, self.config.image, front=place == 0)
            if None not in fits:
                break
        if not any(fits):
            raise UserError(f"{self.root}: no frame of {self.name} has a camera")
        return tuple(fits)

    def _views(self, file: FrameFile) -> CameraViews:
        assert self.config.image is not None
        views = empty_views(self._fits, self.config.image)
        for place, (camera, fit) in enumerate(zip(file.cameras, self._fits, strict=True)):
            if camera is None or fit is None:
                continue
            image = read_image(camera.image)
            if image.shape[1::-1] != fit.source:
                raise UserError(
                    f"{camera.image} is {image.shape[1]} x {image.shape[0]} pixels, the first image of {camera.name} "
                    f"is {fit.source[0]} x {fit.source[1]}: restore the original file"
                )
            views.image[place, : fit.size[1], : fit.size[0]] = fit.image(image)
            views.size[place] = fit.size
            views.intrinsics[place] = fit.intrinsics(camera.intrinsics)
            views.camera_from_ego[place] = invert_pose(camera.ego_from_camera)
            views.valid[place] = True
        return views


def nominal_example(config: OpenLaneV2Config) -> Example:
    """Return an example of original image sizes in which nothing is valid: shapes without data."""
    sizes, subset = config.example, SUBSETS[config.subset]
    views = None
    if config.image is not None:
        fits = [fit_image(*size, config.image, front=place == 0) for place, size in enumerate(subset.sizes)]
        views = empty_views(fits, config.image)
    lanes = LaneGraph.empty(sizes.lanes, sizes.lane_points)
    segments = LaneGraph.empty(sizes.segments, sizes.segment_points)
    governed = segments if config.flavour == "lane_segment" else lanes
    return Example(
        bev=None,
        hidden=None,
        traffic_flow=None,
        markers=None,
        sd_map=None,
        lanes=lanes,
        segments=segments,
        areas=Areas.empty(sizes.areas, sizes.area_points),
        traffic_elements=TrafficElements.empty(sizes.elements, len(governed.valid)),
        previous_from_ego=np.eye(4, dtype=np.float32),
        has_previous=np.asarray(False),
        cameras=views,
    )


def empty_views(fits: Sequence[ImageFit | None], config: ImageConfig) -> CameraViews:
    """Return room for the images of cameras, none valid."""
    width, height = canvas_size([fit.size for fit in fits if fit is not None], config.divisor)
    count = len(fits)
    return CameraViews(
        image=np.zeros((count, height, width, 3), np.uint8),
        size=np.zeros((count, 2), np.int32),
        intrinsics=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        camera_from_ego=np.tile(np.eye(4, dtype=np.float32), (count, 1, 1)),
        valid=np.zeros(count, bool),
    )


def lane_graph(found: Annotation, capacity: int, points: int) -> tuple[LaneGraph, Int[np.ndarray, " n"]]:
    """Return the lanes of an annotation and which of them they are (the nearest, where there are more than fit)."""
    kept = _nearest(found.lines, capacity, "lanes" if found.left is None else "segments")
    graph, n = LaneGraph.empty(capacity, points), len(kept)
    if n:
        graph.points[:n] = _with_points([found.lines[i] for i in kept], points)
        graph.left[:n] = graph.points[:n] if found.left is None else _with_points([found.left[i] for i in kept], points)
        graph.right[:n] = (
            graph.points[:n] if found.right is None else _with_points([found.right[i] for i in kept], points)
        )
        graph.left_type[:n], graph.right_type[:n] = found.left_type[kept], found.right_type[kept]
        graph.is_connector[:n] = found.is_connector[kept]
        graph.visibility[:n] = 1.0
        graph.successor[:n, :n] = found.successor[np.ix_(kept, kept)]
        graph.valid[:n] = True
    return graph, kept


def area_set(found: Annotation, capacity: int, points: int) -> Areas:
    """Return the areas of an annotation."""
    kept = _nearest(found.areas, capacity, "areas")
    areas, n = Areas.empty(capacity, points), len(kept)
    if n:
        areas.points[:n] = _with_points([found.areas[i] for i in kept], points)
        areas.category[:n] = found.area_category[kept]
        areas.valid[:n] = True
    return areas


def element_set(
    found: Annotation, out: TrafficElements, lanes: Int[np.ndarray, " n"], fit: ImageFit | None
) -> TrafficElements:
    """Fill the traffic elements of an annotation into `out`; those outside what is left of the image are left out.

    Args:
        found: boxes in pixels of the file.
        out: empty.
        lanes: which of the annotated lanes are the first rows of `out.lane`.
        fit: of the front image.
    """
    boxes = found.boxes if fit is None else fit.boxes(found.boxes)
    sides = boxes[:, 1] - boxes[:, 0]
    seen = np.flatnonzero((sides > 0.0).all(-1))
    order = seen[np.argsort(-sides[seen].prod(-1), kind="stable")]  # larger in the image is nearer, as a rule
    kept = np.sort(order[: len(out.valid)])
    _warn_dropped(len(seen) - len(kept), "elements")
    n = len(kept)
    out.box[:n] = boxes[kept]
    out.category[:n], out.attribute[:n] = found.element_category[kept], found.attribute[kept]
    out.lane[: len(lanes), :n] = found.lane_element[np.ix_(lanes, kept)]
    out.valid[:n] = True
    return out


def _nearest(lines: list[np.ndarray], capacity: int, name: str) -> Int[np.ndarray, " n"]:
    """Return the indices of the `capacity` lines that come nearest to the vehicle, ascending."""
    distance = [np.linalg.norm(line[:, :2], axis=-1).min() for line in lines]
    _warn_dropped(len(lines) - capacity, name)
    return np.sort(np.argsort(distance, kind="stable")[:capacity])


def _warn_dropped(count: int, name: str) -> None:
    if count > 0:
        message = f"more {name} in a frame than ExampleConfig.{name}: the farthest are left out"
        warnings.warn(message, TruncationWarning, stacklevel=4)


def _with_points(lines: list[np.ndarray], count: int) -> Any:
    """Return lines with `count` points: as they are, every k-th of a dense line, or resampled."""
    stride = (DENSE_POINTS - 1) // (count - 1) if count > 1 and (DENSE_POINTS - 1) % (count - 1) == 0 else 0
    if stride and all(len(line) == DENSE_POINTS for line in lines):
        return np.stack([line[::stride] for line in lines])
    if all(len(line) == count for line in lines):
        return np.stack(lines)
    return resample_lines(lines, count)
