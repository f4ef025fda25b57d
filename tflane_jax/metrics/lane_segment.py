"""OpenLane-V2 lane-segment metrics, in two flavours: the devkit's (OLUS) and LaneSegNet's own (mAP).

A lane segment has a centerline and two side lines; areas are pedestrian crossings and road boundaries. Both flavours
give the same numbers for what they share: AP_ls is DET_l, TOP_lsls is TOP_ll (v2.1), AP_ped is the crossings' part of
DET_a. LaneSegNet and TF-Lane print the second. Rules: shared specs/metrics.md section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry.distances import discrete_frechet
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, match_lanes, relaxation
from tflane_jax.metrics.chamfer import PaddedLines, near_pairs, pair_chamfer
from tflane_jax.metrics.frames import LaneDetections, LaneTruth, Lines, check_shape
from tflane_jax.metrics.matching import average_precision_11, greedy_match, nearest_truth, pooled
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
        self.detections: list[tuple[np.ndarray, ...]] = []  # of every frame: scores, hits (thresholds, detections)

    def update(self, detections: AreaDetections, truth: AreaTruth, category: int) -> None:
        true = _of_category(truth.points, truth.categories, category, "truth")
        found = _of_category(detections.points, detections.categories, category, "detections")
        scores = np.asarray(detections.scores)
        check_shape(scores, (len(detections.points),), "detections: area scores")
        scores = scores[np.asarray(detections.categories) == category]
        distance = _area_distance(true, found)
        least, nearest = nearest_truth(distance)
        self.truths += len(true)
        hits = np.stack([greedy_match(least < t, nearest, scores) >= 0 for t in AREA_THRESHOLDS])
        self.detections.append((scores, hits))

    def __add__(self, other: _AreaPrecision) -> _AreaPrecision:
        total = _AreaPrecision()
        total.truths = self.truths + other.truths
        total.detections = self.detections + other.detections
        return total

    def compute(self) -> list[float]:
        """Return the average precision at each threshold."""
        scores, hits = pooled(self.detections, (len(AREA_THRESHOLDS), 0))
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
    true, found = ([PaddedLines.of(lines, f"{side}: {name}") for lines, name in zip(three, _NAMES, strict=True)]
                   for side, three in (("truth", truth), ("detections", detected)))  # fmt: skip
    for side, three in (("truth", true), ("detections", found)):
        if len({len(lines) for lines in three}) > 1:
            raise UserError(f"{side}: {', '.join(f'{len(x)} {n}' for x, n in zip(three, _NAMES, strict=True))}"
                            ", expected as many of each")  # fmt: skip
    relax = relaxation(true[0].points)
    true = [lines.open_ends() for lines in true]
    lane, detection = near_pairs(true[0], found[0], LANE_THRESHOLDS[-1] / relax)
    near = relax[lane] * pair_chamfer(true[0], found[0], lane, detection) < LANE_THRESHOLDS[-1]
    lane, detection = lane[near], detection[near]
    total = discrete_frechet(true[0].points[lane], found[0].points[detection])
    for i in (1, 2):
        total = total + pair_chamfer(true[i], found[i], lane, detection)
    distance = np.full((len(true[0]), len(found[0])), _MASKED)
    distance[lane, detection] = relax[lane] * 0.5 * total
    return nearest_truth(distance)


_NAMES = ("centerlines", "left lines", "right lines")


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
        a, b = PaddedLines.of(true, "truth: areas").open_ends(), PaddedLines.of(found, "detections: areas")
        i, j = near_pairs(a, b, AREA_THRESHOLDS[-1])
        distance[i, j] = pair_chamfer(a, b, i, j)
    return distance
