"""OpenLane-V2 centerline metrics: DET_l, DET_t, TOP_ll, TOP_lt and OLS, in both published versions.

The topology score changed between devkit v1.0 and v1.1 (= v2.1) and differs by a factor of about four, so the version
is part of every result: TF-Lane reports v2.1, the marker-fusion paper v1.0. DET is the same in both. Source:
openlanev2/centerline/evaluation of the OpenLane-V2 devkit; docs/reference/metrics.md describes the rules. Recall, AP_l
and the groups of lanes are this project's own (docs/metrics.md).
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, MatchedFrame, match_frame
from tflane_jax.metrics.frames import LaneDetections, LaneTruth
from tflane_jax.metrics.matching import average_precision_11, average_precision_area, pooled
from tflane_jax.metrics.topology import Version, check_versions


class CenterlineMetrics:
    """Accumulator of the OpenLane-V2 centerline metrics over frames.

    Keeps a score and a few flags of every detection and sums over vertices; no geometry. One accumulator per scene and
    `merge` give the metrics of any set of scenes.

    Args:
        versions: of the topology score; "v2.1" is also that of devkit v1.1. Every frame is matched once for all of
            them. The first gives `TOP_ll`, `TOP_lt` and `OLS`, the others the same with a suffix, as `TOP_ll_v1.0`.
    """

    def __init__(self, versions: Sequence[Version] = ("v2.1",)) -> None:
        self.versions = check_versions(versions)
        self._frames = self._frames_with_elements = 0
        self._lanes = self._lane_vertices = self._element_vertices = 0
        sums = len(self.versions), len(LANE_THRESHOLDS)
        self._lane_topology, self._element_topology = np.zeros(sums), np.zeros(sums)
        self._true_elements = np.zeros(ATTRIBUTES, np.int64)
        # Detections of every frame: (scores, hits) of lanes, (scores, hits, attributes) of traffic elements.
        self._lane_detections: list[tuple[np.ndarray, ...]] = []
        self._element_detections: list[tuple[np.ndarray, ...]] = []

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        return _protocol(self.versions)

    def update(self, detections: LaneDetections, truth: LaneTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        self.add(match_frame(detections, truth, self.versions))

    def add(self, frame: MatchedFrame) -> None:
        """Add one frame that has been matched with at least these versions."""
        self._frames += 1
        self._lanes += frame.lanes
        self._lane_vertices += 2 * frame.lanes
        self._lane_topology += np.stack([frame.topology[version].sum(-1) for version in self.versions])
        self._lane_detections.append((frame.scores, frame.hits))
        if frame.elements is not None:
            elements = frame.elements
            self._frames_with_elements += 1
            self._true_elements += elements.truths
            self._element_vertices += elements.vertices
            self._element_topology += np.stack([elements.topology[version] for version in self.versions])
            self._element_detections.append((elements.scores, elements.hits, elements.attributes))

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        if self.versions != other.versions:
            raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one version")
        merged = type(self)(self.versions)
        for name in vars(self).keys() - {"versions"}:
            setattr(merged, name, getattr(self, name) + getattr(other, name))
        return merged

    def compute(self) -> dict[str, float]:
        """Return the metrics, 0 to 1, and what they count.

        - `frames`, `lanes`: number of frames and of true lanes;
        - `DET_l` and, per threshold in metres, `DET_l@1.0`, `DET_l@2.0`, `DET_l@3.0` (1 if there is neither a true
          lane nor a detection, as officially);
        - `recall` and `recall@1.0`, `recall@2.0`, `recall@3.0`: fraction of the true lanes that some detection takes,
          whatever its score. Not official; it changes smoothly, whereas DET_l is a mean over eleven recall levels;
        - `AP_l`: as DET_l, with the area under the precision-recall curve in place of the mean over eleven recall
          levels. Not official;
        - `TOP_ll`: 0 without true lanes in v2.1; missing in v1.0, whose official program stops with an error;
        - only if every frame had traffic elements on both sides: `DET_t` and, per attribute, `DET_t@0` ...
          `DET_t@12`; `TOP_lt` (missing like `TOP_ll`); `OLS`, missing if one of its parts is;
        - `TOP_ll`, `TOP_lt` and `OLS` of the further versions, named with the version: `TOP_ll_v1.0`.
        """
        result: dict[str, float] = {"frames": self._frames, "lanes": self._lanes}
        scores, hits = pooled(self._lane_detections, (len(LANE_THRESHOLDS), 0))
        precisions = [average_precision_11(scores, row, self._lanes) for row in hits]
        result["DET_l"] = float(np.mean(precisions))
        result |= {f"DET_l@{t}": value for t, value in zip(LANE_THRESHOLDS, precisions, strict=True)}
        result["AP_l"] = float(np.mean([average_precision_area(scores, row, self._lanes) for row in hits]))
        found = hits.sum(1) / max(self._lanes, 1)
        result["recall"] = float(found.mean())
        result |= {f"recall@{t}": float(value) for t, value in zip(LANE_THRESHOLDS, found, strict=True)}
        result |= self._topology("TOP_ll", self._lane_topology, self._lane_vertices)
        if self._frames_with_elements == 0:
            return result
        if self._frames_with_elements < self._frames:
            missing = self._frames - self._frames_with_elements
            raise UserError(f"traffic elements are missing in {missing} of {self._frames} frames: give all or none")

        scores, hits, attributes = pooled(self._element_detections, (0,), (0,))
        precisions = [
            average_precision_11(scores[attributes == i], hits[attributes == i], int(count))
            for i, count in enumerate(self._true_elements)
        ]
        result["DET_t"] = float(np.mean(precisions))
        result |= {f"DET_t@{i}": value for i, value in enumerate(precisions)}
        result |= self._topology("TOP_lt", self._element_topology, self._element_vertices)
        for suffix in self._suffixes():
            lanes, elements = (result.get(name + suffix) for name in ("TOP_ll", "TOP_lt"))
            if lanes is not None and elements is not None:
                result["OLS" + suffix] = float(np.mean([result["DET_l"], result["DET_t"], lanes**0.5, elements**0.5]))
        return result

    def _suffixes(self) -> list[str]:
        """Return what each version appends to the names of its scores: nothing for the first."""
        return ["", *(f"_{version}" for version in self.versions[1:])]

    def _topology(self, name: str, totals: Float[np.ndarray, "v k"], vertices: int) -> dict[str, float]:
        scores = {}
        for suffix, version, total in zip(self._suffixes(), self.versions, totals, strict=True):
            if vertices:
                scores[name + suffix] = float(total.sum() / (len(LANE_THRESHOLDS) * vertices))
            elif version == "v2.1":
                scores[name + suffix] = 0.0
        return scores


def _protocol(versions: Sequence[Version]) -> str:
    further = "".join(f", {version} where the name says so" for version in versions[1:])
    return f"OpenLane-V2 centerline {versions[0]}{further}"


class GroupedCenterlineMetrics:
    """The centerline metrics of all lanes, of the occluded ones and of those in clear view.

    A true lane is `occluded` if its visibility is below `occluded_below`, else `clear`. Every frame is matched once,
    with all lanes and all detections, by the official rules. Then, for the group S of lanes:

    - DET_l counts the true lanes in S and the detections whose nearest true lane lies in S, false positives included.
      Nearest is the least relaxed Frechet distance, however large. Below 3 m it is the official candidate. Detections
      in frames without true lanes count only in `all`;
    - TOP_ll pools the vertex precisions of the lanes in S; their neighbours may lie outside S.

    `all` is the official number. `occluded` and `clear` partition its lanes and its vertices, and its detections in
    frames with lanes. Traffic elements count only in `all`.

    The caller may name further groups of lanes, which may overlap, and tell their members with every frame. A frame may
    also belong to a group of frames, which is measured like `all` on these frames alone.

    Args:
        groups: the groups to report.
        frame_groups: names of groups of frames.
        lane_groups: names of further groups of lanes.
        occluded_below: visibility (fraction of the lane in direct line of sight) below which a lane is occluded.
        versions: of the topology score, see `CenterlineMetrics`.
    """

    def __init__(
        self,
        groups: Sequence[str] = ("all", "occluded", "clear"),
        *,
        frame_groups: Sequence[str] = (),
        lane_groups: Sequence[str] = (),
        occluded_below: float = 0.5,
        versions: Sequence[Version] = ("v2.1",),
    ) -> None:
        self.versions = check_versions(versions)
        self.occluded_below = occluded_below
        self._frame_groups = frozenset(frame_groups)
        self._lane_groups = frozenset(lane_groups)
        self._metrics = {group: CenterlineMetrics(versions) for group in (*groups, *lane_groups, *frame_groups)}
        # Of every frame: true lanes and hits, summed over the thresholds.
        self._recalled: dict[str, list[tuple[int, int]]] = {group: [] for group in self._metrics}

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        return f"{_protocol(self.versions)}, occluded: visibility < {self.occluded_below:g}"

    def update(
        self,
        detections: LaneDetections,
        truth: LaneTruth,
        frame_group: str | None = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one frame, which may belong to a group of frames.

        Args:
            detections, truth: of the frame.
            frame_group: the group of frames.
            members: for each of `lane_groups`, which of the true lanes belong to it.

        Raises:
            UserError: arrays that do not fit together, or a visibility that is not known.
        """
        frame = match_frame(detections, truth, self.versions)
        for group, metrics in self._metrics.items():
            lanes = hits = 0
            if group not in self._frame_groups or group == frame_group:
                part = frame
                if group in self._lane_groups:
                    part = frame.select((members or {})[group])
                elif group not in ("all", frame_group):
                    part = frame.select(self._members(group, truth, frame.lanes))
                metrics.add(part)
                lanes, hits = part.lanes, int(part.hits.sum())
            self._recalled[group].append((lanes, hits))

    def recalled(self) -> dict[str, Int[np.ndarray, "f 2"]]:
        """Return by group, for every frame: true lanes, and hits summed over the three thresholds.

        Recall is the sum of the hits over frames, divided by three times the sum of the lanes.
        """
        return {group: np.array(counts, int).reshape(-1, 2) for group, counts in self._recalled.items()}

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        if self.protocol != other.protocol or self._metrics.keys() != other._metrics.keys():
            raise UserError(f"cannot merge metrics of {self.protocol} with {other.protocol}, or of other groups")
        merged = copy.copy(self)
        merged._metrics = {group: metrics.merge(other._metrics[group]) for group, metrics in self._metrics.items()}
        merged._recalled = {group: counts + other._recalled[group] for group, counts in self._recalled.items()}
        return merged

    def compute(self) -> dict[str, dict[str, float]]:
        """Return `CenterlineMetrics.compute` of each group."""
        return {group: metrics.compute() for group, metrics in self._metrics.items()}

    def _members(self, group: str, truth: LaneTruth, lanes: int) -> Bool[np.ndarray, " g"]:
        """Return which of the true lanes belong to a group other than `all`."""
        if truth.visibility is None:
            raise UserError("the truth has no visibility of its lanes: report the group 'all' only")
        visibility = np.asarray(truth.visibility)
        if visibility.shape != (lanes,):
            raise UserError(f"truth: visibility has shape {visibility.shape}, expected {(lanes,)}")
        occluded = visibility < self.occluded_below
        return occluded if group == "occluded" else ~occluded


class DistanceCenterlineMetrics(GroupedCenterlineMetrics):
    """The centerline metrics of all lanes and of those whose nearest vertex lies within a range of distances.

    Lanes and detections are assigned to groups by the rules of `GroupedCenterlineMetrics`.

    Args:
        edges: distances in the ground plane at which one group ends and the next begins, metres, ascending.
        versions: of the topology score, see `CenterlineMetrics`.
    """

    def __init__(self, edges: Sequence[float] = (10.0, 20.0, 30.0), *, versions: Sequence[Version] = ("v2.1",)) -> None:
        limits = [0.0, *edges, np.inf]
        self._ranges = {
            f"from {low:g} m" if high == np.inf else f"{low:g} to {high:g} m": (low, high)
            for low, high in itertools.pairwise(limits)
        }
        super().__init__(("all", *self._ranges), versions=versions)

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        return f"{_protocol(self.versions)}, by distance of a lane's nearest vertex"

    def _members(self, group: str, truth: LaneTruth, lanes: int) -> Bool[np.ndarray, " g"]:
        low, high = self._ranges[group]
        distance = np.array([np.linalg.norm(np.asarray(line)[:, :2], axis=-1).min() for line in truth.points])
        return (low <= distance) & (distance < high)
