"""OpenLane-V2's JSON: the frame that a file describes and the content of its annotation, every field checked.

`scoring` reads annotations and submissions with it, `datasets.openlane_v2` examples. Format:
docs/reference/data_formats.md, section 2.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.errors import UserError
from tflane_jax.files.fields import is_name, items, line_points, member, numbers, whole_number
from tflane_jax.files.wording import shown

ATTRIBUTES = 13
"""Attributes of traffic elements, 0 (unknown) to 12."""
DENSE_POINTS = 201
"""Points of an annotated centerline."""
DATA_DICT = "data_dict_subset_"
"""With A.json and B.json: the split files of the two subsets, which may share a folder."""
_WIDEST = 1e5
"""Largest coordinate of a box, pixels."""


class FieldNames(NamedTuple):
    """Names of the fields of a task; `suffix` ends the names of its annotation files."""

    lanes: str
    line: str
    lane_lane: str
    lane_element: str
    suffix: str


CENTERLINE = FieldNames("lane_centerline", "points", "topology_lclc", "topology_lcte", "")
SEGMENT = FieldNames("lane_segment", "centerline", "topology_lsls", "topology_lste", "-ls")


class FrameKey(NamedTuple):
    """OpenLane-V2's identifier of a frame."""

    split: str
    segment: str
    timestamp: str

    def __str__(self) -> str:
        return "/".join(self)

    @property
    def scene(self) -> str:
        """The drive to which the frame belongs."""
        return f"{self.split}/{self.segment}"


def info_files(folder: Path, above: tuple[str, ...] = ()) -> Iterator[Path]:
    """Yield the frames' files, `.../info/*.json`, at any depth below a folder; links are followed, as `**` does not.

    Args:
        folder: where to look, not in folders of images.
        above: real paths of the folders that were passed on the way, to none of which a link may lead back.
    """
    if folder.name == "info":
        yield from folder.glob("*.json")
    try:
        real = os.path.realpath(folder)
        with os.scandir(folder) as entries:
            below = sorted(entry.name for entry in entries if entry.name != "image" and entry.is_dir())
    except OSError:  # it may not be read, or is gone
        return
    if real not in above:
        for name in below:
            yield from info_files(folder / name, (*above, real))


def frames_of(content: Any, split: str, where: str) -> list[FrameKey]:
    """Return the frames of a split that a split file names, in its order; raises UserError where it is malformed."""
    segments = member(content, split, where)
    if not isinstance(segments, Mapping):
        raise UserError(f"{where}: {split} is of type {type(segments).__name__}, expected a mapping from segments")
    return [
        FrameKey(split, str(segment), str(name).removesuffix(".json"))
        for segment in segments
        for name in items(segments, segment, f"{where}: {split}")
    ]


def read_lines(record: Any, things: str, field: str, where: str, least: int = 1) -> list[Float[np.ndarray, "_ 3"]]:
    """Return one line (n, 3), metres, n of at least `least`, of each lane, segment or area of an annotation."""
    lines = []
    for i, thing in enumerate(items(record, things, where)):
        at = f"{where}: {things}[{i}]"
        lines.append(line_points(member(thing, field, at), f"{at}.{field}", least))
    return lines


def read_labels(record: Any, things: str, field: str, low: int, high: int, where: str) -> Int[np.ndarray, " n"]:
    """Return one whole number, `low` to `high`, of each lane, segment, area or element of an annotation."""
    labels = []
    for i, thing in enumerate(items(record, things, where)):
        at = f"{where}: {things}[{i}]"
        labels.append(whole_number(member(thing, field, at), low, high, f"{at}.{field}"))
    return np.array(labels, np.int64)


def read_matrix(record: Any, field: str, shape: tuple[int, int], where: str) -> Float[np.ndarray, "n m"]:
    """Return a topology matrix of the given shape; truth values become 0 and 1."""
    value = member(record, field, where)
    if isinstance(value, np.ndarray) and value.dtype == bool:
        value = value.astype(np.int64)
    return numbers(value, shape, f"{where}: {field}")


def read_elements(record: Any, where: str) -> tuple[Float[np.ndarray, "e 2 2"], Int[np.ndarray, " e"]]:
    """Return boxes (top-left and bottom-right pixel corners) and attributes of the traffic elements."""
    boxes = []
    for i, element in enumerate(items(record, "traffic_element", where)):
        at = f"{where}: traffic_element[{i}]"
        boxes.append(numbers(member(element, "points", at), (2, 2), f"{at}.points", largest=_WIDEST))
    attributes = read_labels(record, "traffic_element", "attribute", 0, ATTRIBUTES - 1, where)
    return np.array(boxes).reshape(-1, 2, 2), attributes


def read_areas(record: Any, where: str, least: int = 1) -> tuple[list[Float[np.ndarray, "_ 3"]], Int[np.ndarray, " a"]]:
    """Return lines, of at least `least` points, and categories (1 crossing, 2 boundary) of the areas."""
    return read_lines(record, "area", "points", where, least), read_labels(record, "area", "category", 1, 2, where)


def as_identifier(identifier: Any, where: str) -> FrameKey:
    """Return a key of a collected file as a frame; raises UserError if it is none."""
    named = isinstance(identifier, tuple) and len(identifier) == 3
    # A frame's name is its parts with "/" between them.
    if not named or not all(is_name(part) and "/" not in str(part) for part in identifier):
        expected = "expected (split, segment, timestamp) as texts or numbers, without '/' in them"
        raise UserError(f"{where}: the key {shown(identifier)} is no frame, {expected}")
    return FrameKey(*map(str, identifier))
