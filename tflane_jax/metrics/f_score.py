"""The F-score of 3-D lanes that the OpenLane-V2 devkit prints beside the centerline metrics.

Lanes are compared where they pass 100 planes across the road, 1 m apart, and paired one to one at the least total cost.
Kept apart from `CenterlineMetrics`, since it takes about as long as all of those together and few papers report it. It
did not change between devkit v1.0 and v2.1. Rules: shared specs/metrics.md section 2.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from tflane_jax.metrics.chamfer import PaddedLines
from tflane_jax.metrics.frames import LaneDetections, LaneTruth, Lines

SAMPLES = np.arange(-50.0, 50.0)  # x of the planes, metres
NEAR = 1.5  # metres; also what a plane costs that only one of two lanes passes
_SHARE = 0.75  # of a lane's planes that must be near
_WORST = NEAR * len(SAMPLES)  # pairs of this cost or more find nothing
_STARTS_BEFORE, _ENDS_BEHIND = 49.0, -50.0  # metres


class CenterlineFScore:
    """Accumulator of the F-score over frames; it keeps four counts. Scores of detections play no part."""

    protocol = "OpenLane-V2 centerline F-score v2.1"

    def __init__(self) -> None:
        self._frames = 0
        self._counts = np.zeros(4, np.int64)

    def update(self, detections: LaneDetections, truth: LaneTruth) -> None:
        """Add one frame; raise UserError for lines that cannot be measured."""
        true, found = sample_lanes(truth.points, "truth"), sample_lanes(detections.points, "detections")
        recalled, precise = found_lanes(true, found)
        self._counts += [recalled, precise, len(true.points), len(found.points)]
        self._frames += 1

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both (neither changes)."""
        merged = type(self)()
        merged._frames = self._frames + other._frames
        merged._counts = self._counts + other._counts
        return merged

    def compute(self) -> dict[str, float]:
        """Return `frames`, `F_score` and its parts `F_recall` and `F_precision`, each 0 where nothing is to count."""
        recalled, precise, lanes, detections = self._counts.tolist()
        recall, precision = recalled / max(lanes, 1), precise / max(detections, 1)
        score = 2 * recall * precision / (recall + precision) if recalled and precise else 0.0
        return {"frames": self._frames, "F_score": score, "F_recall": recall, "F_precision": precision}


@dataclass(frozen=True)
class SampledLanes:
    """Lanes where they pass the planes `SAMPLES` (S of them).

    Attributes:
        points: (L, S, 2) y and z, metres; without meaning where the lane does not pass.
        first: (L,) index of the first plane that the lane passes.
        count: (L,) how many it passes, in a row and at least two.
    """

    points: Float[np.ndarray, "l s 2"]
    first: Int[np.ndarray, " l"]
    count: Int[np.ndarray, " l"]


def sample_lanes(lines: Lines, what: str) -> SampledLanes:
    """Return the lanes that take part, by y and z on the planes; raise UserError for lines that cannot be measured.

    A lane of one point takes no part, nor one that starts ahead of 49 m or ends behind -50 m, in drawing order, nor one
    that passes fewer than two planes. A lane that goes back and forth is straightened out by sorting its vertices by x.
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

    Slopes are as precise as the line was, which is what the official program does.
    """
    lanes, n = points.shape[:2]
    lane = np.arange(lanes)[:, None]
    # How many vertices lie before each plane: those with a first plane beyond them up to here.
    bins = len(SAMPLES) + 1
    beyond = np.searchsorted(SAMPLES, points[..., 0], side="right") + lane * bins
    below = np.bincount(beyond.ravel(), minlength=lanes * bins).reshape(lanes, bins).cumsum(1)[:, :-1]
    start = np.clip(below - 1, 0, n - 2)

    step = np.diff(points, axis=1)
    run = step[..., :1]
    # Between vertices of one x (padding among them) lies no plane, or one through the first: any slope will do.
    slope = step[..., 1:].astype(slope_type) / np.where(run > 0.0, run, 1.0).astype(slope_type)
    ahead = SAMPLES - points[lane, start, 0]
    return slope[lane, start] * ahead[..., None] + points[lane, start, 1:]


def found_lanes(true: SampledLanes, found: SampledLanes) -> tuple[int, int]:
    """Return how many true lanes are found, and how many detections find one, in the pairing of least cost."""
    cost, near = _costs(true, found)
    g, p = linear_sum_assignment(cost)
    possible = cost[g, p] < _WORST
    recalled = possible & (near[g, p] >= _SHARE * true.count[g])
    precise = possible & (near[g, p] >= _SHARE * found.count[p])
    return int(recalled.sum()), int(precise.sum())


def _costs(true: SampledLanes, found: SampledLanes) -> tuple[Int[np.ndarray, "g p"], Int[np.ndarray, "g p"]]:
    """Return the cost of each pair, and on how many planes its lanes are near.

    The cost sums, in metres and cut to an integer, the distances on planes that both pass, and `NEAR` for each plane
    that only one of them passes. Only the planes that both pass are computed: few of 100, for most pairs none.
    """
    first = np.maximum(true.first[:, None], found.first)
    last = np.minimum((true.first + true.count)[:, None], found.first + found.count)
    shared = np.maximum(last - first, 0)
    total = NEAR * (true.count[:, None] + found.count - 2 * shared)
    near = np.zeros(shared.shape, np.int64)

    g, p = np.nonzero(shared)
    planes = shared[g, p]
    begin = np.cumsum(planes) - planes
    # All planes of all pairs in one row.
    plane = np.arange(planes.sum()) + np.repeat(first[g, p] - begin, planes)
    step = true.points[np.repeat(g, planes), plane] - found.points[np.repeat(p, planes), plane]
    distance = np.hypot(step[:, 0], step[:, 1])
    if len(g):
        total[g, p] += np.add.reduceat(distance, begin)
        near[g, p] = np.add.reduceat(distance < NEAR, begin, dtype=np.int64)
    # Officially only a pair that fits perfectly costs nothing.
    return np.where((total > 0.0) & (total < 1.0), 1, total.astype(np.int64)), near
