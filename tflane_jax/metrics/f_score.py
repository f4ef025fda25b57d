"""The F-score of 3-D lanes that the OpenLane-V2 devkit prints beside the centerline metrics.

Lanes are compared on 100 planes across the road, 1 m apart, and paired one to one at the least total cost. The F-score
is not part of `CenterlineMetrics`: it takes about as long as all of those together and few papers report it. It is the
same in devkit v1.0 and v2.1. Rules: docs/reference/metrics.md, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.metrics.chamfer import PaddedLines
from tflane_jax.metrics.frames import LaneDetections, LaneTruth, Lines, check_kinds
from tflane_jax.metrics.merging import joined

SAMPLES = np.arange(-50.0, 50.0)  # x of the planes, metres
NEAR = 1.5  # metres; also the cost of a plane that only one of two lanes passes
_FRACTION = 0.75  # of a lane's planes that must be near
_WORST = NEAR * len(SAMPLES)  # pairs of at least this cost do not count
_STARTS_BEFORE, _ENDS_BEHIND = 49.0, -50.0  # metres


class CenterlineFScore:
    """Accumulator of the F-score over frames; it keeps four counts. Scores of detections are ignored."""

    protocol = "OpenLane-V2 centerline F-score v2.1"

    def __init__(self) -> None:
        self._frames = 0
        self._counts = np.zeros(4, np.int64)

    def update(self, detections: LaneDetections, truth: LaneTruth) -> None:
        """Add one frame; raise UserError for lines that cannot be measured."""
        check_kinds(detections, truth, (LaneDetections, LaneTruth))
        true, found = sample_lanes(truth.points, "truth"), sample_lanes(detections.points, "detections")
        recalled, precise = count_found(true, found)
        self._counts += [recalled, precise, len(true.points), len(found.points)]
        self._frames += 1

    def merge(self, *others: Self) -> Self:
        """Return an accumulator of the frames of all (none changes)."""
        merged = type(self)()
        for name in vars(self):
            setattr(merged, name, joined([getattr(each, name) for each in (self, *others)]))
        return merged

    def compute(self) -> dict[str, float]:
        """Return `frames`, `F_score` and its parts `F_recall` and `F_precision`, each 0 without lanes or detections."""
        recalled, precise, lanes, detections = self._counts.tolist()
        recall, precision = recalled / max(lanes, 1), precise / max(detections, 1)
        score = 2 * recall * precision / (recall + precision) if recalled and precise else 0.0
        return {"frames": self._frames, "F_score": score, "F_recall": recall, "F_precision": precision}


@dataclass(frozen=True)
class SampledLanes:
    """Lanes on the S planes x = `SAMPLES`.

    Attributes:
        points: (L, S, 2) y and z, metres; arbitrary where the lane does not pass the plane.
        first: (L,) index of the first plane that the lane passes.
        count: (L,) number of consecutive planes that it passes, at least two.
    """

    points: Float[np.ndarray, "l s 2"]
    first: Int[np.ndarray, " l"]
    count: Int[np.ndarray, " l"]


def sample_lanes(lines: Lines, what: str) -> SampledLanes:
    """Return the lanes that count on the planes; raise UserError for lines without points or not finite.

    Left out are lanes of one point, lanes whose first point lies ahead of 49 m or whose last lies behind -50 m, and
    lanes that pass fewer than two planes. The vertices of a lane are sorted by x.
    """
    padded = PaddedLines.of(lines, what)
    points = padded.points
    kept = (padded.counts > 1) & (points[:, 0, 0] < _STARTS_BEFORE) & (points[:, -1, 0] > _ENDS_BEHIND)
    points = points[kept]
    order = np.argsort(points[..., 0], axis=1, kind="stable")
    points = np.take_along_axis(points, order[..., None], 1)
    passes = (points[:, :1, 0] <= SAMPLES) & (points[:, -1:, 0] >= SAMPLES)
    count = passes.sum(1)
    points, passes, count = points[count > 1], passes[count > 1], count[count > 1]
    slope_type = np.result_type(np.float32, np.asarray(lines[0]).dtype) if len(lines) else np.float64
    return SampledLanes(_interpolated(points, slope_type), passes.argmax(1), count)


def _interpolated(points: Float[np.ndarray, "l n 3"], slope_type: np.dtype | type) -> Float[np.ndarray, "l s 2"]:
    """Return y and z on the planes, of vertices in order of x.

    As in the official program, slopes have the precision of the line (float32 or float64).
    """
    lanes, n = points.shape[:2]
    lane = np.arange(lanes)[:, None]
    # Number of vertices before each plane.
    bins = len(SAMPLES) + 1
    beyond = np.searchsorted(SAMPLES, points[..., 0], side="right") + lane * bins
    below = np.bincount(beyond.ravel(), minlength=lanes * bins).reshape(lanes, bins).cumsum(1)[:, :-1]
    start = np.clip(below - 1, 0, n - 2)

    step = np.diff(points, axis=1)
    run = step[..., :1]
    # Vertices of equal x (padding among them) have no plane between them: any slope will do.
    slope = step[..., 1:].astype(slope_type) / np.where(run > 0.0, run, 1.0).astype(slope_type)
    ahead = SAMPLES - points[lane, start, 0]
    return slope[lane, start] * ahead[..., None] + points[lane, start, 1:]


def count_found(true: SampledLanes, found: SampledLanes) -> tuple[int, int]:
    """Return the numbers of true lanes found and of detections that find one, in the pairing of least cost."""
    from scipy.optimize import linear_sum_assignment

    cost, near = _costs(true, found)
    g, p = linear_sum_assignment(cost)
    possible = cost[g, p] < _WORST
    recalled = possible & (near[g, p] >= _FRACTION * true.count[g])
    precise = possible & (near[g, p] >= _FRACTION * found.count[p])
    return int(recalled.sum()), int(precise.sum())


def _costs(true: SampledLanes, found: SampledLanes) -> tuple[Int[np.ndarray, "g p"], Int[np.ndarray, "g p"]]:
    """Return the cost of each pair, and the number of planes on which its lanes are near.

    The cost is the sum of the distances on planes that both pass, plus `NEAR` for each plane that only one of them
    passes, in metres, truncated to an integer. Most pairs have no common plane and need no distances.
    """
    first = np.maximum(true.first[:, None], found.first)
    last = np.minimum((true.first + true.count)[:, None], found.first + found.count)
    shared = np.maximum(last - first, 0)
    total = NEAR * (true.count[:, None] + found.count - 2 * shared)
    near = np.zeros(shared.shape, np.int64)

    g, p = np.nonzero(shared)
    planes = shared[g, p]
    begin = np.cumsum(planes) - planes
    # The common planes of all pairs, concatenated.
    plane = np.arange(planes.sum()) + np.repeat(first[g, p] - begin, planes)
    step = true.points[np.repeat(g, planes), plane] - found.points[np.repeat(p, planes), plane]
    distance = np.hypot(step[:, 0], step[:, 1])
    if len(g):
        total[g, p] += np.add.reduceat(distance, begin)
        near[g, p] = np.add.reduceat(distance < NEAR, begin, dtype=np.int64)
    # As in the official program, only a perfect pair costs 0.
    return np.where((total > 0.0) & (total < 1.0), 1, total.astype(np.int64)), near
