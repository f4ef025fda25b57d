"""The on-board store: marker id -> local lane graph around the marker (marker paper, section III).

A store is built from any lane graph (`store_of`), kept in a JSON file (`save_store`, `load_store`; docs/markers.md has
the format) and queried by id (`look_up`). An unknown id, or one whose entry is out of date, gives no prior.
"""

from __future__ import annotations

import datetime
import json
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_text
from tflane_jax.files.fields import items, load_json, member, numbers, whole_number
from tflane_jax.geometry import invert_pose, resample_lines, transform_points
from tflane_jax.scene.logs import LaneSegment, PlacedMarkers

FORMAT, VERSION = "tflane-marker-store", 1
# Length units that a file may be in, metres.
UNITS = {"metre": 1.0, "millimetre": 0.001, "foot": 0.3048}
# Decimals of a coordinate in a file: millimetres.
_DECIMALS = 3
_LARGEST_ID = 2**31 - 1


class UnknownMarkerWarning(UserWarning):
    """A detected marker is not in the store."""


class StaleMarkerWarning(UserWarning):
    """The store's entry of a detected marker is out of date."""


@dataclass(frozen=True)
class StoredMarker:
    """A marker and the lanes around it.

    Attributes:
        marker_id: encoded in the pattern.
        global_from_marker: (4, 4) float64 surveyed pose, metres. Used only to show a store on a map; on the road the
            pose comes from the detection.
        lanes: (J, P, 3) float64 centerlines in driving direction, **marker frame** (see `tflane_jax.markers`), metres.
        successor: (J, J) [i, j] true where the end of lane i is the start of lane j.
        size: side of the black square, metres.
        surveyed: day of the survey.
        expires: first day on which the entry is invalid.
    """

    marker_id: int
    global_from_marker: np.ndarray
    lanes: np.ndarray
    successor: np.ndarray
    size: float = 1.0
    surveyed: datetime.date | None = None
    expires: datetime.date | None = None

    def outdated(self, today: datetime.date, max_age_days: int | None = None) -> bool:
        """Return whether the entry has expired or is older than the limit; an unknown age exceeds any limit."""
        if self.expires is not None and today >= self.expires:
            return True
        return max_age_days is not None and (
            self.surveyed is None or today - self.surveyed > datetime.timedelta(max_age_days)
        )


@dataclass(frozen=True)
class MarkerStore:
    """Markers by id.

    Attributes:
        markers: the entries.
        source: origin of the entries, for messages.
    """

    markers: Mapping[int, StoredMarker]
    source: str = "marker store"


@dataclass(frozen=True)
class Lookup:
    """Result of a query by ids.

    Attributes:
        found: the entry of each id, None where it gives no prior.
        unknown, stale: number of ids that are not in the store, and of entries out of date.
    """

    found: tuple[StoredMarker | None, ...]
    unknown: int
    stale: int


def look_up(
    store: MarkerStore, ids: Iterable[int], *, today: datetime.date | None = None, max_age_days: int | None = None
) -> Lookup:
    """Return the entries of some ids.

    Warns (`UnknownMarkerWarning`, `StaleMarkerWarning`) with a text that depends on the store alone, so that Python's
    default filter shows it once.

    Args:
        store: to query.
        ids: of the detected markers.
        today: entries that are out of date on this day give no prior; None ignores dates.
        max_age_days: entries surveyed longer ago are out of date; needs `today`.
    """
    if max_age_days is not None and today is None:
        raise ValueError("max_age_days needs the day from which to count: give today")
    entries = [store.markers.get(int(marker)) for marker in ids]
    stale = [e is not None and today is not None and e.outdated(today, max_age_days) for e in entries]
    lookup = Lookup(
        tuple(None if old else entry for entry, old in zip(entries, stale, strict=True)),
        unknown=sum(entry is None for entry in entries),
        stale=sum(stale),
    )
    if lookup.unknown:
        warnings.warn(
            f"markers were seen that {store.source} does not hold: they give no prior; add them to the store",
            UnknownMarkerWarning,
            stacklevel=2,
        )
    if lookup.stale:
        warnings.warn(
            f"markers were seen whose entries in {store.source} are out of date: they give no prior; survey them again",
            StaleMarkerWarning,
            stacklevel=2,
        )
    return lookup


def store_of(
    lanes: Mapping[int, LaneSegment],
    markers: PlacedMarkers,
    *,
    radius: float = 50.0,
    points: int = 41,
    surveyed: datetime.date | None = None,
    expires: datetime.date | None = None,
    source: str = "marker store",
) -> MarkerStore:
    """Build a store: for each marker the lanes within a radius.

    Lanes are cut where they leave the circle and resampled (both in the ground plane); each piece
    becomes a lane. `successor` [i, j] is true if piece i contains the end of its lane, piece j the start of its lane,
    and the second lane is a successor of the first.

    Args:
        lanes: any lane graph in global metres, by id; only `centerline` and `successors` are read.
        markers: ids and poses.
        radius: of the circle around each marker, metres.
        points: on each lane, at least 2.
        surveyed, expires: written to all entries.
        source: origin of the lanes, for messages.
    """
    return MarkerStore(
        {
            int(number): StoredMarker(
                int(number), pose, *_local_graph(lanes, pose, radius, points), markers.size, surveyed, expires
            )
            for number, pose in zip(markers.marker_id, markers.pose, strict=True)
        },
        source,
    )


def _local_graph(
    lanes: Mapping[int, LaneSegment], pose: Float[np.ndarray, "4 4"], radius: float, points: int
) -> tuple[Float[np.ndarray, "j p 3"], Bool[np.ndarray, "j j"]]:
    centre, pieces = pose[:2, 3], []
    for number, lane in lanes.items():
        low, high = lane.centerline[:, :2].min(0), lane.centerline[:, :2].max(0)
        if (low <= centre + radius).all() and (high >= centre - radius).all():
            parts = _clip_to_circle(lane.centerline, centre, radius)
            pieces += [(number, part, i == 0, i == len(parts) - 1) for i, part in enumerate(parts)]
    whole = [lanes[number].centerline for number, *_ in pieces]
    ends = np.array(
        [last and np.array_equal(p[-1], line[-1]) for (_, p, _, last), line in zip(pieces, whole, strict=True)], bool
    )
    starts = np.array(
        [first and np.array_equal(p[0], line[0]) for (_, p, first, _), line in zip(pieces, whole, strict=True)], bool
    )
    follows = np.array([[b in lanes[a].successors for b, *_ in pieces] for a, *_ in pieces], bool)
    joined = follows.reshape(len(pieces), len(pieces)) & ends[:, None] & starts
    lines = resample_lines([p for _, p, *_ in pieces], points)
    return transform_points(invert_pose(pose), lines.reshape(-1, 3)).reshape(lines.shape), joined


def _clip_to_circle(
    points: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, "2"], radius: float
) -> list[Float[np.ndarray, "k 3"]]:
    """Return the pieces of a line inside a circle of the ground plane, in order along the line."""
    a, step = points[:-1], np.diff(points, axis=0)
    away = a[:, :2] - centre
    square, dot, beyond = (step[:, :2] ** 2).sum(-1), (away * step[:, :2]).sum(-1), (away**2).sum(-1) - radius**2
    # Solve |away + t step| = radius; a step of length 0 is inside if its start is.
    root = dot**2 - square * beyond
    moves = square > 0.0
    half = np.sqrt(np.maximum(root, 0.0))
    enter = np.where(moves, np.maximum((-dot - half) / np.where(moves, square, 1.0), 0.0), 0.0)
    leave = np.where(moves, np.minimum((-dot + half) / np.where(moves, square, 1.0), 1.0), 1.0)
    inside = np.where(moves, (root > 0.0) & (enter < leave), beyond <= 0.0)
    continues = inside[1:] & inside[:-1] & (leave[:-1] == 1.0) & (enter[1:] == 0.0)
    first = np.flatnonzero(inside & ~np.concatenate([[False], continues]))
    last = np.flatnonzero(inside & ~np.concatenate([continues, [False]]))
    stop = np.where((leave == 1.0)[:, None], points[1:], a + leave[:, None] * step)
    pieces = [
        np.concatenate([a[i : i + 1] + enter[i] * step[i], stop[i : j + 1]]) for i, j in zip(first, last, strict=True)
    ]
    return [p for p in pieces if (p[1:, :2] != p[:-1, :2]).any()]


def save_store(store: MarkerStore, path: Path, *, frame: Literal["marker", "survey"] = "marker") -> Path:
    """Write a store atomically; raises UserError if that fails.

    Args:
        store: what to write.
        path: a .json file, replaced where there is one.
        frame: of the lanes in the file: the marker frame, or the frame of the survey.
    """
    records = [
        {
            "id": marker.marker_id,
            "size": marker.size,
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
    body = ",\n".join(json.dumps(record, separators=(",", ":"), allow_nan=False) for record in records)
    text = json.dumps(head)[:-1] + ', "markers": [\n' + body + "\n]}\n"
    return write_text(path, text)


def _in_frame(marker: StoredMarker, frame: Literal["marker", "survey"]) -> Float[np.ndarray, "j p 3"]:
    if frame == "marker":
        return marker.lanes
    return transform_points(marker.global_from_marker, marker.lanes.reshape(-1, 3)).reshape(marker.lanes.shape)


def load_store(path: Path) -> MarkerStore:
    """Read a store and check all of it; raises one UserError that names the file, the marker and the field."""
    record, where = load_json(path), str(path)
    if member(record, "format", where) != FORMAT:
        raise UserError(f"{where}: format is {record['format']!r:.40}, expected {FORMAT!r}: this is no marker store")
    if member(record, "version", where) != VERSION:
        raise UserError(
            f"{where}: version is {record['version']!r:.40}, this program reads {VERSION}: write the store again with "
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
    if not (
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        and np.linalg.det(rotation) > 0.0
        and np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])
    ):
        raise UserError(
            f"{where}: global_from_marker is no pose: expected a rotation and a translation over the row 0 0 0 1"
        )
    size = unit * float(numbers(member(entry, "size", where), (), f"{where}: size"))
    if size <= 0.0:
        raise UserError(f"{where}: size is {size:g}, expected more than 0")
    lanes = unit * numbers(items(entry, "lanes", where), (None, None, 3), f"{where}: lanes")
    if len(lanes) and lanes.shape[1] < 2:
        raise UserError(f"{where}: lanes have {lanes.shape[1]} points, expected at least 2")
    if frame == "survey":
        lanes = transform_points(invert_pose(pose), lanes.reshape(-1, 3)).reshape(lanes.shape)
    edges = numbers(items(entry, "successors", where), (None, 2), f"{where}: successors")
    wrong = (edges != np.floor(edges)) | (edges < 0) | (edges >= len(lanes))
    if wrong.any():
        raise UserError(
            f"{where}: successors holds {edges[wrong][0]:g}, which is no lane: the marker has 0 to {len(lanes) - 1}"
        )
    successor = np.zeros((len(lanes), len(lanes)), bool)
    successor[tuple(edges.astype(int).T)] = True
    surveyed, expires = (_date(entry, name, where) for name in ("surveyed", "expires"))
    return StoredMarker(number, pose, lanes, successor, size, surveyed, expires)


def _one_of(record: Any, name: str, allowed: Sequence[str], where: str) -> str:
    value = member(record, name, where)
    if value not in allowed:
        raise UserError(f"{where}: {name} is {value!r:.40}, expected one of {', '.join(allowed)}")
    return value


def _date(entry: Any, name: str, where: str) -> datetime.date | None:
    text = entry.get(name)
    try:
        return None if text is None else datetime.date.fromisoformat(text)
    except (TypeError, ValueError):
        raise UserError(f"{where}: {name} is {text!r:.40}, expected a day such as 2025-07-11, or null") from None
