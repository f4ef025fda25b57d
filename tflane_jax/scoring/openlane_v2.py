"""Files of the OpenLane-V2 centerline task: official submissions and annotations.

Submission (a pickle): {"results": {(split, segment, timestamp): {"predictions": {"lane_centerline", "traffic_element",
"topology_lclc", "topology_lcte"}}}}. Annotations: the devkit's collected pickle {(split, segment, timestamp):
{"annotation": {...}}}, or the dataset's folder with `<split>/<segment>/info/<timestamp>.json`. Source: shared
specs/data_formats.md section 2.2, specs/metrics.md section 6.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from tflane_jax.errors import UserError
from tflane_jax.fields import items, load_file, load_json, member, numbers, scores, whole_number
from tflane_jax.metrics.centerline_matching import ATTRIBUTES
from tflane_jax.metrics.frames import ElementDetections, ElementTruth, LaneDetections, LaneTruth

# Annotated centerlines have 201 points; the published numbers are measured on every 20th.
_DENSE, _STRIDE = 201, 20


class FrameKey(NamedTuple):
    """Which frame: OpenLane-V2's identifier."""

    split: str
    segment: str
    timestamp: str

    def __str__(self) -> str:
        return "/".join(self)

    @property
    def scene(self) -> str:
        """The drive that the frame comes from."""
        return f"{self.split}/{self.segment}"


def read_predictions(path: Path) -> dict[FrameKey, LaneDetections]:
    """Return the detections of a submission; raises UserError that names file, frame and field."""
    results = member(load_file(path), "results", str(path))
    if not isinstance(results, Mapping):
        raise UserError(f"{path}: results is of type {type(results).__name__}, expected a mapping from frames")
    frames = {}
    for identifier, record in results.items():
        key = _key(identifier, path)
        frames[key] = _detections(member(record, "predictions", f"{path}, frame {key}"), f"{path}, frame {key}")
    return frames


def read_truth(path: Path, *, progress: bool = True) -> dict[FrameKey, LaneTruth]:
    """Return the annotations of a collected file or of a folder; raises UserError that names file, frame and field."""
    if path.is_dir():
        files = sorted(p for p in path.resolve().glob("**/info/*.json") if not p.stem.endswith("-ls"))
        if not files:
            raise UserError(f"{path} holds no annotations: expected <split>/<segment>/info/<timestamp>.json in it")
        frames = {}
        for file in tqdm(files, desc=f"read {path.name}", unit="frame", disable=not progress):
            segment = file.parent.parent
            key = FrameKey(segment.parent.name, segment.name, file.stem)
            frames[key] = _truth(member(load_json(file), "annotation", str(file)), str(file))
        return frames
    collected = load_file(path)
    if not isinstance(collected, Mapping):
        raise UserError(f"{path} is of type {type(collected).__name__}, expected a mapping from frames to annotations")
    frames = {}
    for identifier, record in collected.items():
        key = _key(identifier, path)
        frames[key] = _truth(member(record, "annotation", f"{path}, frame {key}"), f"{path}, frame {key}")
    return frames


def _key(identifier: Any, path: Path) -> FrameKey:
    if not isinstance(identifier, tuple) or len(identifier) != 3:
        raise UserError(f"{path}: {identifier!r:.80} is no frame, expected (split, segment, timestamp)")
    return FrameKey(*map(str, identifier))


def _truth(record: Any, where: str) -> LaneTruth:
    lanes, elements = items(record, "lane_centerline", where), items(record, "traffic_element", where)
    g, t = len(lanes), len(elements)
    points = [_line(lane, f"{where}: lane_centerline[{i}]") for i, lane in enumerate(lanes)]
    boxes, attributes = _elements(elements, where)
    return LaneTruth(
        points=[line[::_STRIDE] if len(line) == _DENSE else line for line in points],
        successor=numbers(member(record, "topology_lclc", where), (g, g), f"{where}: topology_lclc") > 0.5,
        elements=ElementTruth(
            boxes, attributes, numbers(member(record, "topology_lcte", where), (g, t), f"{where}: topology_lcte") > 0.5
        ),
    )


def _detections(record: Any, where: str) -> LaneDetections:
    lanes, elements = items(record, "lane_centerline", where), items(record, "traffic_element", where)
    p, u = len(lanes), len(elements)
    boxes, attributes = _elements(elements, where)
    return LaneDetections(
        points=[_line(lane, f"{where}: lane_centerline[{i}]") for i, lane in enumerate(lanes)],
        scores=_confidences(lanes, f"{where}: lane_centerline"),
        successor=numbers(member(record, "topology_lclc", where), (p, p), f"{where}: topology_lclc"),
        elements=ElementDetections(
            boxes,
            attributes,
            _confidences(elements, f"{where}: traffic_element"),
            numbers(member(record, "topology_lcte", where), (p, u), f"{where}: topology_lcte"),
        ),
    )


def _line(lane: Any, where: str) -> np.ndarray:
    points = numbers(member(lane, "points", where), (None, 3), f"{where}.points")
    if len(points) == 0:
        raise UserError(f"{where}.points is empty: a line has at least one point")
    return points


def _confidences(things: Any, where: str) -> np.ndarray:
    return scores([member(x, "confidence", f"{where}[{i}]") for i, x in enumerate(things)], f"{where}: confidence")


def _elements(elements: Any, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes (T, 2, 2) and attributes (T,)."""
    boxes, attributes = [], []
    for i, element in enumerate(elements):
        at = f"{where}: traffic_element[{i}]"
        boxes.append(numbers(member(element, "points", at), (2, 2), f"{at}.points"))
        attributes.append(whole_number(member(element, "attribute", at), 0, ATTRIBUTES - 1, f"{at}.attribute"))
    return np.array(boxes).reshape(-1, 2, 2), np.array(attributes, np.int64)
