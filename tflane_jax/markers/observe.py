"""From detected markers to the observed prior: ids become lanes in the ego frame (marker paper, section III).

The same function serves detections in images (`markers.detection`) and simulated ones (`markers.simulation`).
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import PerceptionRange, clip_to_range, resample_lines, transform_points
from tflane_jax.markers.store import MarkerStore, StoredMarker, look_up
from tflane_jax.scene import MarkerObservations


class Detected(Protocol):
    """Markers found at one moment; `MarkerObservations` is one of its kinds.

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
    """What was observed, and what was left out.

    Attributes:
        markers: the prior.
        unknown, stale: detected ids that the store does not hold, and whose entry is out of date.
        markers_dropped: markers that found no room (the farthest).
        lanes_dropped: lanes that found no room (of each marker, the farthest from it).
    """

    markers: MarkerObservations
    unknown: int
    stale: int
    markers_dropped: int
    lanes_dropped: int


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
    """Return the lanes that the detected markers name, moved into the ego frame by the detected poses.

    Nearest markers come first, and an id that was found several times counts once, with its best score. Lanes are cut
    at the perception range, as the truth is: what lies outside is left out, and a lane that the border cuts into
    several pieces gives several. A marker none of whose lanes lies in the range stays, without lanes.

    `residual` is r of Eq. (2): the mean distance in the ground plane between where this detection and the previous one
    put the marker's stored lane points (the marker itself where it has no lanes), the vehicle's motion between them
    taken out.

    Args:
        detected: at this moment; padding may hold anything.
        store: what the ids mean. Warns where it does not hold one, see `look_up`.
        range_: in the ego frame.
        markers, lanes, points: M, J and P of the result: capacities, and points on each lane (at least 2).
        previous: what was detected a little earlier, in the ego frame of then; None where there is no such moment.
        now_from_previous: pose of that ego frame in this one; needed with `previous`.
        first_residual: residual of a marker that `previous` does not hold, metres.
        today, max_age_days: see `look_up`; None asks for no dates.
    """
    if previous is not None and now_from_previous is None:
        raise ValueError("previous detections need the vehicle's motion since: give now_from_previous")
    rows = _best(detected)
    looked = look_up(store, np.asarray(detected.marker_id)[rows], today=today, max_age_days=max_age_days)
    known = [(row, entry) for row, entry in zip(rows, looked.found, strict=True) if entry is not None]
    poses = {int(row): np.asarray(detected.pose[row], np.float64) for row, _ in known}
    known.sort(key=lambda pair: np.hypot(*poses[int(pair[0])][:2, 3]))

    out, lanes_dropped = MarkerObservations.empty(markers, lanes, points), 0
    for slot, (row, entry) in enumerate(known[:markers]):
        pose = poses[int(row)]
        before = None if previous is None else _pose_of(previous, entry.marker_id)
        out.marker_id[slot], out.pose[slot], out.score[slot] = entry.marker_id, pose, detected.score[row]
        out.residual[slot] = (
            first_residual
            if before is None or now_from_previous is None
            else pose_residual(entry, pose, now_from_previous @ before)
        )
        out.valid[slot] = True
        lanes_dropped += _fill_lanes(out, slot, entry, pose, range_)
    return Observed(out, looked.unknown, looked.stale, max(len(known) - markers, 0), lanes_dropped)


def pose_residual(entry: StoredMarker, pose: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> float:
    """Return how far apart two poses of a marker in one frame put its lane points: their mean distance in the ground
    plane, metres; that of the marker itself where it has no lanes."""
    points = entry.lanes.reshape(-1, 3) if entry.lanes.size else np.zeros((1, 3))
    apart = transform_points(pose, points) - transform_points(other, points)
    return float(np.hypot(apart[:, 0], apart[:, 1]).mean())


def _best(detected: Detected) -> np.ndarray:
    """Return the rows of the distinct ids, of each the one with the best score."""
    rows = np.flatnonzero(np.asarray(detected.valid))
    rows = rows[np.argsort(-np.asarray(detected.score)[rows], kind="stable")]
    return rows[np.unique(np.asarray(detected.marker_id)[rows], return_index=True)[1]]


def _pose_of(detected: Detected, marker_id: int) -> Float[np.ndarray, "4 4"] | None:
    rows = _best(detected)
    rows = rows[np.asarray(detected.marker_id)[rows] == marker_id]
    return np.asarray(detected.pose[rows[0]], np.float64) if len(rows) else None


def _fill_lanes(
    out: MarkerObservations, slot: int, entry: StoredMarker, pose: Float[np.ndarray, "4 4"], range_: PerceptionRange
) -> int:
    """Write a marker's lanes and their connectivity into its slot; return how many found no room."""
    whole = transform_points(pose, entry.lanes.reshape(-1, 3)).reshape(entry.lanes.shape)
    cut = [clip_to_range(line, range_) for line in whole]
    pieces = [part for parts in cut for part in parts]
    if not pieces:
        return 0
    lane = np.repeat(np.arange(len(cut)), [len(parts) for parts in cut])
    starts = np.array([np.array_equal(p[0], whole[i, 0]) for p, i in zip(pieces, lane, strict=True)])
    ends = np.array([np.array_equal(p[-1], whole[i, -1]) for p, i in zip(pieces, lane, strict=True)])
    distance = [np.hypot(*(p[:, :2] - pose[:2, 3]).T).min() for p in pieces]
    kept = np.sort(np.argsort(distance, kind="stable")[: out.lanes.shape[1]])
    n, lane = len(kept), lane[kept]
    out.lanes[slot, :n] = resample_lines([pieces[i] for i in kept], out.lanes.shape[2])
    out.lane_valid[slot, :n] = True
    out.successor[slot, :n, :n] = entry.successor[np.ix_(lane, lane)] & ends[kept][:, None] & starts[kept]
    return len(pieces) - n
