"""The on-board store as a JSON file; docs/markers.md has the format.

A file may come from anywhere: whatever it holds, reading it gives a store or one UserError.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_text
from tflane_jax.files.fields import items, member, numbers, parse_json, read_text, whole_number
from tflane_jax.files.wording import shown
from tflane_jax.geometry import invert_pose, transform_points
from tflane_jax.markers.store import MarkerStore, StoredMarker
from tflane_jax.scene.marker_patterns import BOARD_SIZES

FORMAT, VERSION = "tflane-marker-store", 1
# Length units that a file may be in, metres.
UNITS = {"metre": 1.0, "millimetre": 0.001, "foot": 0.3048}
# Decimals of a coordinate in a file: millimetres.
_DECIMALS = 3
_LARGEST_ID = 2**31 - 1
# Lanes of a marker; their successors take memory of its square. In range of a marker are at most a few dozen.
_MOST_LANES = 1000
# Limits of lengths, metres: coordinates of a map, distance of a lane from its marker.
_MAP, _LANES = 1e8, 1e5
# Shortest lane, metres: half of what a file's decimals can tell.
_SHORTEST = 0.0005


def save_store(store: MarkerStore, path: Path, *, frame: Literal["marker", "survey"] = "marker") -> Path:
    """Write a store atomically.

    Args:
        store: what to write.
        path: a .json file, replaced where there is one.
        frame: of the lanes in the file: the marker frame, or the frame of the survey.

    Raises:
        UserError: `load_store` would refuse the file, which is not written then, or writing fails.
    """
    for number, marker in store.markers.items():
        if number != marker.marker_id:
            raise UserError(f"marker {marker.marker_id} stands under the id {number} in the store")
    records: list[dict[str, Any]] = [
        {
            "id": int(marker.marker_id),
            "size": float(marker.size),
            "global_from_marker": marker.global_from_marker.tolist(),
            "surveyed": marker.surveyed and marker.surveyed.isoformat(),
            "expires": marker.expires and marker.expires.isoformat(),
            "lanes": _in_frame(marker, frame).round(_DECIMALS).tolist(),
            "successors": np.argwhere(marker.successor).tolist(),
        }
        for _, marker in sorted(store.markers.items())
    ]
    head = {"format": FORMAT, "version": VERSION, "unit": "metre", "frame": frame, "source": store.source}
    # One line for each marker, so that two versions of a store can be compared as text.
    body = ",\n".join(json.dumps(record, separators=(",", ":")) for record in records)
    text = json.dumps(head)[:-1] + ', "markers": [\n' + body + "\n]}\n"
    _store_of(parse_json(text, str(path), once=True), str(path))
    return write_text(path, text)


def _in_frame(marker: StoredMarker, frame: Literal["marker", "survey"]) -> Float[np.ndarray, "j p 3"]:
    if frame == "marker":
        return marker.lanes
    return transform_points(marker.global_from_marker, marker.lanes.reshape(-1, 3)).reshape(marker.lanes.shape)


def load_store(path: Path | str) -> MarkerStore:
    """Read a store and check all of it; raises one UserError that names the file, the marker and the field."""
    return _store_of(parse_json(read_text(Path(path)), str(path), once=True), str(path))


def _store_of(record: Any, where: str) -> MarkerStore:
    """Return the store of a file's content; raises UserError as `load_store`."""
    if member(record, "format", where) != FORMAT:
        raise UserError(f"{where}: format is {shown(record['format'])}, expected {FORMAT!r}: this is no marker store")
    version = member(record, "version", where)
    if isinstance(version, bool) or version != VERSION:
        raise UserError(
            f"{where}: version is {shown(version)}, this program reads {VERSION}: write the store again with "
            "tflane markers store, or install the program that wrote it"
        )
    unit = _one_of(record, "unit", tuple(UNITS), where)
    frame = _one_of(record, "frame", ("marker", "survey"), where)
    markers: dict[int, StoredMarker] = {}
    for i, entry in enumerate(items(record, "markers", where)):
        place = f"{where}: markers[{i}]"
        number = whole_number(member(entry, "id", place), 0, _LARGEST_ID, f"{place}: id")
        if number in markers:
            raise UserError(f"{where}: marker {number}: id occurs twice; a store holds a marker once")
        markers[number] = _read_marker(entry, number, UNITS[unit], frame, f"{where}: marker {number}")
    return MarkerStore(markers, where)


def _read_marker(entry: Any, number: int, unit: float, frame: str, where: str) -> StoredMarker:
    pose = numbers(member(entry, "global_from_marker", where), (4, 4), f"{where}: global_from_marker")
    pose = pose * np.array([[1.0, 1.0, 1.0, unit]] * 3 + [[1.0] * 4])
    rotation = pose[:3, :3]
    _within(pose[:3, 3], _MAP, f"{where}: global_from_marker")
    if not (
        np.abs(rotation).max() < 2.0
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        and np.linalg.det(rotation) > 0.0
        and np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])
    ):
        raise UserError(
            f"{where}: global_from_marker is no pose: expected a rotation and a translation over the row 0 0 0 1"
        )
    side = member(entry, "size", where)
    if isinstance(side, bool):
        raise UserError(f"{where}: size is {side}, expected a number")
    size = unit * float(numbers(side, (), f"{where}: size"))
    listed = items(entry, "lanes", where)
    _check_sizes(where, size, len(listed))
    lanes = unit * numbers(listed, (None, None, 3), f"{where}: lanes")
    _within(lanes, _MAP if frame == "survey" else _LANES, f"{where}: lanes")
    if len(lanes) and lanes.shape[1] < 2:
        raise UserError(f"{where}: lanes have {lanes.shape[1]} points, expected at least 2")
    empty = np.flatnonzero(np.linalg.norm(np.diff(lanes, axis=1), axis=-1).sum(-1) < _SHORTEST)
    if len(empty):
        raise UserError(f"{where}: lanes[{empty[0]}] has no length, all its points are one: leave the lane out")
    if frame == "survey":
        lanes = transform_points(invert_pose(pose), lanes.reshape(-1, 3)).reshape(lanes.shape)
        _within(lanes, _LANES, f"{where}: lanes")
    edges = numbers(items(entry, "successors", where), (None, 2), f"{where}: successors")
    wrong = (edges != np.floor(edges)) | (edges < 0) | (edges >= len(lanes))
    if wrong.any():
        raise UserError(
            f"{where}: successors holds {edges[wrong][0]:g}, which is no lane: the marker has 0 to {len(lanes) - 1}"
        )
    successor = np.zeros((len(lanes), len(lanes)), bool)
    successor[tuple(edges.astype(int).T)] = True
    surveyed, expires = (_date(entry, name, where) for name in ("surveyed", "expires"))
    if surveyed and expires and expires <= surveyed:
        raise UserError(f"{where}: expires is {expires}, which must be after surveyed, {surveyed}")
    return StoredMarker(number, pose, lanes, successor, size, surveyed, expires)


def _check_sizes(where: str, size: float, lanes: int) -> None:
    if not BOARD_SIZES[0] <= size <= BOARD_SIZES[1]:
        raise UserError(f"{where}: size is {size:g} m, expected {BOARD_SIZES[0]:g} to {BOARD_SIZES[1]:g} m")
    if lanes > _MOST_LANES:
        raise UserError(f"{where} has {lanes} lanes, expected at most {_MOST_LANES}: take those of a smaller radius")


def _one_of(record: Any, name: str, allowed: Sequence[str], where: str) -> str:
    value = member(record, name, where)
    if value not in allowed:
        raise UserError(f"{where}: {name} is {shown(value)}, expected one of {', '.join(allowed)}")
    return value


def _within(lengths: Float[np.ndarray, "*n"], limit: float, where: str) -> None:
    """Raise UserError for a coordinate beyond a limit, metres."""
    if lengths.size and np.abs(lengths).max() > limit:
        raise UserError(f"{where} holds {lengths.flat[np.abs(lengths).argmax()]:g} m, expected at most {limit:g} m")


def _date(entry: Any, name: str, where: str) -> datetime.date | None:
    text = entry.get(name)
    try:
        return None if text is None else datetime.date.fromisoformat(text)
    except (TypeError, ValueError):
        raise UserError(f"{where}: {name} is {shown(text)}, expected a day such as 2025-07-11, or null") from None
