"""From detected markers to the marker prior: lanes of the store in the ego frame (marker paper, section III).

Used for detections in images (`markers.detection`) and for simulated ones (`markers.simulation`).
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, clip_to_range, nearest_lines, resample_lines, transform_points
from tflane_jax.markers.store import MarkerStore, StoredMarker, look_up
from tflane_jax.scene import MarkerObservations

Outcome = Literal["used", "unknown", "stale", "contradictory", "dropped", "no lanes"]
"""What became of a detected marker: it gives a prior; its id is not in the store; its entry is out of date; its id was
read at two places; there were too many nearer ones; its entry has no lanes."""


class Detected(Protocol):
    """Markers detected at one moment; satisfied by `MarkerObservations` too.

    A row that `contradictory` marks, where there is such a column, gives no prior (see `DetectedMarkers`).

    Attributes:
        marker_id: (D,) identity.
        pose: (D, 4, 4) ego_from_marker, metres.
        score: (D,) detection score, 0 to 1.
        valid: (D,).
    """

    @property
    def marker_id(self) -> Any: ...
    @property
    def pose(self) -> Any: ...
    @property
    def score(self) -> Any: ...
    @property
    def valid(self) -> Any: ...


@dataclass(frozen=True)
class Observed:
    """The marker prior, and counts of what was dropped.

    Attributes:
        markers: the prior.
        unknown, stale, contradictory: number of detected ids that are not in the store, whose entry is out of date,
            and that were read at two places.
        markers_dropped: markers beyond the capacity (the farthest).
        lanes_dropped: lanes beyond the capacity (of each marker, the farthest from it).
        outcomes: by detected id.
    """

    markers: MarkerObservations
    unknown: int
    stale: int
    markers_dropped: int
    lanes_dropped: int
    contradictory: int
    outcomes: Mapping[int, Outcome]


def observe(
    detected: Detected,
    store: MarkerStore,
    range_: PerceptionRange,
    *,
    markers: int,
    lanes: int,
    points: int,
    previous: Detected | None = None,
    now_from_previous: Float[np.ndarray, "4 4"] | None = None,
    first_residual: float = 0.0,
    today: datetime.date | None = None,
    max_age_days: int | None = None,
) -> Observed:
    """Return the stored lanes of the detected markers, moved into the ego frame by the detected poses.

    Markers are ordered by distance, those without lanes in the store last; an id detected several times counts once,
    with its best score. Lanes are cut at the perception range, as in the ground truth; each piece becomes a lane. A
    marker without lanes in the range is kept, without lanes.

    `residual` is r of Eq. (2) of the paper: the mean distance in the ground plane between the marker's stored lane
    points placed by this detection and by the previous one, after compensating the vehicle's motion. A marker without
    lanes uses its own position. If the id was at several places before, which of them was right is not known: the
    largest distance counts.

    Args:
        detected: at this moment; padding may hold anything.
        store: lanes by id. Warns about unknown and stale ids, see `look_up`.
        range_: in the ego frame.
        markers, lanes, points: M, J and P of the result: capacities, and points on each lane (at least 2).
        previous: detections of an earlier moment, in its own ego frame; None without one.
        now_from_previous: pose of that ego frame in this one; needed with `previous`.
        first_residual: residual of a marker that is not in `previous`, metres.
        today, max_age_days: see `look_up`; None ignores dates.

    Raises UserError for a pose that is not finite.
    """
    if previous is not None and now_from_previous is None:
        raise ValueError("previous detections need the vehicle's motion since: give now_from_previous")
    rows = _best(detected)
    ids = np.asarray(detected.marker_id)
    outcomes: dict[int, Outcome] = {int(ids[row]): "contradictory" for row in rows if _contradictory(detected)[row]}
    rows = np.array([row for row in rows if int(ids[row]) not in outcomes], int)
    contradictory = len(outcomes)
    looked = look_up(store, ids[rows], today=today, max_age_days=max_age_days)
    for row, entry in zip(rows, looked.found, strict=True):
        number = int(ids[row])
        outcomes[number] = "stale" if number in store.markers else "unknown"
        if entry is not None:
            outcomes[number] = "used" if len(entry.lanes) else "no lanes"
    known = [(row, entry) for row, entry in zip(rows, looked.found, strict=True) if entry is not None]
    poses = {int(row): np.asarray(detected.pose[row], np.float64) for row, _ in known}
    if wrong := [row for row, pose in poses.items() if not np.isfinite(pose).all()]:
        raise UserError(f"the detected pose of marker {int(ids[wrong[0]])} is not finite: mark such a row invalid")
    known.sort(key=lambda pair: (not len(pair[1].lanes), np.hypot(*poses[int(pair[0])][:2, 3])))

    out, lanes_dropped = MarkerObservations.empty(markers, lanes, points), 0
    for slot, (row, entry) in enumerate(known[:markers]):
        pose = poses[int(row)]
        before = [] if previous is None else _poses_of(previous, entry.marker_id)
        out.marker_id[slot], out.pose[slot], out.score[slot] = entry.marker_id, pose, detected.score[row]
        out.residual[slot] = (
            first_residual
            if not before or now_from_previous is None
            else max(pose_residual(entry, pose, now_from_previous @ each) for each in before)
        )
        out.valid[slot] = True
        lanes_dropped += _fill_lanes(out, slot, entry, pose, range_)
    outcomes |= {entry.marker_id: "dropped" for _, entry in known[markers:]}
    beyond = max(len(known) - markers, 0)
    return Observed(out, looked.unknown, looked.stale, beyond, lanes_dropped, contradictory, outcomes)


def frame_before(times_ns: Sequence[int] | np.ndarray, now_ns: int, interval: float) -> int | None:
    """Return which of some earlier times is nearest to `interval` seconds before now, for the residual.

    None where it differs from that by more than half the interval: at a gap, or at the start of a drive.
    """
    if not len(times_ns):
        return None
    off = np.abs(np.asarray(times_ns, np.int64) - (now_ns - interval * 1e9))
    frame = int(off.argmin())
    return None if off[frame] > 0.5e9 * interval else frame


def pose_residual(entry: StoredMarker, pose: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> float:
    """Return the mean distance (ground plane, metres) between a marker's lane points placed by two poses.

    Without lanes it is the distance between the two marker positions.
    """
    points = entry.lanes.reshape(-1, 3) if entry.lanes.size else np.zeros((1, 3))
    apart = transform_points(pose, points) - transform_points(other, points)
    return float(np.hypot(apart[:, 0], apart[:, 1]).mean())


def _best(detected: Detected) -> np.ndarray:
    """Return the row of the best score for each distinct id."""
    rows = np.flatnonzero(np.asarray(detected.valid))
    rows = rows[np.argsort(-np.asarray(detected.score)[rows], kind="stable")]
    return rows[np.unique(np.asarray(detected.marker_id)[rows], return_index=True)[1]]


def _contradictory(detected: Detected) -> np.ndarray:
    flags = getattr(detected, "contradictory", None)
    return np.zeros(len(np.asarray(detected.valid)), bool) if flags is None else np.asarray(flags)


def _poses_of(detected: Detected, marker_id: int) -> list[Float[np.ndarray, "4 4"]]:
    """Return where a marker was detected: its best pose, all of them if they contradict each other, none if absent."""
    mine = np.asarray(detected.valid) & (np.asarray(detected.marker_id) == marker_id)
    several = mine & _contradictory(detected)
    rows = np.flatnonzero(several) if several.any() else [row for row in _best(detected) if mine[row]]
    return [np.asarray(detected.pose[row], np.float64) for row in rows]


def _fill_lanes(
    out: MarkerObservations, slot: int, entry: StoredMarker, pose: Float[np.ndarray, "4 4"], range_: PerceptionRange
) -> int:
    """Write a marker's lanes and their connectivity into its slot; return the number of dropped lanes."""
    whole = transform_points(pose, entry.lanes.reshape(-1, 3)).reshape(entry.lanes.shape)
    cut = [clip_to_range(line, range_) for line in whole]
    pieces = [part for parts in cut for part in parts]
    if not pieces:
        return 0
    lane = np.repeat(np.arange(len(cut)), [len(parts) for parts in cut])
    starts = np.array([np.array_equal(p[0], whole[i, 0]) for p, i in zip(pieces, lane, strict=True)])
    ends = np.array([np.array_equal(p[-1], whole[i, -1]) for p, i in zip(pieces, lane, strict=True)])
    kept = nearest_lines(pieces, out.lanes.shape[1], pose[:2, 3])
    n, lane = len(kept), lane[kept]
    out.lanes[slot, :n] = resample_lines([pieces[i] for i in kept], out.lanes.shape[2])
    out.lane_valid[slot, :n] = True
    out.successor[slot, :n, :n] = entry.successor[np.ix_(lane, lane)] & ends[kept][:, None] & starts[kept]
    return len(pieces) - n
