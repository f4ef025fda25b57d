"""Files of OpenLane-V2, both tasks: official submissions and annotations.

Submission (a pickle): {"results": {(split, segment, timestamp): {"predictions": {...}}}}. Annotations: the devkit's
collected pickle {(split, segment, timestamp): {"annotation": {...}}}, or the dataset's folder with
`<split>/<segment>/info/<timestamp>.json`, `<timestamp>-ls.json` for lane segments. Sources:
docs/reference/data_formats.md, section 2, and docs/reference/metrics.md, section 6.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.fields import fractions, is_whole, items, load_file, member, scores, truth_values
from tflane_jax.files.folders import named_folder
from tflane_jax.files.openlane import (
    CENTERLINE,
    DENSE_POINTS,
    SEGMENT,
    FieldNames,
    FrameKey,
    as_identifier,
    read_areas,
    read_elements,
    read_labels,
    read_lines,
)
from tflane_jax.files.wording import named, shown
from tflane_jax.geometry.polylines import resample
from tflane_jax.metrics.frames import ElementDetections, ElementTruth, LaneDetections, LaneTruth
from tflane_jax.metrics.lane_segment import Flavour
from tflane_jax.metrics.segment_matching import (
    CROSSING,
    AreaDetections,
    AreaTruth,
    SegmentDetections,
    SegmentTruth,
)
from tflane_jax.progress import progress_bar
from tflane_jax.scoring.openlane_folder import annotation_files

# Published numbers use every 20th point of a centerline.
_STRIDE = 20
# Points of the lines of segments and of areas, equally spaced.
LINE_POINTS, AREA_POINTS = 10, 20
# Points of a true line: one alone has no direction, and resampling would repeat it.
_LEAST = 2
CENTERLINE_POINTS = len(range(0, DENSE_POINTS, _STRIDE))


def read_predictions(path: Path) -> dict[FrameKey, LaneDetections]:
    """Return the detections of a centerline submission; raises UserError that names file, frame and field."""
    return _submission(path, lambda record, where: _detections(record, where, CENTERLINE))


def read_truth(path: Path, *, predicted: Collection[FrameKey] = (), progress: bool = True) -> dict[FrameKey, LaneTruth]:
    """Return centerline annotations, a collected file's or a folder's; raises UserError as `read_predictions`.

    Args:
        path: the file or folder.
        predicted: frames whose truth is wanted: of a folder, their splits and subsets are read; with none, all.
        progress: show a bar.
    """
    return _annotations(
        path, CENTERLINE, lambda record, where, _: _truth(record, where, CENTERLINE), predicted, progress
    )


def read_segment_predictions(path: Path) -> dict[FrameKey, SegmentDetections]:
    """Return the detections of a lane-segment submission; raises UserError that names file, frame and field."""
    return _all_or_none(_submission(path, _segment_detections), path)


def read_segment_truth(
    path: Path, flavour: Flavour = "OpenLane-V2", *, predicted: Collection[FrameKey] = (), progress: bool = True
) -> dict[FrameKey, SegmentTruth]:
    """Return lane-segment annotations; path, predicted, progress and errors are those of `read_truth`.

    Lines are resampled to 10 points and areas to 20; of a collected file, which the devkit has resampled, those that
    have other counts. In the flavour "LaneSegNet" a crossing of five corners becomes its two long sides of 10 points
    each.
    """
    parse = partial(_segment_truth, flavour=flavour)
    return _all_or_none(_annotations(path, SEGMENT, parse, predicted, progress), path)


T = TypeVar("T")
_Parse = Callable[[Any, str], T]


def _submission(path: Path, parse: _Parse[T]) -> dict[FrameKey, T]:
    results = member(load_file(path), "results", str(path))
    if not isinstance(results, Mapping):
        raise UserError(f"{path}: results is of type {type(results).__name__}, expected a mapping from frames")
    return _by_frame(results, "predictions", path, parse)


def _annotations(
    path: Path, names: FieldNames, parse: Callable[[Any, str, bool], T], predicted: Collection[FrameKey], progress: bool
) -> dict[FrameKey, T]:
    """Return annotations; `parse` takes a record, the words that name it, and whether it is the dataset's own."""
    if os.path.isdir(path):
        files = progress_bar(
            annotation_files(named_folder(path), names, predicted, path).items(),
            desc=f"read {path.name}",
            unit="frame",
            disable=not progress,
        )
        return {key: parse(_annotation(load_file(file), file), str(file), True) for key, file in files}
    collected = load_file(path)
    if not isinstance(collected, Mapping):
        raise UserError(f"{path} is of type {type(collected).__name__}, expected a mapping from frames")
    return _by_frame(collected, "annotation", path, lambda record, where: parse(record, where, False))


def _annotation(content: Any, file: Path) -> Any:
    """Return the annotation in a frame's file; raise UserError where there is none, as in the official test split."""
    if isinstance(content, Mapping) and content.get("annotation") is None:
        raise UserError(
            f"{file} has no annotation: that of the official test split is not public. Score predictions of val, or "
            "upload these"
        )
    return member(content, "annotation", str(file))


def _by_frame(records: Mapping[Any, Any], field: str, path: Path, parse: _Parse[T]) -> dict[FrameKey, T]:
    frames = {}
    for identifier, record in records.items():
        key = as_identifier(identifier, str(path))
        where = f"{path}, frame {named(key)}"
        if key in frames:
            raise UserError(f"{where} is there twice: once with numbers in its name, once with texts")
        frames[key] = parse(member(record, field, where), where)
    return frames


def _truth(record: Any, where: str, names: FieldNames) -> LaneTruth:
    points = read_lines(record, names.lanes, names.line, where, _LEAST)
    boxes, attributes = _elements(record, where)
    _check_ids(record, (names.lanes, "traffic_element"), where)
    lane_lane, lane_element = (
        truth_values(member(record, field, where), (len(points), count), f"{where}: {field}")
        for field, count in ((names.lane_lane, len(points)), (names.lane_element, len(boxes)))
    )
    if names is CENTERLINE:  # those of segments are resampled
        points = [line[::_STRIDE] if len(line) == DENSE_POINTS else line for line in points]
    return LaneTruth(
        points=points,
        successor=lane_lane,
        visibility=_visibility(record, names.lanes, where),
        elements=ElementTruth(boxes, attributes, lane_element),
    )


def _detections(record: Any, where: str, names: FieldNames) -> LaneDetections:
    points = read_lines(record, names.lanes, names.line, where)
    boxes, attributes = _elements(record, where)
    _check_ids(record, (names.lanes, "traffic_element"), where)
    lane_lane, lane_element = (
        fractions(member(record, field, where), (len(points), count), f"{where}: {field}", largest=np.inf)
        for field, count in ((names.lane_lane, len(points)), (names.lane_element, len(boxes)))
    )
    return LaneDetections(
        points=points,
        scores=_confidences(record, names.lanes, where),
        successor=lane_lane,
        elements=ElementDetections(boxes, attributes, _confidences(record, "traffic_element", where), lane_element),
    )


def _segment_truth(record: Any, where: str, raw: bool, flavour: Flavour) -> SegmentTruth:
    def with_points(line: np.ndarray, count: int) -> np.ndarray:
        return line if len(line) == count and not raw else resample(line, count)

    lanes = _truth(record, where, SEGMENT)
    outlines, categories = read_areas(record, where, _LEAST)
    _check_ids(record, ("area",), where)
    areas = [
        _long_sides(line)
        if flavour == "LaneSegNet" and c == CROSSING and len(line) == 5
        else with_points(line, AREA_POINTS)
        for line, c in zip(outlines, categories, strict=True)
    ]
    sides = (read_lines(record, SEGMENT.lanes, f"{side}_laneline", where, _LEAST) for side in _SIDES)
    center, left, right = ([with_points(line, LINE_POINTS) for line in lines] for lines in (lanes.points, *sides))
    types = _types(record, where)
    return SegmentTruth(replace(lanes, points=center), left, right, AreaTruth(areas, categories), *types)


def _segment_detections(record: Any, where: str) -> SegmentDetections:
    left, right = (read_lines(record, SEGMENT.lanes, f"{side}_laneline", where) for side in _SIDES)
    areas = AreaDetections(*read_areas(record, where), _confidences(record, "area", where))
    _check_ids(record, ("area",), where)
    return SegmentDetections(_detections(record, where, SEGMENT), left, right, areas, *_types(record, where))


def _types(record: Any, where: str) -> list[np.ndarray | None]:
    """Return the types of the left and of the right lines; None if the file does not tell."""
    return [
        read_labels(record, SEGMENT.lanes, field, 0, 2, where)
        if _all_have(field, record, SEGMENT.lanes, where)
        else None
        for field in (f"{side}_laneline_type" for side in _SIDES)
    ]


Segments = TypeVar("Segments", SegmentDetections, SegmentTruth)


def _all_or_none(frames: dict[FrameKey, Segments], path: Path) -> dict[FrameKey, Segments]:
    """Return the frames; raise UserError if some have types of lines and others none: a part would be scored."""
    some = {key: frame for key, frame in frames.items() if len(frame.left)}
    for side in ("left", "right"):
        have = {key: getattr(frame, f"{side}_type") is not None for key, frame in some.items()}
        if any(have.values()) and not all(have.values()):
            lacks = next(key for key, has in have.items() if not has)
            raise UserError(
                f"{path}, frame {named(lacks)}: its segments have no {side}_laneline_type, which those of other frames "
                "have: add it to all, or take it out"
            )
    return frames


def _visibility(record: Any, things: str, where: str) -> np.ndarray | None:
    """Return the fraction of each lane in line of sight; None for official files, which do not tell."""
    if not _all_have("visibility", record, things, where):
        return None
    return scores([lane["visibility"] for lane in items(record, things, where)], f"{where}: {things}: visibility")


def _all_have(field: str, record: Any, things: str, where: str) -> bool:
    """Return whether the lanes have an optional entry; raises UserError if only some have."""
    have = [field in lane for lane in items(record, things, where)]
    if any(have) and not all(have):
        raise UserError(f"{where}: {things}[{have.index(False)}] lacks the entry {field!r}, which others have")
    return all(have)


def _elements(record: Any, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes and attributes of the traffic elements, with ordered corners."""
    boxes, attributes = read_elements(record, where)
    swapped = (boxes[:, 0] > boxes[:, 1]).any(-1)
    if swapped.any():
        i = int(swapped.argmax())
        raise UserError(
            f"{where}: traffic_element[{i}].points is {boxes[i].tolist()}: expected the top-left corner, then the "
            "bottom-right one (width and height in place of the second?)"
        )
    return boxes, attributes


def _check_ids(record: Any, groups: tuple[str, ...], where: str) -> None:
    """Raise UserError if two things of one list have the same id."""
    for things in groups:
        first: dict[Any, int] = {}
        for i, thing in enumerate(items(record, things, where)):
            identity = thing.get("id")
            if identity is None:
                continue
            if not (isinstance(identity, (str, bool)) or is_whole(identity)):
                raise UserError(
                    f"{where}: {things}[{i}].id is of type {type(identity).__name__}, expected a whole number or a text"
                )
            if identity in first:
                raise UserError(f"{where}: {things}[{i}] has the id of {things}[{first[identity]}], {shown(identity)}")
            first[identity] = i


_SIDES = ("left", "right")


def _long_sides(corners: np.ndarray) -> np.ndarray:
    """Return the two long sides of a crossing, as LaneSegNet's evaluation: corners 0 to 1, then corners 2 to 3."""
    return np.concatenate([resample(corners[:2], AREA_POINTS // 2), resample(corners[2:4], AREA_POINTS // 2)])


def _confidences(record: Any, things: str, where: str) -> np.ndarray:
    at = f"{where}: {things}"
    values = [member(thing, "confidence", f"{at}[{i}]") for i, thing in enumerate(items(record, things, where))]
    return scores(values, f"{at}: confidence")
