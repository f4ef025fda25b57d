"""OpenLane-V2's JSON: which frame a file describes and what an annotation holds, read with a check of every field.

Scoring reads truth and submissions with it, `datasets.openlane_v2` examples. Source: shared specs/data_formats.md
section 2.2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.errors import UserError
from tflane_jax.files.fields import items, line_points, member, numbers, whole_number

ATTRIBUTES = 13
"""Attributes of traffic elements, 0 (unknown) to 12."""
DENSE_POINTS = 201
"""Points of an annotated centerline."""


class FieldNames(NamedTuple):
    """What a task calls its fields; `suffix` ends the names of its annotation files."""

    lanes: str
    line: str
    lane_lane: str
    lane_element: str
    suffix: str


CENTERLINE = FieldNames("lane_centerline", "points", "topology_lclc", "topology_lcte", "")
SEGMENT = FieldNames("lane_segment", "centerline", "topology_lsls", "topology_lste", "-ls")


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


def read_lines(record: Any, things: str, field: str, where: str) -> list[Float[np.ndarray, "_ 3"]]:
    """Return one line of each of an annotation's lanes, segments or areas."""
    lines = []
    for i, thing in enumerate(items(record, things, where)):
        at = f"{where}: {things}[{i}]"
        lines.append(line_points(member(thing, field, at), f"{at}.{field}"))
    return lines


def read_labels(record: Any, things: str, field: str, low: int, high: int, where: str) -> Int[np.ndarray, " n"]:
    """Return a whole number of each of an annotation's lanes, segments, areas or elements."""
    labels = []
    for i, thing in enumerate(items(record, things, where)):
        at = f"{where}: {things}[{i}]"
        labels.append(whole_number(member(thing, field, at), low, high, f"{at}.{field}"))
    return np.array(labels, np.int64)


def read_matrix(record: Any, field: str, shape: tuple[int, int], where: str) -> Float[np.ndarray, "n m"]:
    """Return a topology matrix."""
    return numbers(member(record, field, where), shape, f"{where}: {field}")


def read_elements(record: Any, where: str) -> tuple[Float[np.ndarray, "e 2 2"], Int[np.ndarray, " e"]]:
    """Return boxes (top-left and bottom-right pixel corners) and attributes of the traffic elements."""
    boxes = []
    for i, element in enumerate(items(record, "traffic_element", where)):
        at = f"{where}: traffic_element[{i}]"
        boxes.append(numbers(member(element, "points", at), (2, 2), f"{at}.points"))
    attributes = read_labels(record, "traffic_element", "attribute", 0, ATTRIBUTES - 1, where)
    return np.array(boxes).reshape(-1, 2, 2), attributes


def read_areas(record: Any, where: str) -> tuple[list[Float[np.ndarray, "_ 3"]], Int[np.ndarray, " a"]]:
    """Return lines and categories of crossings and boundaries."""
    return read_lines(record, "area", "points", where), read_labels(record, "area", "category", 1, 2, where)


def as_identifier(identifier: Any, where: str) -> FrameKey:
    """Return the frame that a collected file's key names."""
    if not isinstance(identifier, tuple) or len(identifier) != 3:
        raise UserError(f"{where}: {identifier!r:.80} is no frame, expected (split, segment, timestamp)")
    return FrameKey(*map(str, identifier))
