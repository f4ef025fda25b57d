"""The on-board store: marker id -> local lane graph around the marker (marker paper, section III).

A store is built from any lane graph (`store_of`), kept in a JSON file (`markers.store_files`) and queried by id
(`look_up`). An unknown id, or one whose entry is out of date, gives no prior.
"""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import invert_pose, resample_lines, transform_points
from tflane_jax.scene.logs import LaneSegment, PlacedMarkers

# Pieces of lanes that are shorter are left out, metres: they would have no length in a file.
_SHORTEST = 0.01


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
        size: side of the black square, metres; a detector needs it to know the distance (`sizes`).
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
        return max_age_days is not None and (self.surveyed is None or (today - self.surveyed).days > max_age_days)


@dataclass(frozen=True)
class MarkerStore:
    """Markers by id.

    Attributes:
        markers: the entries.
        source: origin of the entries, for messages.
    """

    markers: Mapping[int, StoredMarker]
    source: str = "marker store"

    @property
    def sizes(self) -> dict[int, float]:
        """Side of the black square of each marker by its id, metres."""
        return {number: marker.size for number, marker in self.markers.items()}


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
    entries = {}
    for number, pose in zip(markers.marker_id, markers.pose, strict=True):
        local, successor = _local_graph(lanes, pose, radius, points)
        entries[int(number)] = StoredMarker(int(number), pose, local, successor, markers.size, surveyed, expires)
    return MarkerStore(entries, source)


class _Piece(NamedTuple):
    """A piece of a lane inside the circle around a marker.

    Attributes:
        lane: id of its lane.
        points: (n, 3) global metres.
        starts, ends: whether it contains the start, and the end, of its lane.
    """

    lane: int
    points: Float[np.ndarray, "n 3"]
    starts: bool
    ends: bool


def _local_graph(
    lanes: Mapping[int, LaneSegment], pose: Float[np.ndarray, "4 4"], radius: float, points: int
) -> tuple[Float[np.ndarray, "j p 3"], Bool[np.ndarray, "j j"]]:
    """Return the pieces of the lanes around a marker, in its frame, and which of them follow which."""
    center = pose[:2, 3]
    pieces: list[_Piece] = []
    for number, lane in lanes.items():
        line = lane.centerline
        low, high = line[:, :2].min(0), line[:, :2].max(0)
        if not ((low <= center + radius).all() and (high >= center - radius).all()):
            continue
        parts = _clip_to_circle(line, center, radius)
        for i, part in enumerate(parts):
            starts = i == 0 and np.array_equal(part[0], line[0])
            ends = i == len(parts) - 1 and np.array_equal(part[-1], line[-1])
            pieces.append(_Piece(number, part, starts, ends))
    follows = np.array([[b.lane in lanes[a.lane].successors for b in pieces] for a in pieces], bool)
    starts = np.array([piece.starts for piece in pieces], bool)
    ends = np.array([piece.ends for piece in pieces], bool)
    joined = follows.reshape(len(pieces), len(pieces)) & ends[:, None] & starts
    lines = resample_lines([piece.points for piece in pieces], points)
    return transform_points(invert_pose(pose), lines.reshape(-1, 3)).reshape(lines.shape), joined


def _clip_to_circle(
    points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "2"], radius: float
) -> list[Float[np.ndarray, "k 3"]]:
    """Return the pieces of a line inside a circle of the ground plane, in order along the line."""
    a, step = points[:-1], np.diff(points, axis=0)
    away = a[:, :2] - center
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
    return [p for p in pieces if np.ptp(p[:, :2], axis=0).max() > _SHORTEST]
