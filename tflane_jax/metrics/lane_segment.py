"""OpenLane-V2 lane-segment metrics, in two flavours: the devkit's (OLUS) and LaneSegNet's own (mAP).

A lane segment has a centerline and two side lines; areas are pedestrian crossings and road boundaries. Both flavours
give the same numbers for what they share: AP_ls is DET_l, TOP_lsls is TOP_ll (v2.1), AP_ped is the crossings' part of
DET_a. LaneSegNet and TF-Lane print the second. Rules: shared specs/metrics.md section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry.distances import chamfer, discrete_frechet
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, match_lanes, relaxation
from tflane_jax.metrics.frames import LaneDetections, LaneTruth, Lines, check_shape, checked_lines
from tflane_jax.metrics.matching import average_precision_11, greedy_match
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics

Flavour = Literal["OpenLane-V2", "LaneSegNet"]
AREA_THRESHOLDS = (0.5, 1.0, 1.5)  # metres, Chamfer
CROSSING, BOUNDARY = 1, 2
_MASKED = 1024.0  # the official distance of pairs that are too far apart to be measured


@dataclass(frozen=True)
class AreaTruth:
    """Crossings and road boundaries of one frame.

    Attributes:
        points: A polylines (n, 3), metres, ego frame; closed where the first vertex is repeated at the end.
        categories: (A,) 1 pedestrian crossing, 2 road boundary.
    """

    points: Lines
    categories: Int[np.ndarray, " a"]


@dataclass(frozen=True)
class AreaDetections:
    """Detected crossings and road boundaries; as `AreaTruth`, with `scores` (A,), 0 to 1."""

    points: Lines
    categories: Int[np.ndarray, " a"]
    scores: Float[np.ndarray, " a"]


@dataclass(frozen=True)
class SegmentTruth:
    """Ground truth of one frame: G lane segments.

    Attributes:
        lanes: centerlines, successors, and traffic elements where there are any.
        left, right: G side lines (n, 3), metres.
        areas: crossings and boundaries.
    """

    lanes: LaneTruth
    left: Lines
    right: Lines
    areas: AreaTruth


@dataclass(frozen=True)
class SegmentDetections:
    """Detections of one frame; fields as of `SegmentTruth`."""

    lanes: LaneDetections
    left: Lines
    right: Lines
    areas: AreaDetections


class LaneSegmentMetrics:
    """Accumulator of the lane-segment metrics over frames; it keeps scores and flags of detections, no geometry.

    Args:
        flavour: "OpenLane-V2" gives DET_l, DET_a, DET_t, TOP_ll, TOP_lt and OLUS; "LaneSegNet" AP_ls, AP_ped, mAP and
            TOP_lsls, and needs no traffic elements.
    """

    def __init__(self, flavour: Flavour = "OpenLane-V2") -> None:
        self.flavour: Flavour = flavour
        self._lanes = CenterlineMetrics("v2.1")
        self._areas = {category: _AreaPrecision() for category in (CROSSING, BOUNDARY)}

    @property
    def protocol(self) -> str:
        """Name and version, to stand above every table of these numbers."""
        if self.flavour == "LaneSegNet":
            return "LaneSegNet lane segments (TOP_lsls v2.1)"
        return "OpenLane-V2 lane segments v2.1"

    def update(self, detections: SegmentDetections, truth: SegmentTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        distance, nearest = nearest_segments(
            [truth.lanes.points, truth.left, truth.right],
            [detections.lanes.points, detections.left, detections.right],
        )
        self._lanes.add(match_lanes(detections.lanes, truth.lanes, distance, nearest))
        for category, precision in self._areas.items():
            precision.update(detections.areas, truth.areas, category)

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        if self.flavour != other.flavour:
            raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one flavour")
        merged = type(self)(self.flavour)
        merged._lanes = self._lanes.merge(other._lanes)
        merged._areas = {category: mine + other._areas[category] for category, mine in self._areas.items()}
        return merged

    def compute(self) -> dict[str, float]:
        """Return the metrics of the flavour, 0 to 1, and what they count.

        - both: `frames`, `lanes`, and the areas by threshold, `crossing@0.5` ... `boundary@1.5`;
        - "OpenLane-V2": as `CenterlineMetrics.compute`, with `DET_a` and, where there are traffic elements, `OLUS`
          instead of `OLS`;
        - "LaneSegNet": `AP_ls` and `AP_ls@1.0` ..., `AP_ped`, `AP_boundary`, `mAP` (of the first two) and `TOP_lsls`.
        """
        lanes = self._lanes.compute()
        areas = {
            f"{name}@{threshold}": value
            for name, category in (("crossing", CROSSING), ("boundary", BOUNDARY))
            for threshold, value in zip(AREA_THRESHOLDS, self._areas[category].compute(), strict=True)
        }
        if self.flavour == "LaneSegNet":
            count = {name: lanes[name] for name in ("frames", "lanes")}
            segments = {f"AP_ls@{t}": lanes[f"DET_l@{t}"] for t in LANE_THRESHOLDS}
            ap_ls, ap_ped = lanes["DET_l"], float(np.mean(self._areas[CROSSING].compute()))
            means = {"AP_ls": ap_ls, "AP_ped": ap_ped, "AP_boundary": float(np.mean(self._areas[BOUNDARY].compute()))}
            return count | means | {"mAP": (ap_ls + ap_ped) / 2, "TOP_lsls": lanes["TOP_ll"]} | segments | areas
        lanes.pop("OLS", None)
        lanes["DET_a"] = float(np.mean(list(areas.values())))
        if "DET_t" in lanes:
            detection = [lanes["DET_l"], lanes["DET_a"], lanes["DET_t"]]
            lanes["OLUS"] = float(np.mean([*detection, lanes["TOP_ll"] ** 0.5, lanes["TOP_lt"] ** 0.5]))
        return lanes | areas


class _AreaPrecision:
    """Detections of one category of areas, pooled over frames."""

    def __init__(self) -> None:
        self.truths = 0
        self.scores: list[np.ndarray] = []
        self.hits: list[np.ndarray] = []  # (thresholds, detections) each

    def update(self, detections: AreaDetections, truth: AreaTruth, category: int) -> None:
        true = _of_category(truth.points, truth.categories, category, "truth")
        found = _of_category(detections.points, detections.categories, category, "detections")
        scores = np.asarray(detections.scores)
        check_shape(scores, (len(detections.points),), "detections: area scores")
        scores = scores[np.asarray(detections.categories) == category]
        distance = _area_distance(true, found)
        if len(true):
            least, nearest = distance.min(0), distance.argmin(0)
        else:
            least, nearest = np.full(len(found), np.inf), np.zeros(len(found), np.int64)
        self.truths += len(true)
        self.scores.append(scores)
        self.hits.append(np.stack([greedy_match(least, nearest, scores, t) >= 0 for t in AREA_THRESHOLDS]))

    def __add__(self, other: _AreaPrecision) -> _AreaPrecision:
        total = _AreaPrecision()
        total.truths = self.truths + other.truths
        total.scores, total.hits = self.scores + other.scores, self.hits + other.hits
        return total

    def compute(self) -> list[float]:
        """Return the average precision at each threshold."""
        scores = np.concatenate([np.zeros(0), *self.scores])
        hits = np.concatenate([np.zeros((len(AREA_THRESHOLDS), 0), bool), *self.hits], 1)
        return [average_precision_11(scores, row, self.truths) for row in hits]


def nearest_segments(
    truth: list[Lines], detected: list[Lines]
) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return for each detection the distance to its nearest true segment (metres), and which one that is.

    The distance is half of Frechet(centerlines) + Chamfer(left) + Chamfer(right), relaxed like that of centerlines;
    pairs whose relaxed centerline Chamfer distance is 3 m or more are never matched (1024), however near their sides.

    Args:
        truth: G centerlines, left lines, right lines.
        detected: P of each.
    """
    true, found = ([_Padded.of(lines, f"{side}: {name}") for lines, name in zip(three, _NAMES, strict=True)]
                   for side, three in (("truth", truth), ("detections", detected)))  # fmt: skip
    for side, three in (("truth", true), ("detections", found)):
        if len({len(lines.points) for lines in three}) > 1:
            raise UserError(f"{side}: {', '.join(f'{len(x.points)} {n}' for x, n in zip(three, _NAMES, strict=True))}"
                            ", expected as many of each")  # fmt: skip
    g, p = len(true[0].points), len(found[0].points)
    if g == 0 or p == 0:
        return np.full(p, np.inf), np.zeros(p, np.int64)
    relax = relaxation(true[0].points)
    # No vertex of one line is nearer to the other line than their boxes are to each other.
    lane, detection = np.nonzero(relax[:, None] * _box_gap(true[0].points, found[0].points) < LANE_THRESHOLDS[-1])
    near = relax[lane] * _pair_chamfer(true[0], found[0], lane, detection) < LANE_THRESHOLDS[-1]
    lane, detection = lane[near], detection[near]
    total = discrete_frechet(true[0].points[lane], found[0].points[detection])
    for i in (1, 2):
        total = total + _pair_chamfer(true[i], found[i], lane, detection)
    distance = np.full((g, p), _MASKED)
    distance[lane, detection] = relax[lane] * 0.5 * total
    return distance.min(0), distance.argmin(0)


_NAMES = ("centerlines", "left lines", "right lines")


@dataclass(frozen=True)
class _Padded:
    """Lines of a frame as one array; `valid` leaves out padding."""

    points: Float[np.ndarray, "l n 3"]
    valid: Bool[np.ndarray, "l n"]

    @classmethod
    def of(cls, lines: Lines, what: str) -> _Padded:
        points = checked_lines(lines, what)
        counts = np.array([len(line) for line in lines], int)
        return cls(points, np.arange(points.shape[1]) < counts[:, None])

    def opened(self) -> Bool[np.ndarray, "l n"]:
        """Return `valid` without the last vertex of closed lines, which counts only once."""
        last = self.valid.sum(-1) - 1
        closed = (self.points[:, 0] == self.points[np.arange(len(last)), last]).all(-1)
        return self.valid & ~(closed[:, None] & (np.arange(self.valid.shape[1]) == last[:, None]))


def _pair_chamfer(
    true: _Padded, found: _Padded, i: Int[np.ndarray, " k"], j: Int[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Return the Chamfer distance of K pairs; only true lines are opened."""
    return chamfer(true.points[i], found.points[j], true.opened()[i], found.valid[j])


def _box_gap(a: Float[np.ndarray, "g n 3"], b: Float[np.ndarray, "p m 3"]) -> Float[np.ndarray, "g p"]:
    """Return the distance between the axis-aligned boxes of all pairs of lines."""
    low = np.maximum(a.min(1)[:, None] - b.max(1)[None], b.min(1)[None] - a.max(1)[:, None])
    return np.sqrt((np.maximum(low, 0.0) ** 2).sum(-1))


def _of_category(
    lines: Lines, categories: Int[np.ndarray, " a"], category: int, side: str
) -> list[Float[np.ndarray, "n 3"]]:
    categories = np.asarray(categories)
    check_shape(categories, (len(lines),), f"{side}: area categories")
    if not np.isin(categories, (CROSSING, BOUNDARY)).all():
        raise UserError(f"{side}: area categories must be {CROSSING} (crossing) or {BOUNDARY} (boundary)")
    return [lines[i] for i in np.flatnonzero(categories == category).tolist()]


def _area_distance(
    true: list[Float[np.ndarray, "n 3"]], found: list[Float[np.ndarray, "m 3"]]
) -> Float[np.ndarray, "g p"]:
    """Return the Chamfer distance of all pairs of areas that may match; others are at 1024."""
    distance = np.full((len(true), len(found)), _MASKED)
    if distance.size:
        a, b = _Padded.of(true, "truth: areas"), _Padded.of(found, "detections: areas")
        i, j = np.nonzero(_box_gap(a.points, b.points) < AREA_THRESHOLDS[-1])
        distance[i, j] = _pair_chamfer(a, b, i, j)
    return distance
