"""MapTR's metrics of vectorised maps: average precision per class, and its mean (mAP).

Lines match by their Chamfer distance, or, in an optional metric that none of the papers reports, by the overlap (IoU)
of their buffers. Rules: docs/reference/metrics.md, section 4. Matching: `metrics.map_matching`.
"""

from __future__ import annotations

from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.bootstrap import Weights, bootstrap_precisions, frame_numbers, kept_in_sample
from tflane_jax.metrics.frames import one_of
from tflane_jax.metrics.groups import Scope
from tflane_jax.metrics.map_matching import (
    CLASSES,
    LINE_CLASSES,
    MAP_THRESHOLDS,
    Dims,
    MapDetections,
    MapTruth,
    MatchedMap,
    Measure,
    Sampling,
    match_map,
)
from tflane_jax.metrics.map_overlap import OVERLAP_THRESHOLDS
from tflane_jax.metrics.matching import average_precision_area, pooled, ranked
from tflane_jax.metrics.merging import by_frame, joined

_NAMES: dict[Measure, str] = {"chamfer": "MapTR Chamfer AP", "iou": "MapTR IoU AP"}
_VERSIONS: dict[Sampling, str] = {"maptr": "v1", "maptrv2": "v2", "as_given": "v1, detections not resampled"}
_THRESHOLDS: dict[Measure, tuple[float, ...]] = {"chamfer": MAP_THRESHOLDS, "iou": OVERLAP_THRESHOLDS}


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
        self.sampling: Sampling = one_of("sampling", sampling, Sampling)
        self.measure: Measure = one_of("measure", measure, Measure)
        self.dims: Dims = one_of("dims", dims, Dims)
        self._detections: list[tuple[np.ndarray, ...]] = []  # of every frame: scores, classes, hits
        self._frame_truths: list[np.ndarray] = []  # of every frame: true lines by class

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        classes = ", with centerlines" if self._truths[:, len(CLASSES)].any() else ""
        heights = ", with heights" if self.dims == 3 else ""
        return f"{_NAMES[self.measure]} {_VERSIONS[self.sampling]}{heights}{classes}"

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Thresholds of the measure: metres, or IoU."""
        return _THRESHOLDS[self.measure]

    def update(self, detections: MapDetections, truth: MapTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        self.add(match_map(detections, truth, self.sampling, self.measure, dims=self.dims))

    def match(self, detections: MapDetections, truth: MapTruth) -> MatchedMap:
        """Match one frame for groups, with the nearest line of every detection, however far; raises as `update`."""
        return match_map(detections, truth, self.sampling, self.measure, dims=self.dims, nearest="all")

    def add(self, frame: MatchedMap) -> None:
        """Add one frame that has been matched by this measure."""
        self._frame_truths.append(frame.truths)
        self._detections.append((frame.scores, frame.classes.astype(np.int8), frame.hits))

    def merge(self, *others: Self) -> Self:
        """Return an accumulator of the frames of all, in this order (none changes)."""
        settings = ("sampling", "measure", "dims")
        for other in others:
            if any(getattr(self, name) != getattr(other, name) for name in settings):
                raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one sampling")
        merged = type(self)(self.sampling, self.measure, self.dims)
        for name in vars(self).keys() - set(settings):
            setattr(merged, name, joined([getattr(each, name) for each in (self, *others)]))
        return merged

    def compute(self, scope: Scope = "all") -> dict[str, float]:
        """Return the metrics, 0 to 1, and what they count.

        - `frames`, `lines`: number of frames and of true lines;
        - `mAP`: mean over classes of `AP_divider`, `AP_ped_crossing`, `AP_boundary` and `AP_centerline`, each the mean
          over the thresholds (`AP_divider@0.5` ...). Of the whole test set (`scope` "all"), a class without true lines
          counts 0, as officially, except centerlines, which have no AP then. In a part, which may lack a class, no
          class without true lines has an AP, and without any there is no `mAP`;
        - `mAP@0.5`, `mAP@1.0`, `mAP@1.5`: mean at one threshold over the classes **with** true lines, as the official
          program prints it under its tables (0 if there is none). `mAP` is their mean only if no class is missing;
        - `recall`: fraction of the true lines that are found, whatever the confidence; mean over the thresholds.
        """
        return self._numbers(_counted(self._truths.sum(0), scope))

    def compute_sample(self, whole: VectorMapMetrics) -> dict[str, float]:
        """Return the metrics of frames that were drawn from a whole test set; `compute` has the names.

        A class that the test set has and the sample lacks is left out: 0, as officially, would be the luck of the draw.
        """
        return self._numbers(counted_in_sample(self._truths.sum(0), whole._truths.sum(0), "all"))

    def _numbers(self, counted: Bool[np.ndarray, "4"]) -> dict[str, float]:
        thresholds, truths = self.thresholds, self._truths.sum(0)
        scores, classes, hits = ranked(*pooled(self._detections, (0,), (len(thresholds), 0)))
        hits, lines = hits.astype(bool), int(truths.sum())
        precision: dict[str, list[float]] = {}
        for c in np.flatnonzero(counted).tolist():
            own, total = classes == c, int(truths[c])
            precision[LINE_CLASSES[c]] = [average_precision_area(scores[own], row[own], total) for row in hits]
        mean, at_threshold = {}, {}
        if precision:
            table = np.array(list(precision.values()))
            mean["mAP"] = float(mean_precision(table, np.ones(len(table), bool)))
            present = max((truths > 0).sum(), 1)
            at_threshold = {f"mAP@{t}": float(p) for t, p in zip(thresholds, table.sum(0) / present, strict=True)}
        return (
            {"frames": len(self._frame_truths), "lines": lines}
            | mean
            | {f"AP_{name}": float(np.mean(row)) for name, row in precision.items()}
            | {"recall": float(hits.sum() / max(len(thresholds) * lines, 1))}
            | at_threshold
            | {f"AP_{name}@{t}": row[k] for name, row in precision.items() for k, t in enumerate(thresholds)}
        )

    def means(self) -> dict[str, Float[np.ndarray, "f 2"]]:
        """Return no score: all but recall rank detections."""
        return {}

    def bootstrap(self, weights: Weights, scope: Scope = "all") -> dict[str, Float[np.ndarray, " b"]]:
        """Return `mAP` and the `AP_...` of classes in samples that count the frames as often as `weights` says.

        Classes are those of `compute`. An AP that a sample lacks is 0, and does not count in its `mAP`.
        """
        scores, classes, hits = pooled(self._detections, (0,), (len(self.thresholds), 0))
        frame, truths, precision = frame_numbers(self._detections), self._truths, {}
        measured = np.flatnonzero(_counted(truths.sum(0), scope))
        for c in measured:
            own = classes == c
            _, area = bootstrap_precisions(scores[own], hits[:, own], frame[own], truths[:, c], weights)
            precision[f"AP_{LINE_CLASSES[c]}"] = area.mean(1)
        if not precision:
            return {}
        counted = counted_in_sample((weights @ truths).T, truths.sum(0)[:, None], scope)[measured]
        return {"mAP": mean_precision(np.stack(list(precision.values()))[:, None], counted)} | precision

    @property
    def _truths(self) -> Int[np.ndarray, "f 4"]:
        """True lines of every frame by class."""
        return by_frame(self._frame_truths, (len(LINE_CLASSES),), int)


def _counted(truths: Int[np.ndarray, "c *b"], scope: Scope) -> Bool[np.ndarray, "c *b"]:
    """Return which classes count in mAP: those with true lines, and in the whole test set all but centerlines."""
    counted = truths > 0
    if scope == "all":
        counted[: len(CLASSES)] = True
    return counted


def counted_in_sample(
    truths: Int[np.ndarray, "c *b"], whole: Int[np.ndarray, "c *#b"], scope: Scope
) -> Bool[np.ndarray, "c *b"]:
    """Return which classes of `_counted` count in a sample: not those of the whole test set that the sample lacks."""
    return _counted(truths, scope) & kept_in_sample(truths, whole)


def mean_precision(
    precision: Float[np.ndarray, "c k *b"], counted: Bool[np.ndarray, "c *b"]
) -> Float[np.ndarray, "*b"]:
    """Return the mean over the counted classes and over the thresholds; 0 where no class counts."""
    total = np.where(counted[:, None], precision, 0.0).sum((0, 1))
    return total / np.maximum(precision.shape[1] * counted.sum(0), 1)
