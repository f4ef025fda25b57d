"""What a reader of a score should know about the files: unusual, but not wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from tflane_jax.files.tusimple import NO_POINT, ROWS, RowLanes
from tflane_jax.files.wording import first_of, named
from tflane_jax.metrics.frames import ElementDetections, ElementTruth, LaneDetections, LaneTruth, Lines
from tflane_jax.metrics.map_matching import MapDetections, MapTruth
from tflane_jax.metrics.segment_matching import SegmentDetections, SegmentTruth
from tflane_jax.metrics.tusimple import LSTR_TIME_LIMIT, MORE_LANES
from tflane_jax.scoring.columns import columns
from tflane_jax.scoring.lines import no_lines, swapped_sides, unusual
from tflane_jax.scoring.openlane_v2 import AREA_POINTS, CENTERLINE_POINTS, LINE_POINTS

Remarks = Callable[[Mapping[Any, Any], Mapping[Any, Any]], list[str]]
# Lines of one side that are so many times as far away as those of the other are of other units.
_OTHER_UNITS = 8.0
# Of the points of TuSimple's lanes, so many are at x = 0 if that stands for no point.
_ZEROS = 0.05


def no_remarks(predictions: Mapping[Any, Any], truth: Mapping[Any, Any]) -> list[str]:
    """Return nothing."""
    return []


def centerlines(predictions: Mapping[Any, LaneDetections], truth: Mapping[Any, LaneTruth]) -> list[str]:
    """Return remarks on centerlines and traffic elements: numbers of points and units other than the official ones."""
    return [
        *_other_counts("predicted centerlines", _lines(predictions, lambda one: one.points), CENTERLINE_POINTS),
        *_other_counts("true centerlines", _lines(truth, lambda one: one.points), CENTERLINE_POINTS),
        *units(predictions, truth),
        *_sums(predictions),
        *_boxes("predicted", [one.elements for one in predictions.values()]),
        *_boxes("true", [one.elements for one in truth.values()]),
    ]


def units(
    predictions: Mapping[Any, LaneDetections] | Mapping[Any, MapDetections],
    truth: Mapping[Any, LaneTruth] | Mapping[Any, MapTruth],
) -> list[str]:
    """Return remarks on centerlines or lines of a map: what `unusual` finds, and other units."""
    return [
        *unusual(predictions, truth),
        *_units(_lines(predictions, lambda one: one.points), _lines(truth, lambda one: one.points)),
    ]


def segments(predictions: Mapping[Any, SegmentDetections], truth: Mapping[Any, SegmentTruth]) -> list[str]:
    """Return remarks on lane segments, areas and traffic elements; true lines have been resampled."""
    parts: dict[str, Callable[[SegmentDetections], Lines]] = {
        "centerlines of predicted segments": lambda one: one.lanes.points,
        "left lines of predicted segments": lambda one: one.left,
        "right lines of predicted segments": lambda one: one.right,
    }
    counts = [_other_counts(name, _lines(predictions, of), LINE_POINTS) for name, of in parts.items()]
    areas = _other_counts("predicted areas", _lines(predictions, lambda one: one.areas.points), AREA_POINTS)
    units = _units(_lines(predictions, lambda one: one.lanes.points), _lines(truth, lambda one: one.lanes.points))
    boxes = [
        *_boxes("predicted", [one.lanes.elements for one in predictions.values()]),
        *_boxes("true", [one.lanes.elements for one in truth.values()]),
    ]
    sides = [*swapped_sides("predicted", predictions), *swapped_sides("true", truth)]
    counted = [remark for remarks in counts for remark in remarks]
    sums = _sums({key: one.lanes for key, one in predictions.items()})
    return [*unusual(predictions, truth), *sides, *counted, *areas, *units, *sums, *boxes]


def images(predictions: Mapping[Any, RowLanes], truth: Mapping[Any, RowLanes], time_limit: float) -> list[str]:
    """Return remarks on images that count as without lanes, on other rows and on other columns; the limit: ms."""
    return [
        *no_lines("predictions", (one.x[(one.x >= 0).any(-1)] for one in predictions.values())),
        *no_lines("ground truth", (one.x[(one.x >= 0).any(-1)] for one in truth.values())),
        *_at_zero("predicted", predictions),
        *_at_zero("true", truth),
        *_slow(predictions, time_limit),
        *_too_many(predictions, truth),
        *_other_rows(truth),
        *columns(predictions, truth),
    ]


def nothing_near(
    predictions: Mapping[Any, Any], truth: Mapping[Any, Any], score: float | None, frame: str
) -> list[str]:
    """Return a remark where lines are predicted, but none is near a true one.

    Args:
        predictions, truth: by frame; lanes, segments or lines of a map.
        score: one over all frames that is 0 exactly if no line is found.
        frame: axes, units and frame of the lines, or what else to look at, in words.
    """
    both = [any(len(getattr(one, "lanes", one).points) for one in side.values()) for side in (predictions, truth)]
    if score != 0.0 or not all(both):
        return []
    return [f"no predicted line is near a true one: are axes, units and frame those of the ground truth, {frame}?"]


def _at_zero(side: str, images: Mapping[Any, RowLanes]) -> list[str]:
    """Return a remark on lanes that seem to have x = 0 where they have no point."""
    points = np.concatenate([one.x[one.x >= 0.0] for one in images.values()])
    zeros = int((points == 0.0).sum())
    if zeros <= _ZEROS * len(points):
        return []
    return [
        f"{zeros} of {len(points)} points of {side} lanes are at x = 0, the image's left border: rows in which a lane "
        f"has no point are marked by {NO_POINT:g}"
    ]


def _slow(predictions: Mapping[Any, RowLanes], time_limit: float) -> list[str]:
    slow = [key for key, one in predictions.items() if one.run_time > time_limit]
    if not slow:
        return []
    lenient = f"; tusimple-lstr allows {LSTR_TIME_LIMIT / 1000:g} s" if time_limit < LSTR_TIME_LIMIT else ""
    return [
        f"{len(slow)} of {len(predictions)} images took longer than {time_limit:g} ms and count as without lanes, by "
        f"TuSimple's rule ({first_of(slow)}){lenient}"
    ]


def _too_many(predictions: Mapping[Any, RowLanes], truth: Mapping[Any, RowLanes]) -> list[str]:
    many = [key for key, one in predictions.items() if key in truth and len(one.x) > len(truth[key].x) + MORE_LANES]
    if not many:
        return []
    return [
        f"{len(many)} of {len(predictions)} images have over {MORE_LANES} lanes more than their labels and count as "
        f"without lanes, by TuSimple's rule ({first_of(many)}): leave out lanes of low confidence"
    ]


def _other_rows(truth: Mapping[Any, RowLanes]) -> list[str]:
    other = [key for key, one in truth.items() if one.rows is not None and not np.isin(one.rows, ROWS).all()]
    if not other:
        return []
    return [
        f"{len(other)} of {len(truth)} frames are labelled at other rows than TuSimple's, every 10th from "
        f"{ROWS[0]:g} to {ROWS[-1]:g} ({first_of(other)}): are h_samples shifted, or of another image size?"
    ]


def _lines(frames: Mapping[Any, Any], of: Callable[[Any], Lines]) -> dict[Any, Lines]:
    return {key: of(frame) for key, frame in frames.items()}


def _other_counts(what: str, frames: Mapping[Any, Lines], count: int) -> list[str]:
    """Return a remark on lines that have not the official number of points, which the distances presuppose."""
    total = sum(map(len, frames.values()))
    other = [
        f"frame {named(key)}, number {i}: {len(line)}"
        for key, lines in frames.items()
        for i, line in enumerate(lines)
        if len(line) != count
    ]
    if not other:
        return []
    return [
        f"{len(other)} of {total} {what} have other than the official {count} points ({first_of(other)}). Distances "
        "compare vertices, so that even the right line may not match: resample them"
    ]


def _units(predictions: Mapping[Any, Lines], truth: Mapping[Any, Lines]) -> list[str]:
    found, true = _extent(predictions.values()), _extent(truth.values())
    if found is None or true is None or 1.0 / _OTHER_UNITS <= found / true <= _OTHER_UNITS:
        return []
    return [
        f"predicted lines reach {found:.3g} from the origin, true ones {true:.3g} (median over frames): are the "
        "predictions normalised, in other units or in another frame?"
    ]


def _sums(predictions: Mapping[Any, LaneDetections]) -> list[str]:
    """Return a remark on topology above 1, which no probability is."""
    above = [
        key
        for key, one in predictions.items()
        for scores in (one.successor, None if one.elements is None else one.elements.lane)
        if scores is not None and np.max(scores, initial=0.0) > 1.0
    ]
    if not above:
        return []
    return [
        f"predicted topology exceeds 1 in {len(set(above))} of {len(predictions)} frames (frame {named(above[0])}), as "
        "sums do: its order counts, and what exceeds 0.5"
    ]


def _boxes(side: str, frames: Iterable[ElementDetections | ElementTruth | None]) -> list[str]:
    """Return a remark on traffic elements of which not one can be in the image."""
    every = [np.asarray(one.boxes, np.float64) for one in frames if one is not None and len(one.boxes)]
    if not every:
        return []
    boxes = np.concatenate(every)
    if (boxes[:, 0] >= boxes[:, 1]).any(-1).all():
        fault = "have no area"
    elif boxes.min() >= 0.0 and boxes.max() <= 1.0:
        fault = "lie between 0 and 1, as if normalised"
    elif (boxes[:, 1] <= 0.0).any(-1).all():
        fault = "lie left of the image or above it"
    else:
        return []
    return [f"all {len(boxes)} boxes of {side} traffic elements {fault}: are their corners pixels of the image?"]


def _extent(frames: Iterable[Lines]) -> float | None:
    """Return how far lines reach from the origin, median over frames that have any; None without extent."""
    reach = [max(float(np.abs(np.asarray(line)[:, :2]).max()) for line in lines) for lines in frames if len(lines)]
    extent = float(np.median(reach)) if reach else 0.0
    return extent if extent > 0.0 else None
