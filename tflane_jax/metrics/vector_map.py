"""MapTR's metrics of vectorised maps: average precision per class, and its mean (mAP).

Lines match by their Chamfer distance, or, in an optional metric that none of the papers reports, by the overlap (IoU)
of their buffers. Rules: docs/reference/metrics.md, section 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.buffers import buffers_touch
from tflane_jax.metrics.chamfer import PaddedLines, near_pairs, pair_chamfer
from tflane_jax.metrics.frames import Lines, check_shape
from tflane_jax.metrics.groups import BY_OCCLUSION, FrameGroup, GroupedMetrics, Partition
from tflane_jax.metrics.map_overlap import OVERLAP_DISTANCES, OVERLAP_THRESHOLDS, map_overlap
from tflane_jax.metrics.matching import average_precision_area, greedy_match, nearest_truth, pooled

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

_NAMES: dict[Measure, str] = {"chamfer": "MapTR Chamfer AP", "iou": "MapTR IoU AP"}
_VERSIONS: dict[Sampling, str] = {"maptr": "v1", "maptrv2": "v2", "as_given": "v1, detections not resampled"}
_THRESHOLDS: dict[Measure, tuple[float, ...]] = {"chamfer": MAP_THRESHOLDS, "iou": OVERLAP_THRESHOLDS}


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


class VectorMapMetrics:
    """Accumulator of MapTR's metric over frames; it keeps scores, classes and flags of detections, no geometry.

    Args:
        sampling: of the detections. "maptr": to 100 points, as in all official configurations
            (`eval_use_same_gt_sample_num_flag`); "maptrv2": the same, but lines of exactly 100 points stay unchanged;
            "as_given": none. Ground truth is always resampled, but for `MapTruth.sampled`.
        measure: of the distance of two lines: "chamfer" at `MAP_THRESHOLDS`, or "iou", the overlap of their buffers, at
            `OVERLAP_THRESHOLDS`, which needs shapely.
        dims: of the points. 3 is MapTRv2's variant for Argoverse 2: heights count in Chamfer distances, but neither in
            arc lengths nor in buffers.
    """

    def __init__(self, sampling: Sampling = "maptr", measure: Measure = "chamfer", dims: Dims = 2) -> None:
        self.sampling: Sampling = sampling
        self.measure: Measure = measure
        self.dims: Dims = dims
        self._frames = 0
        self._truths = np.zeros(len(LINE_CLASSES), np.int64)
        self._detections: list[tuple[np.ndarray, ...]] = []  # of every frame: scores, classes, hits

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        classes = ", with centerlines" if len(self.classes) > len(CLASSES) else ""
        heights = ", with heights" if self.dims == 3 else ""
        return f"{_NAMES[self.measure]} {_VERSIONS[self.sampling]}{heights}{classes}"

    @property
    def classes(self) -> tuple[str, ...]:
        """The measured classes: with centerlines if there are true ones."""
        return LINE_CLASSES if self._truths[len(CLASSES)] else CLASSES

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Thresholds of the measure: metres, or IoU."""
        return _THRESHOLDS[self.measure]

    def update(self, detections: MapDetections, truth: MapTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        self.add(match_map(detections, truth, self.sampling, self.measure, dims=self.dims))

    def add(self, frame: MatchedMap) -> None:
        """Add one frame that has been matched by this measure."""
        self._frames += 1
        self._truths += frame.truths
        self._detections.append((frame.scores, frame.classes.astype(np.int8), frame.hits))

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        settings = ("sampling", "measure", "dims")
        if any(getattr(self, name) != getattr(other, name) for name in settings):
            raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one sampling")
        merged = type(self)(self.sampling, self.measure, self.dims)
        for name in vars(self).keys() - set(settings):
            setattr(merged, name, getattr(self, name) + getattr(other, name))
        return merged

    def compute(self) -> dict[str, float]:
        """Return the metrics, 0 to 1, and what they count.

        - `frames`, `lines`: number of frames and of true lines;
        - `mAP`: mean over the `classes` of `AP_divider`, `AP_ped_crossing`, `AP_boundary` and `AP_centerline`, each the
          mean over the thresholds (`AP_divider@0.5` ...); a class without true lines counts 0, as officially;
        - `mAP@0.5`, `mAP@1.0`, `mAP@1.5`: mean at one threshold over the classes **with** true lines, as the official
          program prints it under its tables (0 if there is none). `mAP` is their mean only if no class is missing;
        - `recall`: fraction of the true lines that are found, whatever the confidence; mean over the thresholds.
        """
        thresholds, names = self.thresholds, self.classes
        scores, classes, hits = pooled(self._detections, (0,), (len(thresholds), 0))
        hits = hits.astype(bool)[:, classes < len(names)]
        scores, classes = scores[classes < len(names)], classes[classes < len(names)]
        truths = self._truths[: len(names)]
        precision = np.array(
            [
                [average_precision_area(scores[members], row[members], int(count)) for row in hits]
                for members, count in zip(classes == np.arange(len(names))[:, None], truths, strict=True)
            ]
        )
        at_threshold = precision.sum(0) / max((truths > 0).sum(), 1)
        found = hits.sum() / max(len(thresholds) * truths.sum(), 1)
        return (
            {"frames": self._frames, "lines": int(truths.sum()), "mAP": float(precision.mean())}
            | {f"AP_{name}": float(row.mean()) for name, row in zip(names, precision, strict=True)}
            | {"recall": float(found)}
            | {f"mAP@{t}": float(value) for t, value in zip(thresholds, at_threshold, strict=True)}
            | {
                f"AP_{name}@{t}": float(value)
                for name, row in zip(names, precision, strict=True)
                for t, value in zip(thresholds, row, strict=True)
            }
        )


class GroupedMapMetrics(GroupedMetrics["MatchedMap"]):
    """The metric of all lines and of the groups of a partition, see `metrics.groups`.

    Args:
        groups, frame_groups, lane_groups: see `GroupedMetrics`; lines take the place of lanes.
        partition: of the lines; default by occlusion.
        sampling, dims, measure: see `VectorMapMetrics`.
    """

    def __init__(
        self,
        groups: Sequence[str] | None = None,
        *,
        frame_groups: Sequence[str] = (),
        lane_groups: Sequence[str] = (),
        partition: Partition = BY_OCCLUSION,
        sampling: Sampling = "maptr",
        dims: Dims = 2,
        measure: Measure = "chamfer",
    ) -> None:
        self.sampling: Sampling = sampling
        self.dims: Dims = dims
        self.measure: Measure = measure
        make = partial(VectorMapMetrics, sampling, measure, dims)
        super().__init__(make, partition, groups, frame_groups=frame_groups, lane_groups=lane_groups)

    def update(
        self,
        detections: MapDetections,
        truth: MapTruth,
        frame_group: FrameGroup = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one frame; arguments as of `GroupedMetrics.add`.

        Raises UserError for arrays that do not fit together, or a visibility that is not known.
        """
        frame = match_map(detections, truth, self.sampling, self.measure, dims=self.dims, nearest="all")
        self.add(frame, truth, frame_group, members)


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
    true = PaddedLines.of(truth.points, "truth", dims)
    true_classes = _checked_classes(truth.classes, len(true), "truth")
    if (true.counts < 2).any():
        raise UserError(f"truth: line {int((true.counts < 2).argmax())} has a single point")
    if truth.sampled and (true.counts != SAMPLES).any():
        raise UserError(f"truth: sampled lines have {SAMPLES} points, not {int(true.counts.min())}")
    found = PaddedLines.of(detections.points, "detections", dims)
    classes = _checked_classes(detections.classes, len(found), "detections")
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
        number = _nearest_of_all(true, found, same, far, number)
    return MatchedMap(scores, classes, number, least, hits, true_classes)


def _nearest_of_all(
    true: PaddedLines,
    found: PaddedLines,
    same: Bool[np.ndarray, "g p"],
    far: Bool[np.ndarray, " p"],
    nearest: Int[np.ndarray, " p"],
) -> Int[np.ndarray, " p"]:
    """Return the nearest true line of every detection, also of the `far` ones, which the measure does not tell."""
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


def _checked_classes(classes: Int[np.ndarray, " n"], count: int, what: str) -> Int[np.ndarray, " n"]:
    classes = np.asarray(classes, np.int64)
    check_shape(classes, (count,), f"{what}: classes")
    if ((classes < 0) | (classes >= len(LINE_CLASSES))).any():
        raise UserError(f"{what}: classes must lie between 0 and {len(LINE_CLASSES) - 1}")
    return classes
