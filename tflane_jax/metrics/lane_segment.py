"""OpenLane-V2 lane-segment metrics, in two flavours: the devkit's (OLUS) and LaneSegNet's own (mAP).

A lane segment has a centerline and two side lines; areas are pedestrian crossings and road boundaries. Both flavours
give the same numbers for what they share: AP_ls is DET_l, TOP_lsls is TOP_ll (v2.1), AP_ped is the crossings' part of
DET_a. LaneSegNet and TF-Lane print the second. Rules: docs/reference/metrics.md, section 3. Matching:
`metrics.segment_matching`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, Self, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.bootstrap import Weights, bootstrap_precisions, frame_numbers, kept_in_sample
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS
from tflane_jax.metrics.frames import one_of
from tflane_jax.metrics.groups import Scope
from tflane_jax.metrics.matching import average_precision_11, pooled
from tflane_jax.metrics.merging import by_frame, joined
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics, overall_score
from tflane_jax.metrics.segment_matching import (
    AREA_THRESHOLDS,
    BOUNDARY,
    CROSSING,
    MatchedSegments,
    SegmentDetections,
    SegmentTruth,
    match_segments,
)

Flavour = Literal["OpenLane-V2", "LaneSegNet"]
T = TypeVar("T")
_CATEGORIES = {"crossing": CROSSING, "boundary": BOUNDARY}
_SHORT = {"crossing": "ped", "boundary": "boundary"}


class LaneSegmentMetrics:
    """Accumulator of the lane-segment metrics over frames; it keeps scores and flags of detections, no geometry.

    Args:
        flavour: "OpenLane-V2" gives DET_l, DET_a, DET_t, TOP_ll, TOP_lt and OLUS; "LaneSegNet" AP_ls, AP_ped, mAP and
            TOP_lsls, and needs no traffic elements.
    """

    def __init__(self, flavour: Flavour = "OpenLane-V2") -> None:
        self.flavour: Flavour = one_of("flavour", flavour, Flavour)
        self._lanes = CenterlineMetrics(("v2.1",))
        self._area_detections: list[tuple[np.ndarray, ...]] = []  # of every frame: scores, categories, hits
        self._frame_areas: list[np.ndarray] = []  # of every frame: true areas by category
        # By threshold, over matched pairs: pairs, sum of distances; pairs with types, sum of wrong fractions.
        self._errors = np.zeros((4, len(LANE_THRESHOLDS)))

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        if self.flavour == "LaneSegNet":
            return "LaneSegNet lane segments (TOP_lsls v2.1)"
        return "OpenLane-V2 lane segments v2.1"

    def update(self, detections: SegmentDetections, truth: SegmentTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        self.add(match_segments(detections, truth, elements=self.flavour == "OpenLane-V2"))

    def match(self, detections: SegmentDetections, truth: SegmentTruth) -> MatchedSegments:
        """Match one frame for groups, with the nearest segment of every detection, however far; raises as `update`."""
        return match_segments(detections, truth, nearest="all", elements=self.flavour == "OpenLane-V2")

    def add(self, frame: MatchedSegments) -> None:
        """Add one frame that has been matched."""
        segments, areas = frame.segments, frame.areas
        self._lanes.add(replace(segments, elements=None) if self.flavour == "LaneSegNet" else segments)
        self._area_detections.append((areas.scores, areas.categories, areas.hits))
        self._frame_areas.append(areas.truths)
        self._errors[:2] += segments.hits.sum(1), segments.hits @ frame.distance
        if frame.wrong is not None:
            self._errors[2:] += segments.hits.sum(1), segments.hits @ frame.wrong

    def merge(self, *others: Self) -> Self:
        """Return an accumulator of the frames of all, in this order (none changes)."""
        for other in others:
            if self.flavour != other.flavour:
                raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one flavour")
        merged = type(self)(self.flavour)
        merged._lanes = self._lanes.merge(*(other._lanes for other in others))
        for name in vars(self).keys() - {"flavour", "_lanes"}:
            setattr(merged, name, joined([getattr(each, name) for each in (self, *others)]))
        return merged

    def compute(self, scope: Scope = "all") -> dict[str, float]:
        """Return the metrics of the flavour, 0 to 1, and what they count.

        - both: `frames`, `lanes`, the areas by threshold, `crossing@0.5` ... `boundary@1.5`, and the mean errors of the
          pairs that the AP matches at 3 m (`AE_dist@1.0` ... at each threshold): `AE_dist`, Chamfer distance in metres,
          mean of centerline, left and right line; `AE_type`, fraction of wrong boundary types. They are missing without
          pairs, `AE_type` also without types;
        - "OpenLane-V2": as `CenterlineMetrics.compute`, with `DET_a` and, where there are traffic elements, `OLUS`
          instead of `OLS`;
        - "LaneSegNet": `AP_ls` and `AP_ls@1.0` ..., `AP_ped`, `AP_boundary`, `mAP` (of the first two), `TOP_lsls`, and
          `recall` and `AP_l` as `CenterlineMetrics.compute`.

        Of the whole test set (`scope` "all"), a category without true areas counts, as officially: 1 without detections
        of it, else 0. Some of the frames, which may lack a category, have no number of one without true areas, and
        `mAP` and `DET_a` are means over the others; `DET_a` and `OLUS` are missing without any. Some of the segments
        (`scope` "lanes") have no areas, and therefore none of the numbers that rest on areas.
        """
        truths = self._true_areas.sum(0)
        return self._numbers(self._lanes.compute(), np.ones(len(truths), bool) if scope == "all" else truths > 0, scope)

    def compute_sample(self, whole: Self) -> dict[str, float]:
        """Return the metrics of frames that were drawn from a whole test set; `compute` has the names.

        A category of areas that the test set has and the sample lacks is left out, as an attribute of traffic elements
        is: 0, as officially where there are detections of it, would be the luck of the draw.
        """
        counted = kept_in_sample(self._true_areas.sum(0), whole._true_areas.sum(0))
        return self._numbers(self._lanes.compute_sample(whole._lanes), counted, "all")

    def _numbers(self, lanes: dict[str, float], counted: Bool[np.ndarray, "3"], scope: Scope) -> dict[str, float]:
        """Return the metrics, given those of segments, and which categories of areas count."""
        scores, categories, hits = pooled(self._area_detections, (0,), (len(AREA_THRESHOLDS), 0))
        truths = self._true_areas.sum(0)
        areas: dict[str, list[float]] = {}
        for name, category in _CATEGORIES.items():
            if counted[category]:
                own, total = categories == category, int(truths[category])
                areas[name] = [average_precision_11(scores[own], row[own], total) for row in hits]
        derived = {name: float(value) for name, value in self._derived(lanes, areas, counted).items()}
        at_threshold = {
            f"{name}@{threshold}": value
            for name, values in areas.items()
            for threshold, value in zip(AREA_THRESHOLDS, values, strict=True)
        }
        if self.flavour == "LaneSegNet":
            count = {name: lanes[name] for name in ("frames", "lanes")}
            segments = {f"AP_ls@{t}": lanes[f"DET_l@{t}"] for t in LANE_THRESHOLDS}
            found = {name: value for name, value in lanes.items() if name == "AP_l" or name.startswith("recall")}
            lanes, derived = count, derived | segments | found
        lanes.pop("OLS", None)
        return _in_scope(lanes | derived | at_threshold | self._matched_errors(), scope)

    def means(self) -> dict[str, Float[np.ndarray, "f 2"]]:
        """Return the scores that are means over vertices, see `CenterlineMetrics.means`."""
        lanes = self._lanes.means()
        return {"TOP_lsls": lanes["TOP_ll"]} if self.flavour == "LaneSegNet" else lanes

    def bootstrap(self, weights: Weights, scope: Scope = "all") -> dict[str, Float[np.ndarray, " b"]]:
        """Return AP, mAP, DET, TOP and OLUS of samples that count the frames as often as `weights` says.

        Categories of areas are those of `compute`. The AP of one that a sample lacks is 0, and does not count in its
        `mAP` or `DET_a`; `DET_a` is 0 where none counts.
        """
        lanes = self._lanes.bootstrap(weights)
        scores, categories, hits = pooled(self._area_detections, (0,), (len(AREA_THRESHOLDS), 0))
        frame, truths = frame_numbers(self._area_detections), self._true_areas
        whole = truths.sum(0)
        areas = {}
        for name, category in _CATEGORIES.items():
            if scope == "all" or whole[category]:
                own = categories == category
                eleven, _ = bootstrap_precisions(scores[own], hits[:, own], frame[own], truths[:, category], weights)
                areas[name] = list(eleven.T)
        derived = self._derived(lanes, areas, kept_in_sample(weights @ truths, whole).T)
        if self.flavour == "LaneSegNet":
            lanes = {"AP_l": lanes["AP_l"]}
        lanes.pop("OLS", None)
        return _in_scope(lanes | derived, scope)

    @property
    def _true_areas(self) -> Int[np.ndarray, "f 3"]:
        """True areas of every frame by category."""
        return by_frame(self._frame_areas, (BOUNDARY + 1,), int)

    def _derived(
        self, lanes: Mapping[str, Any], areas: Mapping[str, Sequence[Any]], counted: Bool[np.ndarray, "3 *b"]
    ) -> dict[str, Any]:
        """Return the scores that the flavour makes of numbers, or of arrays of samples.

        Args:
            lanes: scores of segments, named as those of centerlines.
            areas: of each measured category, the average precision at every threshold.
            counted: which categories count (in each sample), of those that are measured.
        """
        precision = {name: np.mean(values, axis=0) for name, values in areas.items()}
        weight = {name: counted[_CATEGORIES[name]].astype(float) for name in areas}
        if self.flavour == "LaneSegNet":
            ap_ls, crossing = lanes["DET_l"], weight.get("crossing", 0.0)
            mean = (ap_ls + crossing * precision.get("crossing", 0.0)) / (1.0 + crossing)
            means = {f"AP_{_SHORT[name]}": value for name, value in precision.items()}
            return {"AP_ls": ap_ls} | means | {"mAP": mean, "TOP_lsls": lanes["TOP_ll"]}
        if not areas:
            return {}
        det_a = sum(weight[name] * precision[name] for name in areas) / np.maximum(sum(weight.values()), 1.0)
        if "DET_t" not in lanes:  # no traffic elements, or a sample without them
            return {"DET_a": det_a}
        topology = [lanes["TOP_ll"], lanes["TOP_lt"]]
        return {"DET_a": det_a, "OLUS": overall_score([lanes["DET_l"], det_a, lanes["DET_t"]], topology)}

    def _matched_errors(self) -> dict[str, float]:
        errors = {}
        for name, (pairs, total) in zip(("AE_dist", "AE_type"), self._errors.reshape(2, 2, -1), strict=True):
            means = {f"{name}@{t}": float(s / n) for t, n, s in zip(LANE_THRESHOLDS, pairs, total, strict=True) if n}
            if pairs[-1]:
                errors |= {name: means[f"{name}@{LANE_THRESHOLDS[-1]}"]} | means
        return errors


def _in_scope(values: dict[str, T], scope: Scope) -> dict[str, T]:
    """Return the numbers that the scope has: some of the segments have none of areas."""
    return {name: value for name, value in values.items() if scope != "lanes" or not _of_areas(name)}


def _of_areas(name: str) -> bool:
    return name in ("AP_ped", "AP_boundary", "mAP", "DET_a", "OLUS") or name.startswith(("crossing@", "boundary@"))
