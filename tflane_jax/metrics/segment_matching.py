"""Lane segments and areas of one frame: truth, detections, and their matching.

Source: openlanev2/lanesegment/evaluation of the OpenLane-V2 devkit; docs/reference/metrics.md, section 3, describes the
rules. Type and distance errors of matched segments are named in LaneSegNet's paper (AE_type, AE_dist) without a public
definition; docs/metrics.md gives the one used here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, MatchedFrame, match_lanes, relaxation
from tflane_jax.metrics.chamfer import PaddedLines, near_pairs, pair_chamfer
from tflane_jax.metrics.frames import LaneDetections, LaneTruth, Lines, check_kinds, check_shape, checked_numbers
from tflane_jax.metrics.frechet import end_distance, pair_frechet
from tflane_jax.metrics.matching import greedy_match, nearest_truth

AREA_THRESHOLDS = (0.5, 1.0, 1.5)  # metres, Chamfer
CROSSING, BOUNDARY = 1, 2
Nearest = Literal["close", "all"]
# Beyond the thresholds, the nearest segment is found by so many points on each line, among so many segments.
_COARSE, _CANDIDATES = 4, 8


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
        left_type, right_type: (G,) `scene.LineType`; None where they are not known.
    """

    lanes: LaneTruth
    left: Lines
    right: Lines
    areas: AreaTruth
    left_type: Int[np.ndarray, " g"] | None = None
    right_type: Int[np.ndarray, " g"] | None = None

    @property
    def points(self) -> Lines:
        """Centerlines, metres."""
        return self.lanes.points

    @property
    def visibility(self) -> Float[np.ndarray, " g"] | None:
        """Fraction of each segment in direct line of sight, 0 to 1; None where it is not known."""
        return self.lanes.visibility


@dataclass(frozen=True)
class SegmentDetections:
    """Detections of one frame; fields as of `SegmentTruth`."""

    lanes: LaneDetections
    left: Lines
    right: Lines
    areas: AreaDetections
    left_type: Int[np.ndarray, " p"] | None = None
    right_type: Int[np.ndarray, " p"] | None = None


@dataclass(frozen=True)
class MatchedAreas:
    """Matching results of the areas of one frame, P of them detected.

    Attributes:
        scores, categories: (P,) of the detections.
        hits: (K, P) true positive at each of `AREA_THRESHOLDS`.
        truths: (3,) number of true areas by category.
    """

    scores: Float[np.ndarray, " p"]
    categories: Int[np.ndarray, " p"]
    hits: Bool[np.ndarray, "k p"]
    truths: Int[np.ndarray, "3"]

    @classmethod
    def none(cls) -> MatchedAreas:
        """Return the results without areas."""
        empty = np.zeros(0), np.zeros(0, np.int64), np.zeros((len(AREA_THRESHOLDS), 0), bool)
        return cls(*empty, np.zeros(BOUNDARY + 1, np.int64))


@dataclass(frozen=True)
class MatchedSegments:
    """Matching results of one frame with P detected segments.

    Attributes:
        segments: as of centerlines, by the distance of segments.
        areas: crossings and boundaries.
        distance: (P,) mean Chamfer distance of centerline, left and right line to those of the nearest segment, metres;
            0 for a detection that is matched at no threshold.
        wrong: (P,) fraction of the two boundary types that differ from those of the nearest segment; None where types
            are not known.
    """

    segments: MatchedFrame
    areas: MatchedAreas
    distance: Float[np.ndarray, " p"]
    wrong: Float[np.ndarray, " p"] | None

    @property
    def lanes(self) -> int:
        """Number of true segments."""
        return self.segments.lanes

    @property
    def hits(self) -> Bool[np.ndarray, "k p"]:
        """Segments that are true positives at each of `LANE_THRESHOLDS`."""
        return self.segments.hits

    def select(self, lanes: Bool[np.ndarray, " g"]) -> MatchedSegments:
        """Return the part of the frame that belongs to some of its segments, without areas and traffic elements."""
        owned = self.segments.owned(lanes)
        wrong = None if self.wrong is None else self.wrong[owned]
        return MatchedSegments(self.segments.select(lanes), MatchedAreas.none(), self.distance[owned], wrong)


def match_segments(
    detections: SegmentDetections, truth: SegmentTruth, *, nearest: Nearest = "close", elements: bool = True
) -> MatchedSegments:
    """Match the segments, areas and traffic elements of one frame; raise UserError for arrays that do not fit.

    Groups of segments need the `nearest` segment of "all" detections, see `nearest_segments`. Without `elements`,
    traffic elements are ignored.
    """
    check_kinds(detections, truth, (SegmentDetections, SegmentTruth))
    distance, owner, chamfer = _measured_segments(
        [truth.lanes.points, truth.left, truth.right],
        [detections.lanes.points, detections.left, detections.right],
        nearest,
    )
    lanes = truth.lanes if elements else replace(truth.lanes, elements=None)
    matched = match_lanes(detections.lanes, lanes, distance, owner)
    pairs = np.flatnonzero(matched.hits.any(0))
    error = np.zeros(len(distance))
    for apart in chamfer:
        error[pairs] += apart[owner[pairs], pairs] / 3.0
    areas = match_areas(detections.areas, truth.areas)
    return MatchedSegments(matched, areas, error, _wrong_types(detections, truth, owner, pairs))


def _wrong_types(
    detections: SegmentDetections, truth: SegmentTruth, nearest: Int[np.ndarray, " p"], pairs: Int[np.ndarray, " k"]
) -> Float[np.ndarray, " p"] | None:
    """Return the fraction of wrong boundary types of each matched detection; None where a side has no types."""
    wrong = np.zeros(len(nearest))
    for name in ("left_type", "right_type"):
        true, found = getattr(truth, name), getattr(detections, name)
        if true is None or found is None:
            return None
        true, found = np.asarray(true), np.asarray(found)
        check_shape(true, (len(truth.left),), f"truth: {name}")
        check_shape(found, (len(detections.left),), f"detections: {name}")
        wrong[pairs] += 0.5 * (true[nearest[pairs]] != found[pairs])
    return wrong


def match_areas(detections: AreaDetections, truth: AreaTruth) -> MatchedAreas:
    """Match the areas of one frame.

    Only areas of the same category are compared. Only true areas lose their closing vertex.
    """
    true, found = PaddedLines.of(truth.points, "truth: areas"), PaddedLines.of(detections.points, "detections: areas")
    possible = (CROSSING, BOUNDARY)
    true_categories = checked_numbers(truth.categories, len(true), possible, "truth: area categories")
    categories = checked_numbers(detections.categories, len(found), possible, "detections: area categories")
    scores = np.array(detections.scores)  # a copy, because the accumulator keeps it
    check_shape(scores, (len(found),), "detections: area scores")
    true = true.open_ends()
    i, j = near_pairs(true, found, AREA_THRESHOLDS[-1], true_categories[:, None] == categories)
    distance = np.full((len(true), len(found)), np.inf)
    distance[i, j] = pair_chamfer(true, found, i, j)
    least, nearest = nearest_truth(distance)
    hits = np.stack([greedy_match(least < threshold, nearest, scores) >= 0 for threshold in AREA_THRESHOLDS])
    return MatchedAreas(scores, categories, hits, np.bincount(true_categories, minlength=BOUNDARY + 1))


def nearest_segments(
    truth: list[Lines], detected: list[Lines], *, nearest: Nearest = "close"
) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return for each detection the distance to its nearest true segment (metres) and the index of that segment.

    The distance is half of Frechet(centerlines) + Chamfer(left) + Chamfer(right), with the relaxation of centerlines.
    It is inf for pairs whose relaxed centerline Chamfer distance is 3 m or more. Other distances of 3 m or more, which
    are never matched either, may be too large or inf, because not all of them are computed.

    Args:
        truth: G centerlines, left lines, right lines.
        detected: P of each.
        nearest: of detections that are 3 m or more from every segment: "close" leaves the index arbitrary, "all" finds
            it by the same distance of a few points on each line, without the bound on centerlines.
    """
    least, owner, _ = _measured_segments(truth, detected, nearest)
    return least, owner


def _measured_segments(
    truth: list[Lines], detected: list[Lines], nearest: Nearest
) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"], Float[np.ndarray, "3 g p"]]:
    """Return what `nearest_segments` does, and the Chamfer distances of centerlines, left and right lines, metres.

    These are arbitrary for pairs that are never matched.
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
    chamfer = np.zeros((3, len(true[0]), len(found[0])))
    chamfer[:, lane, detection] = center, left, right
    total = pair_frechet(true_centers, centers, lane, detection) + left + right
    distance = np.full(chamfer.shape[1:], np.inf)
    distance[lane, detection] = np.where(relax[lane] * center < LANE_THRESHOLDS[-1], relax[lane] * 0.5 * total, np.inf)
    least, owner = nearest_truth(distance)
    far = np.flatnonzero(least >= LANE_THRESHOLDS[-1])
    if nearest == "all" and len(far) and len(relax):
        owner[far] = _nearest_of_all(relax, true, [lines.select(far) for lines in found])
    return least, owner, chamfer


def _nearest_of_all(
    relax: Float[np.ndarray, " g"], true: list[PaddedLines], found: list[PaddedLines]
) -> Int[np.ndarray, " p"]:
    """Return the nearest true segment of every detection, however far, by a few points on each line.

    Compared are the few segments whose centerline is nearest point by point.
    """
    (center, *sides), (other, *others) = ([lines.resampled(_COARSE) for lines in three] for three in (true, found))
    apart = np.linalg.norm(center.points[:, None] - other.points, axis=-1).mean(-1)
    near = np.argsort(relax[:, None] * apart, axis=0, kind="stable")[:_CANDIDATES]
    i, j = near.ravel(), np.indices(near.shape)[1].ravel()
    total = pair_frechet(center.points, other.points, i, j)
    for a, b in zip(sides, others, strict=True):
        total += pair_chamfer(a, b, i, j)
    best = nearest_truth((relax[i] * total).reshape(near.shape))[1]
    return near[best, np.arange(near.shape[1])]


_NAMES = ("centerlines", "left lines", "right lines")
