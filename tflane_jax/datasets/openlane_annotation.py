"""The annotation of an OpenLane-V2 frame, of either flavour, as checked arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.datasets.plausible import area_between, first_twice
from tflane_jax.errors import UserError
from tflane_jax.files.fields import items, member
from tflane_jax.files.openlane import (
    SEGMENT,
    FieldNames,
    read_areas,
    read_elements,
    read_labels,
    read_lines,
    read_matrix,
)
from tflane_jax.files.wording import shown
from tflane_jax.geometry import line_lengths

# Metres of mean width below zero: boundaries that the crop has shortened may cross, swapped ones are 3 m the wrong way.
_SWAPPED = 0.5


@dataclass(frozen=True)
class Annotation:
    """Ground truth of one frame: N lanes and A areas (ego frame, metres), E traffic elements (front image, pixels).

    Attributes:
        lines: N centerlines (n, 3).
        left, right: N boundaries; None in the centerline flavour.
        left_type, right_type: (N,) `scene.LineType`.
        is_connector: (N,); false if the file has no entry.
        successor: (N, N).
        boxes: (E, 2, 2) top-left and bottom-right corners.
        element_category, attribute: (E,).
        lane_element: (N, E).
        areas: A lines (n, 3); none in the centerline flavour.
        area_category: (A,).
    """

    lines: list[Float[np.ndarray, "_ 3"]]
    left: list[Float[np.ndarray, "_ 3"]] | None
    right: list[Float[np.ndarray, "_ 3"]] | None
    left_type: Int[np.ndarray, " n"]
    right_type: Int[np.ndarray, " n"]
    is_connector: Bool[np.ndarray, " n"]
    successor: Bool[np.ndarray, "n n"]
    boxes: Float[np.ndarray, "e 2 2"]
    element_category: Int[np.ndarray, " e"]
    attribute: Int[np.ndarray, " e"]
    lane_element: Bool[np.ndarray, "n e"]
    areas: list[Float[np.ndarray, "_ 3"]]
    area_category: Int[np.ndarray, " a"]


def read_annotation(record: Any, names: FieldNames, where: str) -> Annotation:
    """Return an annotation.

    Raises:
        UserError: an entry is missing, out of range, or does not fit the numbers of lanes and elements; the message
            names it.
    """
    lines = read_lines(record, names.lanes, names.line, where)
    boxes, attribute = read_elements(record, where)
    lanes, elements = len(lines), len(boxes)
    left = right = None
    left_type = right_type = np.zeros(lanes, np.int64)
    areas, area_category = [], np.zeros(0, np.int64)
    if names is SEGMENT:
        left, right = (read_lines(record, names.lanes, f"{side}_laneline", where) for side in ("left", "right"))
        left_type, right_type = (
            read_labels(record, names.lanes, f"{side}_laneline_type", 0, 2, where) for side in ("left", "right")
        )
        areas, area_category = read_areas(record, where)
    successor = _binary(record, names.lane_lane, (lanes, lanes), where)
    _check_lanes(record, names, successor, (left, right), where)
    return Annotation(
        lines=lines,
        left=left,
        right=right,
        left_type=left_type,
        right_type=right_type,
        is_connector=_flags(record, names.lanes, "is_intersection_or_connector", where),
        successor=successor,
        boxes=boxes,
        element_category=read_labels(record, "traffic_element", "category", 1, 2, where),
        attribute=attribute,
        lane_element=_binary(record, names.lane_element, (lanes, elements), where),
        areas=areas,
        area_category=area_category,
    )


def _check_lanes(
    record: Any,
    names: FieldNames,
    successor: Bool[np.ndarray, "n n"],
    sides: tuple[list[Float[np.ndarray, "_ 3"]] | None, list[Float[np.ndarray, "_ 3"]] | None],
    where: str,
) -> None:
    """Raise UserError for lanes that cannot be true: an id twice, a lane that follows itself, boundaries swapped."""
    known = [lane["id"] for lane in items(record, names.lanes, where) if "id" in lane]
    if (twice := first_twice([str(name) for name in known])) is not None:
        raise UserError(f"{where}: two of {names.lanes} have the id {shown(twice)}: restore the file")
    if (own := np.flatnonzero(np.diagonal(successor))).size:
        raise UserError(f"{where}: {names.lane_lane}: {names.lanes}[{own[0]}] is its own successor: restore the file")
    for i, (left, right) in enumerate(zip(*(side or [] for side in sides), strict=True)):
        length = sum(float(line_lengths(line)) for line in (left, right)) / 2
        if area_between(left, right) < -_SWAPPED * length:
            raise UserError(
                f"{where}: {names.lanes}[{i}]: the left boundary is to the right of the right one, in driving direction"
            )


def _flags(record: Any, things: str, field: str, where: str) -> Bool[np.ndarray, " n"]:
    """Return a truth value of each lane, False for lanes without the entry."""
    values = [lane.get(field, False) for lane in items(record, things, where)]
    for i, value in enumerate(values):
        if not isinstance(value, (bool, np.bool_)) and not (isinstance(value, int) and value in (0, 1)):
            raise UserError(f"{where}: {things}[{i}].{field} is {shown(value)}, expected true or false")
    return np.array(values, bool)


def lane_ids(record: Any, names: FieldNames, where: str) -> list[str]:
    """Return the ids of the lanes of an annotation; they are constant over a segment.

    Raises UserError for a lane without one.
    """
    lanes = items(record, names.lanes, where)
    return [str(member(lane, "id", f"{where}: {names.lanes}[{i}]")) for i, lane in enumerate(lanes)]


def _binary(record: Any, field: str, shape: tuple[int, int], where: str) -> Bool[np.ndarray, "n m"]:
    matrix = read_matrix(record, field, shape, where)
    if not np.isin(matrix, (0, 1)).all():
        raise UserError(f"{where}: {field} holds {matrix[~np.isin(matrix, (0, 1))][0]:g}, expected 0 and 1 only")
    return matrix == 1
