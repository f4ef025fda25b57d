"""Matching of one frame by the OpenLane-V2 centerline rules.

Source: openlanev2/centerline/evaluation of the OpenLane-V2 devkit; docs/reference/metrics.md describes the rules.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.metrics.frames import (
    ElementDetections,
    ElementTruth,
    LaneDetections,
    LaneTruth,
    check_kinds,
    check_shape,
    checked_confidence,
    checked_edges,
    checked_lines,
    checked_numbers,
)
from tflane_jax.metrics.frechet import end_distance, pair_frechet
from tflane_jax.metrics.matching import greedy_match, nearest_truth
from tflane_jax.metrics.topology import FILL, Version, check_versions, matchings, topology_precision

LANE_THRESHOLDS = (1.0, 2.0, 3.0)  # metres, discrete Frechet
ELEMENT_THRESHOLD = 0.75  # IoU distance


def relaxation(truth: Float[np.ndarray, "g n 3"]) -> Float[np.ndarray, " g"]:
    """Return the factor on distances to each true lane: max(0.5, 1 - 0.005 r), r metres from ego to nearest vertex."""
    return np.maximum(0.5, 1.0 - 0.005 * np.linalg.norm(truth, axis=-1).min(-1))


def nearest_lanes(
    truth: Float[np.ndarray, "g n 3"], detected: Float[np.ndarray, "p m 3"]
) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return for each detection the relaxed Frechet distance to its nearest lane (metres), and which lane that is.

    The distance is multiplied by `relaxation`, so far lanes are easier. Few pairs are measured: the distance of the end
    points bounds that of a pair from below. Without lanes the distances are inf.
    """
    if len(truth) == 0 or len(detected) == 0:
        return nearest_truth(np.zeros((len(truth), len(detected))))
    relax = relaxation(truth)[:, None]
    bound = relax * end_distance(truth, detected)
    distance = np.full(bound.shape, np.inf)

    def measure(lane: np.ndarray, detection: np.ndarray) -> None:
        distance[lane, detection] = relax[lane, 0] * pair_frechet(truth, detected, lane, detection)

    guess, every = bound.argmin(0), np.arange(len(detected))
    measure(guess, every)
    measure(*np.nonzero((bound <= distance[guess, every]) & np.isinf(distance)))
    return nearest_truth(distance)


def iou_distance(a: Float[np.ndarray, "t 2 2"], b: Float[np.ndarray, "u 2 2"]) -> Float[np.ndarray, "t u"]:
    """Return 1 - IoU of all pairs of boxes (corners, no +1 pixel convention); 1 where both have no area."""
    a, b = np.asarray(a, np.float64)[:, None], np.asarray(b, np.float64)[None]
    shared = np.minimum(a[..., 1, :], b[..., 1, :]) - np.maximum(a[..., 0, :], b[..., 0, :])
    shared = np.maximum(shared, 0.0).prod(-1)
    union = (a[..., 1, :] - a[..., 0, :]).prod(-1) + (b[..., 1, :] - b[..., 0, :]).prod(-1) - shared
    return 1.0 - shared / np.where(union > 0.0, union, 1.0)


@dataclass(frozen=True)
class MatchedFrame:
    """Matching results of one frame (K lane thresholds, P detections, G lanes).

    Attributes:
        scores: (P,).
        nearest: (P,) the lane that each detection is nearest to (relaxed Frechet distance).
        hits: (K, P) true positive.
        lanes: G.
        topology: by version (K, G): average precision of each lane as a vertex, outgoing plus incoming. v1.0 averages
            over ten confidence levels, v2.1 has one.
        elements: the part of the traffic elements, None without them.
    """

    scores: Float[np.ndarray, " p"]
    nearest: Int[np.ndarray, " p"]
    hits: Bool[np.ndarray, "k p"]
    lanes: int
    topology: dict[Version, Float[np.ndarray, "k g"]]
    elements: MatchedElements | None

    def owned(self, lanes: Bool[np.ndarray, " g"]) -> Bool[np.ndarray, " p"]:
        """Return which detections belong to some of the lanes: to the nearest one; without lanes, to none."""
        return lanes[self.nearest] if self.lanes else np.zeros(len(self.nearest), bool)

    def select(self, lanes: Bool[np.ndarray, " g"]) -> MatchedFrame:
        """Return the part of the frame that belongs to some of its lanes, from this same matching.

        Traffic elements are left out.
        """
        owned = self.owned(lanes)
        return MatchedFrame(
            scores=self.scores[owned],
            nearest=(np.cumsum(lanes) - 1)[self.nearest[owned]],
            hits=self.hits[:, owned],
            lanes=int(lanes.sum()),
            topology={version: precision[:, lanes] for version, precision in self.topology.items()},
            elements=None,
        )


@dataclass(frozen=True)
class MatchedElements:
    """Matching results of the traffic elements of one frame.

    Attributes:
        scores, attributes, hits: (U,) detections, matched inside their attribute.
        truths: (13,) number of true elements per attribute.
        topology: by version (K,): sum over lanes and elements of the vertex average precision.
        vertices: number of terms of that sum; 0 where lanes or elements are missing.
    """

    scores: Float[np.ndarray, " u"]
    attributes: Int[np.ndarray, " u"]
    hits: Bool[np.ndarray, " u"]
    truths: Int[np.ndarray, "13"]
    topology: dict[Version, Float[np.ndarray, " k"]]
    vertices: int


def match_frame(detections: LaneDetections, truth: LaneTruth, versions: Sequence[Version] = ("v2.1",)) -> MatchedFrame:
    """Match one frame once, with the topology of the given versions.

    Raises UserError for arrays that do not fit together.
    """
    check_kinds(detections, truth, (LaneDetections, LaneTruth))
    true_points, points = checked_lines(truth.points, "truth"), checked_lines(detections.points, "detections")
    return match_lanes(detections, truth, *nearest_lanes(true_points, points), versions)


def match_lanes(
    detections: LaneDetections,
    truth: LaneTruth,
    distance: Float[np.ndarray, " p"],
    nearest: Int[np.ndarray, " p"],
    versions: Sequence[Version] = ("v2.1",),
) -> MatchedFrame:
    """Match one frame whose detections are at `distance` from their `nearest` lanes; see `match_frame`."""
    g, p = len(truth.points), len(detections.points)
    edges = checked_edges(truth.successor, (g, g), "truth: successor")
    confidence = checked_confidence(detections.successor, (p, p), "detections: successor")
    scores = np.array(detections.scores)  # a copy, because the accumulator keeps it
    check_shape(scores, (p,), "detections: scores")

    taken = np.stack([greedy_match(distance < threshold, nearest, scores) for threshold in LANE_THRESHOLDS])
    levels: dict[Version, Int[np.ndarray, "k levels p"]] = {
        version: np.stack([matchings(scores, row, version) for row in taken]) for version in check_versions(versions)
    }
    topology: dict[Version, Float[np.ndarray, "k g"]] = {}
    for version, level in levels.items():
        rows = np.concatenate(level)
        precision = topology_precision(edges, confidence, rows, rows, FILL[version])
        topology[version] = precision.reshape(*level.shape[:2], 2, g).mean(1).sum(1)
    elements = None
    if truth.elements is not None and detections.elements is not None:
        elements = _match_elements(detections.elements, truth.elements, levels, g)
    return MatchedFrame(scores, nearest, taken >= 0, g, topology, elements)


def _match_elements(
    detections: ElementDetections,
    truth: ElementTruth,
    lane_levels: dict[Version, Int[np.ndarray, "k levels p"]],
    lanes: int,
) -> MatchedElements:
    """Match the traffic elements of a frame whose lanes are matched; `lane_levels` by version, -1 for no lane."""
    t, u, p = len(truth.boxes), len(detections.boxes), next(iter(lane_levels.values())).shape[-1]
    edges = checked_edges(truth.lane, (lanes, t), "truth: lane to element")
    confidence = checked_confidence(detections.lane, (p, u), "detections: lane to element")
    scores = np.array(detections.scores)  # a copy, because the accumulator keeps it
    check_shape(np.asarray(truth.boxes), (t, 2, 2), "truth: element boxes")
    check_shape(np.asarray(detections.boxes), (u, 2, 2), "detections: element boxes")
    check_shape(scores, (u,), "detections: element scores")
    possible = (0, ATTRIBUTES - 1)
    true_attributes = checked_numbers(truth.attributes, t, possible, "truth: element attributes")
    attributes = checked_numbers(detections.attributes, u, possible, "detections: element attributes")

    distance = iou_distance(truth.boxes, detections.boxes)
    inside = np.where(true_attributes[:, None] == attributes, distance, np.inf)
    # DET_t matches within an attribute, TOP_lt across attributes.
    within, taken = (
        greedy_match(least < ELEMENT_THRESHOLD, nearest, scores)
        for least, nearest in (nearest_truth(inside), nearest_truth(distance))
    )

    vertices = lanes + t if lanes and t else 0
    topology: dict[Version, Float[np.ndarray, " k"]] = {}
    for version, of_lanes in lane_levels.items():
        thresholds, levels = of_lanes.shape[:2]
        columns = np.tile(matchings(scores, taken, version), (thresholds, 1))
        precision = topology_precision(edges, confidence, np.concatenate(of_lanes), columns, FILL[version])
        topology[version] = precision.sum(-1).reshape(thresholds, levels).mean(1) * bool(vertices)
    return MatchedElements(
        scores=scores,
        attributes=attributes,
        hits=within >= 0,
        truths=np.bincount(true_attributes, minlength=ATTRIBUTES),
        topology=topology,
        vertices=vertices,
    )
