"""OpenLane-V2 centerline metrics: DET_l, DET_t, TOP_ll, TOP_lt and OLS, in both published versions.

The topology score changed between devkit v1.0 and v1.1 (= v2.1) and differs by a factor of about four, so the version
is part of every result. DET is the same in both. Neither TF-Lane nor the marker paper names its version: their numbers
for TopoNet fit v2.1 and v1.0. Source:
openlanev2/centerline/evaluation of the OpenLane-V2 devkit; docs/reference/metrics.md describes the rules. Recall, AP_l
and the groups of lanes are this project's own (docs/metrics.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.errors import UserError
from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, MatchedFrame, match_frame
from tflane_jax.metrics.frames import LaneDetections, LaneTruth
from tflane_jax.metrics.groups import BY_OCCLUSION, FrameGroup, GroupedMetrics, Partition, Scope
from tflane_jax.metrics.matching import average_precision_11, average_precision_area, pooled, ranked
from tflane_jax.metrics.merging import joined
from tflane_jax.metrics.resampling import Weights, frame_numbers, resampled_mean, resampled_precisions
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
        # Of every frame: true lanes and elements by attribute; sums over the vertices of lanes and of elements for each
        # version, and in the last column the number of vertices.
        self._frame_truths: list[np.ndarray] = []
        self._frame_topology: list[np.ndarray] = []

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
        self._frame_truths.append(np.append(frame.lanes, np.zeros(ATTRIBUTES, int)))
        sums = [frame.topology[version].sum() / len(LANE_THRESHOLDS) for version in self.versions]
        self._frame_topology.append(np.array([[*sums, 2 * frame.lanes], np.zeros(len(sums) + 1)]))
        if frame.elements is not None:
            elements = frame.elements
            self._frame_truths[-1][1:] = elements.truths
            sums = [elements.topology[version].mean() for version in self.versions]
            self._frame_topology[-1][1] = [*sums, elements.vertices]
            self._frames_with_elements += 1
            self._true_elements += elements.truths
            self._element_vertices += elements.vertices
            self._element_topology += np.stack([elements.topology[version] for version in self.versions])
            self._element_detections.append((elements.scores, elements.hits, elements.attributes))

    def merge(self, *others: Self) -> Self:
        """Return an accumulator of the frames of all, in this order (none changes)."""
        for other in others:
            if self.versions != other.versions:
                raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one version")
        merged = type(self)(self.versions)
        for name in vars(self).keys() - {"versions"}:
            setattr(merged, name, joined([getattr(each, name) for each in (self, *others)]))
        return merged

    def compute(self, scope: Scope = "all") -> dict[str, float]:
        """Return the metrics, 0 to 1, and what they count; the same rules for every `scope`.

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
        scores, hits = ranked(*pooled(self._lane_detections, (len(LANE_THRESHOLDS), 0)))
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
            if lanes is not None and elements is not None:  # marker paper, Eq. (5)
                result["OLS" + suffix] = float(np.mean([result["DET_l"], result["DET_t"], lanes**0.5, elements**0.5]))
        return result

    def means(self) -> dict[str, Float[np.ndarray, "f 2"]]:
        """Return the scores that are means over vertices, TOP_ll and TOP_lt: sum and number of vertices by frame."""
        parts = np.array(self._frame_topology).reshape(-1, 2, len(self.versions) + 1)
        found = {}
        for row, name in enumerate(("TOP_ll", "TOP_lt") if self._frames_with_elements else ("TOP_ll",)):
            for column, suffix in enumerate(self._suffixes()):
                if parts[:, row, -1].any() or self.versions[column] == "v2.1":
                    found[name + suffix] = parts[:, row, [column, -1]]
        return found

    def resampled(self, weights: Weights, scope: Scope = "all") -> dict[str, Float[np.ndarray, " b"]]:
        """Return DET, AP_l, TOP and OLS of samples that count the frames as often as `weights` says."""
        truths = np.array(self._frame_truths, int).reshape(-1, 1 + ATTRIBUTES)
        scores, hits = pooled(self._lane_detections, (len(LANE_THRESHOLDS), 0))
        frame = frame_numbers(self._lane_detections)
        eleven, area = resampled_precisions(scores, hits, frame, truths[:, 0], weights)
        result = {"DET_l": eleven.mean(1), "AP_l": area.mean(1)}
        result |= {name: resampled_mean(parts, weights) for name, parts in self.means().items()}
        if self._frames_with_elements == 0:
            return result
        scores, hits, attributes = pooled(self._element_detections, (0,), (0,))
        frame, precisions = frame_numbers(self._element_detections), []
        for i in range(ATTRIBUTES):
            own = attributes == i
            eleven, _ = resampled_precisions(scores[own], hits[None, own], frame[own], truths[:, 1 + i], weights)
            precisions.append(eleven[:, 0])
        result["DET_t"] = np.mean(precisions, axis=0)
        for suffix in self._suffixes():
            tops = [result[name + suffix] for name in ("TOP_ll", "TOP_lt") if name + suffix in result]
            if len(tops) == 2:
                result["OLS" + suffix] = np.mean([result["DET_l"], result["DET_t"], *np.sqrt(tops)], axis=0)
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


class GroupedCenterlineMetrics(GroupedMetrics[MatchedFrame]):
    """The centerline metrics of all lanes and of the groups of a partition, see `metrics.groups`.

    Args:
        groups, frame_groups, lane_groups: see `GroupedMetrics`.
        partition: of the lanes; default by occlusion.
        versions: of the topology score, see `CenterlineMetrics`.
    """

    def __init__(
        self,
        groups: Sequence[str] | None = None,
        *,
        frame_groups: Sequence[str] = (),
        lane_groups: Sequence[str] = (),
        partition: Partition = BY_OCCLUSION,
        versions: Sequence[Version] = ("v2.1",),
    ) -> None:
        self.versions = check_versions(versions)
        make = partial(CenterlineMetrics, self.versions)
        super().__init__(make, partition, groups, frame_groups=frame_groups, lane_groups=lane_groups)

    def update(
        self,
        detections: LaneDetections,
        truth: LaneTruth,
        frame_group: FrameGroup = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one frame; arguments as of `GroupedMetrics.add`.

        Raises UserError for arrays that do not fit together, or a visibility that is not known.
        """
        self.add(match_frame(detections, truth, self.versions), truth, frame_group, members)
