"""OpenLane-V2 annotations -> the parts of an `Example`, at fixed capacities."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from tflane_jax.datasets.areas import with_sides
from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.openlane_annotation import Annotation
from tflane_jax.datasets.openlane_frames import FrameCamera
from tflane_jax.datasets.view_images import ImageConfig, ImageFit, canvas_size
from tflane_jax.errors import UserError
from tflane_jax.files.images import read_image
from tflane_jax.files.openlane import DENSE_POINTS
from tflane_jax.geometry import invert_pose
from tflane_jax.geometry.polylines import nearest_lines, resample_lines
from tflane_jax.scene import (
    Areas,
    CameraViews,
    Example,
    LaneGraph,
    MarkerObservations,
    SdMap,
    TrafficElements,
    TrafficFlow,
)


def blank(
    config: ExampleConfig, *, governed: Literal["lanes", "segments"], views: CameraViews | None, traffic: bool
) -> Example:
    """Return an example in which nothing is valid.

    Args:
        config: capacities and points.
        governed: what traffic elements govern.
        views: of the cameras, or None.
        traffic: whether there is a traffic flow.
    """
    lanes = LaneGraph.empty(config.lanes, config.lane_points)
    segments = LaneGraph.empty(config.segments, config.segment_points)
    rows = {governed: config.segments if governed == "segments" else config.lanes}
    return Example(
        bev=None,
        hidden=None,
        traffic_flow=TrafficFlow.empty(config.tracks, config.history) if traffic else None,
        markers=None
        if config.markers is None
        else MarkerObservations.empty(config.markers.markers, config.markers.lanes, config.markers.points),
        sd_map=None if config.sd_map is None else SdMap.empty(config.sd_map.lines, config.sd_map.points),
        lanes=lanes,
        segments=segments,
        areas=Areas.empty(config.areas, config.area_points),
        traffic_elements=TrafficElements.empty(config.elements, **rows),
        previous_from_ego=np.eye(4, dtype=np.float32),
        has_previous=np.asarray(False),
        cameras=views,
    )


def empty_views(fits: Sequence[ImageFit | None], config: ImageConfig) -> CameraViews:
    """Return empty arrays for the images of the cameras; none is valid."""
    width, height = canvas_size([fit.size for fit in fits if fit is not None], config.divisor)
    count = len(fits)
    return CameraViews(
        image=np.zeros((count, height, width, 3), np.uint8),
        size=np.zeros((count, 2), np.int32),
        intrinsics=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        camera_from_ego=np.tile(np.eye(4, dtype=np.float32), (count, 1, 1)),
        valid=np.zeros(count, bool),
    )


def camera_views(
    cameras: Sequence[FrameCamera | None], fits: Sequence[ImageFit | None], config: ImageConfig
) -> CameraViews:
    """Read the images of a frame; a camera that is None, or has no fit, is not valid.

    Raises UserError for an image that cannot be read or has another size than the camera's other images.
    """
    views = empty_views(fits, config)
    for place, (camera, fit) in enumerate(zip(cameras, fits, strict=True)):
        if camera is None or fit is None:
            continue
        image = read_image(camera.image)
        if image.shape[1::-1] != fit.source:
            raise UserError(
                f"{camera.image} is {image.shape[1]} x {image.shape[0]} pixels, the first image of {camera.name} "
                f"is {fit.source[0]} x {fit.source[1]}: one of them is not the original file, restore it (`tflane data "
                "check` compares all)"
            )
        views.image[place, : fit.size[1], : fit.size[0]] = fit.image(image)
        views.size[place] = fit.size
        views.intrinsics[place] = fit.intrinsics(camera.intrinsics)
        views.camera_from_ego[place] = invert_pose(camera.ego_from_camera)
        views.valid[place] = True
    return views


def lane_graph(found: Annotation, capacity: int, points: int) -> tuple[LaneGraph, Int[np.ndarray, " n"]]:
    """Return the lanes of an annotation and their indices in it (the nearest ones, where there are more than fit)."""
    kept = _nearest(found.lines, capacity, "lanes" if found.left is None else "segments")
    graph, n = LaneGraph.empty(capacity, points), len(kept)
    if n:
        fit = _with_points if found.left is None else resample_lines  # the devkit always resamples lane segments
        for lines, out in ((found.lines, graph.points), (found.left, graph.left), (found.right, graph.right)):
            out[:n] = graph.points[:n] if lines is None else fit([lines[i] for i in kept], points)
        graph.left_type[:n], graph.right_type[:n] = found.left_type[kept], found.right_type[kept]
        graph.is_connector[:n] = found.is_connector[kept]
        graph.visibility[:n] = 1.0
        graph.successor[:n, :n] = found.successor[np.ix_(kept, kept)]
        graph.valid[:n] = True
    return graph, kept


def area_set(found: Annotation, capacity: int, points: int, crossings: Literal["ring", "sides"] = "ring") -> Areas:
    """Return the areas of an annotation; see `ExampleConfig` for the form of crossings."""
    kept = _nearest(found.areas, capacity, "areas")
    areas, n = Areas.empty(capacity, points), len(kept)
    if n:
        areas.points[:n] = resample_lines([found.areas[i] for i in kept], points)
        areas.category[:n] = found.area_category[kept]
        areas.valid[:n] = True
        if crossings == "sides":
            with_sides(areas, [found.areas[i] for i in kept])
    return areas


def element_set(
    found: Annotation, out: TrafficElements, lanes: Int[np.ndarray, " n"], fit: ImageFit | None
) -> TrafficElements:
    """Fill the traffic elements of an annotation into `out`, without those that the image's cropping removes.

    Args:
        found: annotation, with boxes in pixels of the file.
        out: empty elements, filled in place.
        lanes: indices of the annotated lanes that are the first rows of `out.lane`, or of `out.segment`.
        fit: scaling and cropping of the front image; None leaves the boxes as they are.
    """
    boxes = found.boxes if fit is None else fit.boxes(found.boxes)
    sides = boxes[:, 1] - boxes[:, 0]
    seen = np.flatnonzero((sides > 0.0).all(-1))
    order = seen[np.argsort(-sides[seen].prod(-1), kind="stable")]  # larger in the image is usually nearer
    kept = np.sort(order[: len(out.valid)])
    _warn_dropped(len(seen) - len(kept), "elements")
    n = len(kept)
    out.box[:n] = boxes[kept]
    out.category[:n], out.attribute[:n] = found.element_category[kept], found.attribute[kept]
    governs = out.segment if out.lane is None else out.lane
    assert governs is not None  # see `blank`
    governs[: len(lanes), :n] = found.lane_element[np.ix_(lanes, kept)]
    out.valid[:n] = True
    return out


def _nearest(lines: list[np.ndarray], capacity: int, name: str) -> Int[np.ndarray, " n"]:
    """Return the indices of the `capacity` lines that come nearest to the vehicle, ascending."""
    _warn_dropped(len(lines) - capacity, name)
    return nearest_lines(lines, capacity)


def _warn_dropped(count: int, name: str) -> None:
    if count > 0:
        message = f"more {name} in a frame than ExampleConfig.{name}: the farthest are left out"
        warnings.warn(message, TruncationWarning, stacklevel=4)


def _with_points(lines: list[np.ndarray], count: int) -> Any:
    """Return centerlines with `count` points: as they are, every k-th of a dense line, or resampled."""
    stride = (DENSE_POINTS - 1) // (count - 1) if count > 1 and (DENSE_POINTS - 1) % (count - 1) == 0 else 0
    if stride and all(len(line) == DENSE_POINTS for line in lines):
        return np.stack([line[::stride] for line in lines])
    if all(len(line) == count for line in lines):
        return np.stack(lines)
    return resample_lines(lines, count)
