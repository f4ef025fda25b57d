"""Lines of a vector map in one frame: truth, detections, and their matching by MapTR's rules.

Rules: docs/reference/metrics.md, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.buffers import buffers_touch
from tflane_jax.metrics.chamfer import PaddedLines, near_pairs, pair_chamfer
from tflane_jax.metrics.frames import Lines, check_kinds, check_shape, checked_numbers
from tflane_jax.metrics.map_overlap import OVERLAP_DISTANCES, map_overlap
from tflane_jax.metrics.matching import greedy_match, nearest_truth

Sampling = Literal["maptr", "maptrv2", "as_given"]
Measure = Literal["chamfer", "iou"]
Dims = Literal[2, 3]
CLASSES = ("divider", "ped_crossing", "boundary")
LINE_CLASSES = (*CLASSES, "centerline")
"""With the fourth class of MapTRv2, in the order of `scene.LineClass`."""
MAP_THRESHOLDS = (0.5, 1.0, 1.5)  # metres, Chamfer
SAMPLES = 100  # points on a resampled line
BUFFER = 2.0  # metres to each side of a line; only lines whose buffers touch are compared

# Every so many vertices of a resampled line are compared to find the nearest true line beyond the thresholds.
_COARSE = 6


@dataclass(frozen=True)
class MapTruth:
    """Map elements of one frame: G lines.

    Attributes:
        points: G polylines (n, 2 or 3), metres; each may have its own n >= 2. Closed ones repeat their first vertex.
        classes: (G,) 0 divider, 1 pedestrian crossing, 2 boundary, 3 centerline.
        visibility: (G,) fraction in direct line of sight, for groups by occlusion; None if it is not known.
        identity: (G,) number of the line, the same in every frame of a scene, for `metrics.consistency`; None if it is
            not known.
        sampled: whether each line is `SAMPLES` points, equally spaced along the original line; they stay as they are.
    """

    points: Lines
    classes: Int[np.ndarray, " g"]
    visibility: Float[np.ndarray, " g"] | None = None
    identity: Int[np.ndarray, " g"] | None = None
    sampled: bool = False


@dataclass(frozen=True)
class MapDetections:
    """Detected map elements of one frame: P lines.

    Attributes:
        points: P polylines (n, 2 or 3), metres; each may have its own n. Lines of one point are ignored, as officially.
        classes: (P,) 0 divider, 1 pedestrian crossing, 2 boundary, 3 centerline.
        scores: (P,) confidence; only the order counts.
    """

    points: Lines
    classes: Int[np.ndarray, " p"]
    scores: Float[np.ndarray, " p"]


@dataclass(frozen=True)
class MatchedMap:
    """Matching results of one frame, without detections of a single point.

    Attributes:
        scores, classes: (P,).
        nearest: (P,) the true line nearest to each detection; beyond the largest threshold see `match_map`.
        distance: (P,) Chamfer distance to it, metres, or 1 - IoU; inf beyond the largest threshold.
        hits: (K, P) true positive.
        true_classes: (G,) classes of the true lines.
    """

    scores: Float[np.ndarray, " p"]
    classes: Int[np.ndarray, " p"]
    nearest: Int[np.ndarray, " p"]
    distance: Float[np.ndarray, " p"]
    hits: Bool[np.ndarray, "k p"]
    true_classes: Int[np.ndarray, " g"]

    @property
    def truths(self) -> Int[np.ndarray, "4"]:
        """Number of true lines of each class."""
        return np.bincount(self.true_classes, minlength=len(LINE_CLASSES))

    @property
    def lanes(self) -> int:
        """Number of true lines."""
        return len(self.true_classes)

    def detections(self, kept: Bool[np.ndarray, " p"]) -> MatchedMap:
        """Return the frame with some of its detections."""
        arrays = {name: getattr(self, name)[kept] for name in ("scores", "classes", "nearest", "distance")}
        return replace(self, **arrays, hits=self.hits[:, kept])

    def select(self, lanes: Bool[np.ndarray, " g"]) -> MatchedMap:
        """Return the part of the frame that belongs to some of its lines; needs `nearest` of all detections."""
        same = np.isin(self.classes, self.true_classes)
        near = np.append(lanes, False)[np.where(same, self.nearest, len(lanes))]
        part = self.detections(near)
        number = np.cumsum(lanes) - 1
        return replace(part, nearest=number[part.nearest], true_classes=self.true_classes[lanes])


def match_map(
    detections: MapDetections,
    truth: MapTruth,
    sampling: Sampling = "maptr",
    measure: Measure = "chamfer",
    *,
    dims: Dims = 2,
    nearest: Literal["close", "all"] = "close",
) -> MatchedMap:
    """Match one frame, all classes at once: only lines of the same class are compared.

    Args:
        detections, truth: lines of one frame.
        sampling, measure, dims: see `VectorMapMetrics`.
        nearest: of detections beyond the largest threshold, or without overlap: "close" leaves it arbitrary, "all"
            finds it by the Chamfer distance of every `_COARSE`-th vertex.
    """
    check_kinds(detections, truth, (MapDetections, MapTruth))
    true = PaddedLines.of(truth.points, "truth", dims)
    possible = (0, len(LINE_CLASSES) - 1)
    true_classes = checked_numbers(truth.classes, len(true), possible, "truth: classes")
    if (true.counts < 2).any():
        raise UserError(f"truth: line {int((true.counts < 2).argmax())} has a single point")
    if truth.sampled and (true.counts != SAMPLES).any():
        raise UserError(f"truth: sampled lines have {SAMPLES} points, not {int(true.counts.min())}")
    found = PaddedLines.of(detections.points, "detections", dims)
    classes = checked_numbers(detections.classes, len(found), possible, "detections: classes")
    scores = np.asarray(detections.scores)
    check_shape(scores, (len(found),), "detections: scores")
    lines = found.counts >= 2
    found, classes, scores = found.select(lines), classes[lines], scores[lines]

    true = true if truth.sampled else true.resampled(SAMPLES)
    same, found = true_classes[:, None] == classes, _sampled(found, sampling)
    if measure == "iou":
        distance = np.where(same, 1.0 - map_overlap(true, found, same), np.inf)
        limits = OVERLAP_DISTANCES
    else:
        distance, limits = map_distance(true, found, same), MAP_THRESHOLDS
    least, number = nearest_truth(distance)
    hits = np.stack([greedy_match(least <= limit, number, scores) >= 0 for limit in limits])
    if nearest == "all":
        far = least >= 1.0 if measure == "iou" else np.isinf(least)
        # The lines that are compared, or as many points on each: groups depend on no other line of the frame.
        number = _nearest_of_all(true, found.resampled(SAMPLES) if sampling == "as_given" else found, same, far, number)
    return MatchedMap(scores, classes, number, least, hits, true_classes)


def _nearest_of_all(
    true: PaddedLines,
    found: PaddedLines,
    same: Bool[np.ndarray, "g p"],
    far: Bool[np.ndarray, " p"],
    nearest: Int[np.ndarray, " p"],
) -> Int[np.ndarray, " p"]:
    """Return the nearest true line of every detection, also of the `far` ones, for which `nearest` is arbitrary."""
    i, j = np.nonzero(same & far)
    rough_true, rough_found = (
        PaddedLines(points, np.full(len(points), points.shape[1]))
        for points in (lines.points[:, ::_COARSE] for lines in (true, found))
    )
    distance = np.full(same.shape, np.inf)
    distance[i, j] = pair_chamfer(rough_true, rough_found, i, j)
    return np.where(far, nearest_truth(distance)[1], nearest)


def map_distance(true: PaddedLines, found: PaddedLines, same: Bool[np.ndarray, "g p"]) -> Float[np.ndarray, "g p"]:
    """Return the Chamfer distances up to the largest threshold, metres; inf beyond it and where `same` is false.

    Also inf if the buffers of the lines (2 m to each side) do not touch: the official program does not compare such
    pairs, for example short pieces that lie end to end.
    """
    i, j = near_pairs(true, found, MAP_THRESHOLDS[-1], same)
    chamfer = pair_chamfer(true, found, i, j)
    close = chamfer <= MAP_THRESHOLDS[-1]
    i, j, chamfer = i[close], j[close], chamfer[close]
    distance = np.full(same.shape, np.inf)
    distance[i, j] = np.where(buffers_touch(true.points[..., :2], found.points[..., :2], i, j, BUFFER), chamfer, np.inf)
    return distance


def _sampled(lines: PaddedLines, sampling: Sampling) -> PaddedLines:
    if sampling == "as_given":
        return lines
    resampled = lines.resampled(SAMPLES)
    if sampling == "maptrv2" and lines.points.shape[1] >= SAMPLES:
        kept = (lines.counts == SAMPLES)[:, None, None]
        return PaddedLines(np.where(kept, lines.points[:, :SAMPLES], resampled.points), resampled.counts)
    return resampled
