"""MapTR's metric of vectorised maps: average precision by Chamfer distance, per class, and its mean (mAP).

Rules: docs/reference/metrics.md, section 4. The optional metric by overlap of buffers (`iou`) is not implemented: none
of the papers reports it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.buffers import buffers_touch
from tflane_jax.metrics.chamfer import PaddedLines, near_pairs, pair_chamfer
from tflane_jax.metrics.frames import Lines, check_shape
from tflane_jax.metrics.matching import average_precision_area, greedy_match, nearest_truth, pooled

Sampling = Literal["maptr", "maptrv2", "as_given"]
CLASSES = ("divider", "ped_crossing", "boundary")
MAP_THRESHOLDS = (0.5, 1.0, 1.5)  # metres, Chamfer
SAMPLES = 100  # points on a resampled line
BUFFER = 2.0  # metres to each side of a line; only lines whose buffers touch are compared

_PROTOCOLS: dict[Sampling, str] = {
    "maptr": "MapTR Chamfer AP v1",
    "maptrv2": "MapTR Chamfer AP v2",
    "as_given": "MapTR Chamfer AP v1, detections not resampled",
}


@dataclass(frozen=True)
class MapTruth:
    """Map elements of one frame: G lines.

    Attributes:
        points: G polylines (n, 2), metres; each may have its own n >= 2. Closed ones repeat their first vertex.
        classes: (G,) 0 divider, 1 pedestrian crossing, 2 boundary.
    """

    points: Lines
    classes: Int[np.ndarray, " g"]


@dataclass(frozen=True)
class MapDetections:
    """Detected map elements of one frame: P lines.

    Attributes:
        points: P polylines (n, 2), metres; each may have its own n. Lines of one point are ignored, as officially.
        classes: (P,) 0 divider, 1 pedestrian crossing, 2 boundary.
        scores: (P,) confidence; only the order counts.
    """

    points: Lines
    classes: Int[np.ndarray, " p"]
    scores: Float[np.ndarray, " p"]


class VectorMapMetrics:
    """Accumulator of MapTR's metric over frames; it keeps scores, classes and flags of detections, no geometry.

    Args:
        sampling: of the detections. "maptr": to 100 points, as in all official configurations
            (`eval_use_same_gt_sample_num_flag`); "maptrv2": the same, but lines of exactly 100 points stay unchanged;
            "as_given": none. Ground truth is always resampled.
    """

    def __init__(self, sampling: Sampling = "maptr") -> None:
        self.sampling: Sampling = sampling
        self._frames = 0
        self._truths = np.zeros(len(CLASSES), np.int64)
        self._detections: list[tuple[np.ndarray, ...]] = []  # of every frame: scores, classes, hits

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        return _PROTOCOLS[self.sampling]

    def update(self, detections: MapDetections, truth: MapTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        frame = match_map(detections, truth, self.sampling)
        self._frames += 1
        self._truths += frame.truths
        self._detections.append((frame.scores, frame.classes.astype(np.int8), frame.hits))

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        if self.sampling != other.sampling:
            raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one sampling")
        merged = type(self)(self.sampling)
        for name in vars(self).keys() - {"sampling"}:
            setattr(merged, name, getattr(self, name) + getattr(other, name))
        return merged

    def compute(self) -> dict[str, float]:
        """Return the metrics, 0 to 1, and what they count.

        - `frames`, `lines`: number of frames and of true lines;
        - `mAP`: mean over the three classes of `AP_divider`, `AP_ped_crossing` and `AP_boundary`, each the mean over
          the thresholds (`AP_divider@0.5` ...); a class without true lines counts 0, as officially;
        - `mAP@0.5`, `mAP@1.0`, `mAP@1.5`: mean at one threshold over the classes **with** true lines, as the official
          program prints it under its tables (0 if there is none). `mAP` is their mean only if no class is missing.
        """
        scores, classes, hits = pooled(self._detections, (0,), (len(MAP_THRESHOLDS), 0))
        precision = np.array(
            [
                [average_precision_area(scores[members], row[members], int(count)) for row in hits]
                for members, count in zip(classes == np.arange(len(CLASSES))[:, None], self._truths, strict=True)
            ]
        )
        present = self._truths > 0
        at_threshold = precision.sum(0) / max(present.sum(), 1)
        return (
            {"frames": self._frames, "lines": int(self._truths.sum()), "mAP": float(precision.mean())}
            | {f"AP_{name}": float(row.mean()) for name, row in zip(CLASSES, precision, strict=True)}
            | {f"mAP@{t}": float(value) for t, value in zip(MAP_THRESHOLDS, at_threshold, strict=True)}
            | {
                f"AP_{name}@{t}": float(value)
                for name, row in zip(CLASSES, precision, strict=True)
                for t, value in zip(MAP_THRESHOLDS, row, strict=True)
            }
        )


@dataclass(frozen=True)
class MatchedMap:
    """Matching results of one frame, without detections of a single point.

    Attributes:
        scores, classes: (P,).
        nearest: (P,) the true line nearest to each detection; arbitrary beyond the largest threshold.
        distance: (P,) Chamfer distance to it, metres; inf beyond the largest threshold.
        hits: (K, P) true positive.
        truths: (3,) number of true lines of each class.
    """

    scores: Float[np.ndarray, " p"]
    classes: Int[np.ndarray, " p"]
    nearest: Int[np.ndarray, " p"]
    distance: Float[np.ndarray, " p"]
    hits: Bool[np.ndarray, "k p"]
    truths: Int[np.ndarray, "3"]


def match_map(detections: MapDetections, truth: MapTruth, sampling: Sampling = "maptr") -> MatchedMap:
    """Match one frame, all classes at once: only lines of the same class are compared."""
    true = PaddedLines.of(truth.points, "truth", dims=2)
    true_classes = _checked_classes(truth.classes, len(true), "truth")
    if (true.counts < 2).any():
        raise UserError(f"truth: line {int((true.counts < 2).argmax())} has a single point")
    found = PaddedLines.of(detections.points, "detections", dims=2)
    classes = _checked_classes(detections.classes, len(found), "detections")
    scores = np.asarray(detections.scores)
    check_shape(scores, (len(found),), "detections: scores")
    lines = found.counts >= 2
    found, classes, scores = found.select(lines), classes[lines], scores[lines]

    distance = map_distance(true.resampled(SAMPLES), _sampled(found, sampling), true_classes[:, None] == classes)
    least, nearest = nearest_truth(distance)
    hits = np.stack([greedy_match(least <= threshold, nearest, scores) >= 0 for threshold in MAP_THRESHOLDS])
    return MatchedMap(scores, classes, nearest, least, hits, np.bincount(true_classes, minlength=len(CLASSES)))


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
    distance[i, j] = np.where(buffers_touch(true.points, found.points, i, j, BUFFER), chamfer, np.inf)
    return distance


def _sampled(lines: PaddedLines, sampling: Sampling) -> PaddedLines:
    if sampling == "as_given":
        return lines
    resampled = lines.resampled(SAMPLES)
    if sampling == "maptrv2" and lines.points.shape[1] >= SAMPLES:
        kept = (lines.counts == SAMPLES)[:, None, None]
        return PaddedLines(np.where(kept, lines.points[:, :SAMPLES], resampled.points), resampled.counts)
    return resampled


def _checked_classes(classes: Int[np.ndarray, " n"], count: int, what: str) -> Int[np.ndarray, " n"]:
    classes = np.asarray(classes, np.int64)
    check_shape(classes, (count,), f"{what}: classes")
    if ((classes < 0) | (classes >= len(CLASSES))).any():
        raise UserError(f"{what}: classes must lie between 0 and {len(CLASSES) - 1}")
    return classes
