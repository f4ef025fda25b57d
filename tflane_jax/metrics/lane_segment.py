"""OpenLane-V2 lane-segment metrics, in two flavours: the devkit's (OLUS) and LaneSegNet's own (mAP).

A lane segment has a centerline and two side lines; areas are pedestrian crossings and road boundaries. Both flavours
give the same numbers for what they share: AP_ls is DET_l, TOP_lsls is TOP_ll (v2.1), AP_ped is the crossings' part of
DET_a. LaneSegNet and TF-Lane print the second. Rules: docs/reference/metrics.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, match_lanes, relaxation
from tflane_jax.metrics.chamfer import PaddedLines, near_pairs, pair_chamfer
from tflane_jax.metrics.frames import LaneDetections, LaneTruth, Lines, check_shape
from tflane_jax.metrics.frechet import end_distance, pair_frechet
from tflane_jax.metrics.matching import average_precision_11, greedy_match, nearest_truth, pooled
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics

Flavour = Literal["OpenLane-V2", "LaneSegNet"]
AREA_THRESHOLDS = (0.5, 1.0, 1.5)  # metres, Chamfer
CROSSING, BOUNDARY = 1, 2


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
        self._lanes = CenterlineMetrics(("v2.1",))
        self._true_areas = np.zeros(BOUNDARY + 1, np.int64)  # by category
        self._area_detections: list[tuple[np.ndarray, ...]] = []  # of every frame: scores, categories, hits

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        if self.flavour == "LaneSegNet":
            return "LaneSegNet lane segments (TOP_lsls v2.1)"
        return "OpenLane-V2 lane segments v2.1"

    def update(self, detections: SegmentDetections, truth: SegmentTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        distance, nearest = nearest_segments(
            [truth.lanes.points, truth.left, truth.right],
            [detections.lanes.points, detections.left, detections.right],
        )
        lanes = detections.lanes, truth.lanes
        if self.flavour == "LaneSegNet":
            lanes = replace(detections.lanes, elements=None), replace(truth.lanes, elements=None)
        self._lanes.add(match_lanes(*lanes, distance, nearest))
        self._area_detections.append(match_areas(detections.areas, truth.areas))
        self._true_areas += np.bincount(np.asarray(truth.areas.categories, np.int64), minlength=BOUNDARY + 1)

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        if self.flavour != other.flavour:
            raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one flavour")
        merged = type(self)(self.flavour)
        merged._lanes = self._lanes.merge(other._lanes)
        merged._true_areas = self._true_areas + other._true_areas
        merged._area_detections = self._area_detections + other._area_detections
        return merged

    def compute(self) -> dict[str, float]:
        """Return the metrics of the flavour, 0 to 1, and what they count.

        - both: `frames`, `lanes`, and the areas by threshold, `crossing@0.5` ... `boundary@1.5`;
        - "OpenLane-V2": as `CenterlineMetrics.compute`, with `DET_a` and, where there are traffic elements, `OLUS`
          instead of `OLS`;
        - "LaneSegNet": `AP_ls` and `AP_ls@1.0` ..., `AP_ped`, `AP_boundary`, `mAP` (of the first two) and `TOP_lsls`.
        """
        lanes = self._lanes.compute()
        scores, categories, hits = pooled(self._area_detections, (0,), (len(AREA_THRESHOLDS), 0))
        precision = {
            name: [average_precision_11(scores[members], row[members], int(self._true_areas[category])) for row in hits]
            for name, category in (("crossing", CROSSING), ("boundary", BOUNDARY))
            for members in [categories == category]
        }
        areas = {
            f"{name}@{threshold}": value
            for name, values in precision.items()
            for threshold, value in zip(AREA_THRESHOLDS, values, strict=True)
        }
        if self.flavour == "LaneSegNet":
            count = {name: lanes[name] for name in ("frames", "lanes")}
            segments = {f"AP_ls@{t}": lanes[f"DET_l@{t}"] for t in LANE_THRESHOLDS}
            ap_ls, ap_ped = lanes["DET_l"], float(np.mean(precision["crossing"]))
            means = {"AP_ls": ap_ls, "AP_ped": ap_ped, "AP_boundary": float(np.mean(precision["boundary"]))}
            return count | means | {"mAP": (ap_ls + ap_ped) / 2, "TOP_lsls": lanes["TOP_ll"]} | segments | areas
        lanes.pop("OLS", None)
        lanes["DET_a"] = float(np.mean(list(areas.values())))
        if "DET_t" in lanes:
            detection = [lanes["DET_l"], lanes["DET_a"], lanes["DET_t"]]
            lanes["OLUS"] = float(np.mean([*detection, lanes["TOP_ll"] ** 0.5, lanes["TOP_lt"] ** 0.5]))
        return lanes | areas


def match_areas(
    detections: AreaDetections, truth: AreaTruth
) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"], Bool[np.ndarray, "k p"]]:
    """Return scores and categories of the detected areas, and which are true positives at each threshold.

    Only areas of the same category are compared. Only true areas lose their closing vertex.
    """
    true, found = PaddedLines.of(truth.points, "truth: areas"), PaddedLines.of(detections.points, "detections: areas")
    true_categories = _checked_categories(truth.categories, len(true), "truth")
    categories = _checked_categories(detections.categories, len(found), "detections")
    scores = np.array(detections.scores)  # a copy, because the accumulator keeps it
    check_shape(scores, (len(found),), "detections: area scores")
    true = true.open_ends()
    i, j = near_pairs(true, found, AREA_THRESHOLDS[-1], true_categories[:, None] == categories)
    distance = np.full((len(true), len(found)), np.inf)
    distance[i, j] = pair_chamfer(true, found, i, j)
    least, nearest = nearest_truth(distance)
    hits = np.stack([greedy_match(least < threshold, nearest, scores) >= 0 for threshold in AREA_THRESHOLDS])
    return scores, categories, hits


def nearest_segments(
    truth: list[Lines], detected: list[Lines]
) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return for each detection the distance to its nearest true segment (metres) and the index of that segment.

    The distance is half of Frechet(centerlines) + Chamfer(left) + Chamfer(right), with the relaxation of centerlines.
    It is inf for pairs whose relaxed centerline Chamfer distance is 3 m or more. Other distances of 3 m or more, which
    are never matched either, may be too large or inf, because not all of them are computed.

    Args:
        truth: G centerlines, left lines, right lines.
        detected: P of each.
    """
    true, found = (
        [PaddedLines.of(lines, f"{side}: {name}") for lines, name in zip(three, _NAMES, strict=True)]
        for side, three in (("truth", truth), ("detections", detected))
    )
    for side, three in (("truth", true), ("detections", found)):
        if len({len(lines) for lines in three}) > 1:
            raise UserError(
                f"{side}: {', '.join(f'{len(x)} {n}' for x, n in zip(three, _NAMES, strict=True))}"
                ", expected as many of each"
            )
    relax = relaxation(true[0].points)
    # Half the centerline distance is part of the total, and nothing beyond the largest threshold is matched.
    true_centers, centers = true[0].points, found[0].points
    lane, detection = np.nonzero(0.5 * relax[:, None] * end_distance(true_centers, centers) < LANE_THRESHOLDS[-1])
    true = [lines.open_ends() for lines in true]
    center, left, right = (pair_chamfer(a, b, lane, detection) for a, b in zip(true, found, strict=True))
    total = pair_frechet(true_centers, centers, lane, detection) + left + right
    distance = np.full((len(true[0]), len(found[0])), np.inf)
    distance[lane, detection] = np.where(relax[lane] * center < LANE_THRESHOLDS[-1], relax[lane] * 0.5 * total, np.inf)
    return nearest_truth(distance)


_NAMES = ("centerlines", "left lines", "right lines")


def _checked_categories(categories: Int[np.ndarray, " a"], count: int, side: str) -> Int[np.ndarray, " a"]:
    categories = np.array(categories, np.int64)
    check_shape(categories, (count,), f"{side}: area categories")
    if ((categories != CROSSING) & (categories != BOUNDARY)).any():
        raise UserError(f"{side}: area categories must be {CROSSING} (crossing) or {BOUNDARY} (boundary)")
    return categories
