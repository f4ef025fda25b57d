"""OpenLane-V2's submission: the file that its server and `tflane score` read, see `scoring.openlane_v2`.

As in the published code of TopoNet and LaneSegNet, every line is resampled at equal arc length in the ground plane,
also one that has the official number of points already: the metrics compare points with the same index. Lanes, traffic
elements and areas have different ids, as the official check demands, and the pickle opens under numpy 1.22, which the
official program needs.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.files.atomic import replacing
from tflane_jax.files.openlane import CENTERLINE, SEGMENT, FieldNames, FrameKey
from tflane_jax.geometry.polylines import resample
from tflane_jax.metrics.frames import ElementDetections, LaneDetections, Lines
from tflane_jax.metrics.segment_matching import SegmentDetections
from tflane_jax.scoring.openlane_v2 import AREA_POINTS, CENTERLINE_POINTS, LINE_POINTS

# First id of each kind.
_LANES, _ELEMENTS, _AREAS = 10_000, 20_000, 30_000
# The module of numpy's arrays in a pickle of protocol 3, as numpy 2 and as numpy 1 call it.
_NEW_NAME, _OLD_NAME = b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n"
# Attributes up to this one are states of traffic lights (category 1), the others kinds of signs (category 2).
_LAST_STATE = 3


@dataclass(frozen=True)
class Author:
    """What the server asks of a submission; empty fields are left out of the file, which is then not valid there.

    Attributes:
        method: its name.
        authors: their names.
        email, institution: of them.
        country: or region, as in ISO 3166.
        team: its name, for lane segments.
    """

    method: str = ""
    authors: tuple[str, ...] = ()
    email: str = ""
    institution: str = ""
    country: str = ""
    team: str = ""


def centerline_record(found: LaneDetections) -> dict[str, Any]:
    """Return the predictions of a frame for the centerline task; lines are resampled to 11 points."""
    return _record(found, CENTERLINE, CENTERLINE_POINTS, [{} for _ in found.points])


def segment_record(found: SegmentDetections, crossings: Literal["ring", "sides"] = "ring") -> dict[str, Any]:
    """Return the predictions of a frame for the lane-segment task; lines are resampled to 10 points, areas to 20.

    Args:
        found: detections. Without predicted types, boundaries have the type 0, none.
        crossings: form of the areas: a "ring", resampled as one line, or two "sides", resampled each, as those of
            crossings that are segments of the second class (`evaluation.lane_segments.segment_detections`).
    """
    sides = {"left": (found.left, found.left_type), "right": (found.right, found.right_type)}
    further: list[dict[str, Any]] = [{} for _ in found.lanes.points]
    for side, (lines, kinds) in sides.items():
        for i, line in enumerate(_with_points(lines, LINE_POINTS)):
            further[i] |= {f"{side}_laneline": line, f"{side}_laneline_type": 0 if kinds is None else int(kinds[i])}
    parts = 2 if crossings == "sides" else 1
    outlines = [
        np.concatenate(_with_points(np.split(np.asarray(area), parts), AREA_POINTS // parts))
        for area in found.areas.points
    ]
    areas = zip(outlines, found.areas.categories, found.areas.scores, strict=True)
    return _record(found.lanes, SEGMENT, LINE_POINTS, further) | {
        "area": [
            {"id": i, "points": points, "category": int(category), "confidence": float(score)}
            for i, (points, category, score) in enumerate(areas, _AREAS)
        ]
    }


def best_lanes(found: LaneDetections, lanes: int | None, elements: int | None) -> LaneDetections:
    """Return the lanes and the traffic elements of the highest scores, in their order, with their relations.

    Args:
        found: detections.
        lanes, elements: how many; None for all.
    """
    return _selected(found, _best(found.scores, lanes), elements)


def best_segments(found: SegmentDetections, lanes: int | None, elements: int | None) -> SegmentDetections:
    """Return the segments and the traffic elements of the highest scores like `best_lanes`, and all areas."""
    rows = _best(found.lanes.scores, lanes)
    left_type, right_type = (None if kinds is None else kinds[rows] for kinds in (found.left_type, found.right_type))
    return replace(
        found,
        lanes=_selected(found.lanes, rows, elements),
        left=[found.left[i] for i in rows],
        right=[found.right[i] for i in rows],
        left_type=left_type,
        right_type=right_type,
    )


def _best(scores: Float[np.ndarray, " n"], most: int | None) -> Int[np.ndarray, " m"]:
    """Return the numbers of the `most` highest scores, ascending; of equal ones the first."""
    return np.sort(np.argsort(-np.asarray(scores), kind="stable")[:most])


def _selected(found: LaneDetections, rows: Int[np.ndarray, " m"], elements: int | None) -> LaneDetections:
    there = found.elements
    if there is not None:
        columns = _best(there.scores, elements)
        lane = there.lane[np.ix_(rows, columns)]
        there = ElementDetections(there.boxes[columns], there.attributes[columns], there.scores[columns], lane)
    points = [found.points[i] for i in rows]
    return LaneDetections(points, found.scores[rows], found.successor[np.ix_(rows, rows)], there)


def write_submission(path: Path, records: Mapping[FrameKey, Mapping[str, Any]], author: Author) -> Path:
    """Write a submission: a pickle of plain containers, numbers and arrays.

    Raises UserError if the file cannot be written.
    """
    about = {
        "method": author.method,
        "team": author.team,
        "authors": list(author.authors),
        "e-mail": author.email,
        "institution / company": author.institution,
        "country / region": author.country,
    }
    # The official check reports what is missing and goes on, but fails for a country that is empty.
    content = {name: value for name, value in about.items() if value}
    content["results"] = {tuple(key): {"predictions": record} for key, record in records.items()}
    with replacing(path) as temporary:
        temporary.write_bytes(pickle.dumps(content, protocol=3).replace(_NEW_NAME, _OLD_NAME))
    return path


def _record(found: LaneDetections, names: FieldNames, count: int, further: Sequence[dict[str, Any]]) -> dict[str, Any]:
    lines = zip(_with_points(found.points, count), found.scores, further, strict=True)
    none = ElementDetections(np.zeros((0, 2, 2)), np.zeros(0, int), np.zeros(0), np.zeros((len(found.scores), 0)))
    elements = none if found.elements is None else found.elements
    return {
        names.lanes: [
            {"id": i, names.line: line, "confidence": float(score)} | more
            for i, (line, score, more) in enumerate(lines, _LANES)
        ],
        "traffic_element": [
            {
                "id": i,
                "category": 1 if attribute <= _LAST_STATE else 2,
                "attribute": int(attribute),
                "points": np.asarray(box, np.float32),
                "confidence": float(score),
            }
            for i, (box, attribute, score) in enumerate(
                zip(elements.boxes, elements.attributes, elements.scores, strict=True), _ELEMENTS
            )
        ],
        names.lane_lane: np.asarray(found.successor, np.float32),
        names.lane_element: np.asarray(elements.lane, np.float32),
    }


def _with_points(lines: Lines, count: int) -> list[Float[np.ndarray, "n 3"]]:
    """Return lines with the official number of points, equally spaced."""
    return [resample(np.asarray(line, float), count).astype(np.float32) for line in lines]
