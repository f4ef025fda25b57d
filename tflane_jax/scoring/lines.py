"""Warnings about lines of a submission or the truth: none, zero length, duplicates, swapped sides."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from tflane_jax.files.wording import first_of, named
from tflane_jax.metrics.frames import ElementTruth, LaneTruth, Lines
from tflane_jax.metrics.segment_matching import SegmentDetections, SegmentTruth

# Of the lines on the left of a segment, so many lie on its right, or the other way round, if the sides are swapped.
_SWAPPED = 0.9

_Place = tuple[Any, str, int]
"""A frame, what is meant in it, and which one of these."""


def unusual(predictions: Mapping[Any, Any], truth: Mapping[Any, Any]) -> list[str]:
    """Return remarks on lines that make a score meaningless; frames hold lanes, segments or lines of a map.

    They are: no lines at all, lines without length, true lines that are there twice.
    """
    return [
        *no_lines("predictions", map(_lines_of, predictions.values())),
        *no_lines("ground truth", map(_lines_of, truth.values())),
        *_without_length("predicted", predictions),
        *_without_length("true", truth),
        *_twice(truth),
    ]


def no_lines(side: str, frames: Iterable[Lines]) -> list[str]:
    """Return a remark where not one frame has a line; `side` is "predictions" or "ground truth"."""
    if any(len(lines) for lines in frames):
        return []
    return [f"no frame of the {side} has a line: is this the right file?"]


def swapped_sides(side: str, frames: Mapping[Any, SegmentDetections] | Mapping[Any, SegmentTruth]) -> list[str]:
    """Return a remark where the left lines of segments lie on the right of the centerlines, seen along these."""
    wrong = [
        _left_of(center, left) < 0.0 < _left_of(center, right)
        for one in frames.values()
        for center, left, right in zip(one.lanes.points, one.left, one.right, strict=True)
    ]
    if not wrong or np.mean(wrong) < _SWAPPED:
        return []
    return [
        f"in {sum(wrong)} of {len(wrong)} {side} segments left_laneline is on the right of the centerline and "
        "right_laneline on its left: are they swapped, or is y to the right?"
    ]


def _left_of(center: np.ndarray, line: np.ndarray) -> float:
    """Return a number that is positive where a line lies on the left of a centerline, seen along it."""
    ahead = (center[-1] - center[0])[:2]
    aside = (np.mean(line, 0) - np.mean(center, 0))[:2]
    return float(ahead[0] * aside[1] - ahead[1] * aside[0])


def _lines_of(frame: Any) -> Lines:
    return getattr(frame, "lanes", frame).points


def _groups(frame: Any) -> dict[str, Lines]:
    """Return what a frame has of lines, by name."""
    groups = {"line": _lines_of(frame)}
    if isinstance(frame, (SegmentDetections, SegmentTruth)):
        groups |= {"left line": frame.left, "right line": frame.right, "area": frame.areas.points}
    return groups


def _without_length(side: str, frames: Mapping[Any, Any]) -> list[str]:
    points = [
        (key, name, i)
        for key, frame in frames.items()
        for name, lines in _groups(frame).items()
        for i, line in enumerate(lines)
        if (line == line[0]).all()
    ]
    return [f"{len(points)} {side} lines have no length, {_places(points)}: all points are the same"] if points else []


def _twice(truth: Mapping[Any, Any]) -> list[str]:
    """Return a remark on true lines, areas and traffic elements of which one detection can find only one."""
    again: list[_Place] = []
    for key, frame in truth.items():
        for name, things in _identities(frame):
            seen = set()
            for i, thing in enumerate(things):
                if thing in seen:
                    again.append((key, name, i))
                seen.add(thing)
    if not again:
        return []
    return [f"{len(again)} true lines or things are there twice, {_places(again)}: a prediction finds only one of them"]


def _identities(frame: Any) -> Iterator[tuple[str, list[Any]]]:
    """Return what must not be the same in one frame; maps are exempt, whose readers refuse what is there twice."""
    lanes = getattr(frame, "lanes", frame)
    if not isinstance(lanes, LaneTruth):
        return
    yield "line", [np.asarray(line).tobytes() for line in lanes.points]
    if isinstance(frame, SegmentTruth):
        areas = zip(frame.areas.points, frame.areas.categories, strict=True)
        yield "area", [(np.asarray(line).tobytes(), int(category)) for line, category in areas]
    if isinstance(lanes.elements, ElementTruth):
        elements = zip(lanes.elements.boxes, lanes.elements.attributes, strict=True)
        yield "traffic element", [(np.asarray(box).tobytes(), int(attribute)) for box, attribute in elements]


def _places(places: list[_Place]) -> str:
    return first_of([f"frame {named(key)}, {name} {i}" for key, name, i in places])
