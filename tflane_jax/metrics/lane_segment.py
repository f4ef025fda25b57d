"""OpenLane-V2 lane-segment metrics, in two flavours: the devkit's (OLUS) and LaneSegNet's own (mAP).

A lane segment has a centerline and two side lines; areas are pedestrian crossings and road boundaries. Both flavours
give the same numbers for what they share: AP_ls is DET_l, TOP_lsls is TOP_ll (v2.1), AP_ped is the crossings' part of
DET_a. LaneSegNet and TF-Lane print the second. Rules: docs/reference/metrics.md, section 3. Matching:
`metrics.segment_matching`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, Self, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.errors import UserError
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS
from tflane_jax.metrics.groups import BY_OCCLUSION, FrameGroup, GroupedMetrics, Partition, Scope
from tflane_jax.metrics.matching import average_precision_11, pooled
from tflane_jax.metrics.merging import joined
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics
from tflane_jax.metrics.resampling import Weights, frame_numbers, resampled_precisions
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
        self.add(match_segments(detections, truth))

    def add(self, frame: MatchedSegments) -> None:
        """Add one frame that has been matched."""
        segments, areas = frame.segments, frame.areas
        self._lanes.add(replace(segments, elements=None) if self.flavour == "LaneSegNet" else segments)
        self._area_detections.append((areas.scores, areas.categories, areas.hits))
        self._true_areas += areas.truths
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

        Some of the segments (`scope` "lanes") have no areas, and therefore none of the numbers that rest on areas.
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
            totals = {"mAP": (ap_ls + ap_ped) / 2, "TOP_lsls": lanes["TOP_ll"]}
            found = {name: value for name, value in lanes.items() if name == "AP_l" or name.startswith("recall")}
            return _in_scope(count | means | totals | segments | found | areas | self._matched_errors(), scope)
        lanes.pop("OLS", None)
        lanes["DET_a"] = float(np.mean(list(areas.values())))
        if "DET_t" in lanes:
            detection = [lanes["DET_l"], lanes["DET_a"], lanes["DET_t"]]
            lanes["OLUS"] = float(np.mean([*detection, lanes["TOP_ll"] ** 0.5, lanes["TOP_lt"] ** 0.5]))
        return _in_scope(lanes | areas | self._matched_errors(), scope)

    def means(self) -> dict[str, Float[np.ndarray, "f 2"]]:
        """Return the scores that are means over vertices, see `CenterlineMetrics.means`."""
        lanes = self._lanes.means()
        return {"TOP_lsls": lanes["TOP_ll"]} if self.flavour == "LaneSegNet" else lanes

    def resampled(self, weights: Weights, scope: Scope = "all") -> dict[str, Float[np.ndarray, " b"]]:
        """Return AP, mAP, DET, TOP and OLUS of samples that count the frames as often as `weights` says."""
        lanes = self._lanes.resampled(weights)
        scores, categories, hits = pooled(self._area_detections, (0,), (len(AREA_THRESHOLDS), 0))
        frame, truths = frame_numbers(self._area_detections), np.array(self._frame_areas, int).reshape(-1, BOUNDARY + 1)
        crossing, boundary = (
            resampled_precisions(scores[own], hits[:, own], frame[own], truths[:, category], weights)[0].mean(1)
            for category in (CROSSING, BOUNDARY)
            for own in [categories == category]
        )
        if self.flavour == "LaneSegNet":
            areas = {"AP_ped": crossing, "AP_boundary": boundary, "mAP": (lanes["DET_l"] + crossing) / 2}
            segments = {"AP_ls": lanes["DET_l"], "AP_l": lanes["AP_l"], "TOP_lsls": lanes["TOP_ll"]}
            return _in_scope(segments | areas, scope)
        lanes.pop("OLS", None)
        lanes["DET_a"] = (crossing + boundary) / 2
        if "DET_t" in lanes:
            roots = lanes["TOP_ll"] ** 0.5, lanes["TOP_lt"] ** 0.5
            lanes["OLUS"] = np.mean([lanes["DET_l"], lanes["DET_a"], lanes["DET_t"], *roots], axis=0)
        return _in_scope(lanes, scope)

    def _matched_errors(self) -> dict[str, float]:
        errors = {}
        for name, (pairs, total) in zip(("AE_dist", "AE_type"), self._errors.reshape(2, 2, -1), strict=True):
            means = {f"{name}@{t}": float(s / n) for t, n, s in zip(LANE_THRESHOLDS, pairs, total, strict=True) if n}
            if pairs[-1]:
                errors |= {name: means[f"{name}@{LANE_THRESHOLDS[-1]}"]} | means
        return errors


class GroupedSegmentMetrics(GroupedMetrics[MatchedSegments]):
    """The lane-segment metrics of all segments and of the groups of a partition, see `metrics.groups`.

    Only `all` and groups of frames have areas; the other groups have only the numbers of segments.

    Args:
        groups, frame_groups, lane_groups: see `GroupedMetrics`.
        partition: of the segments; default by occlusion.
        flavour: see `LaneSegmentMetrics`.
    """

    def __init__(
        self,
        groups: Sequence[str] | None = None,
        *,
        frame_groups: Sequence[str] = (),
        lane_groups: Sequence[str] = (),
        partition: Partition = BY_OCCLUSION,
        flavour: Flavour = "LaneSegNet",
    ) -> None:
        make = partial(LaneSegmentMetrics, flavour)
        super().__init__(make, partition, groups, frame_groups=frame_groups, lane_groups=lane_groups)

    def update(
        self,
        detections: SegmentDetections,
        truth: SegmentTruth,
        frame_group: FrameGroup = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one frame; arguments as of `GroupedMetrics.add`.

        Raises UserError for arrays that do not fit together, or a visibility that is not known.
        """
        self.add(match_segments(detections, truth, nearest="all"), truth.lanes, frame_group, members)


def _in_scope(values: dict[str, T], scope: Scope) -> dict[str, T]:
    """Return the numbers that the scope has: some of the segments have none of areas."""
    return {name: value for name, value in values.items() if scope != "lanes" or not _of_areas(name)}


def _of_areas(name: str) -> bool:
    return name in ("AP_ped", "AP_boundary", "mAP", "DET_a", "OLUS") or name.startswith(("crossing@", "boundary@"))
