"""OpenLane-V2 centerline metrics: DET_l, DET_t, TOP_ll, TOP_lt and OLS, in both published versions.

The topology score changed between devkit v1.0 and v1.1 (= v2.1) and differs by a factor of about four, so the version
is part of every result: TF-Lane reports v2.1, the marker-fusion paper v1.0. DET is the same in both. Rules: shared
specs/metrics.md sections 1 and 2; the groups by occlusion are this project's own (docs/metrics.md).
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.errors import UserError
from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, MatchedFrame, match_frame
from tflane_jax.metrics.frames import LaneDetections, LaneTruth
from tflane_jax.metrics.matching import average_precision_11, pooled
from tflane_jax.metrics.topology import Version


class CenterlineMetrics:
    """Accumulator of the OpenLane-V2 centerline metrics over frames.

    Keeps a score and a few flags of every detection and sums over vertices; no geometry. One accumulator per scene and
    `merge` give the metrics of any set of scenes.

    Args:
        version: of the topology score; "v2.1" is also that of devkit v1.1.
    """

    def __init__(self, version: Version = "v2.1") -> None:
        self.version: Version = version
        self._frames = self._frames_with_elements = 0
        self._lanes = self._lane_vertices = self._element_vertices = 0
        self._lane_topology, self._element_topology = (np.zeros(len(LANE_THRESHOLDS)) for _ in range(2))
        self._true_elements = np.zeros(ATTRIBUTES, np.int64)
        # Detections of every frame: (scores, hits) of lanes, (scores, hits, attributes) of traffic elements.
        self._lane_detections: list[tuple[np.ndarray, ...]] = []
        self._element_detections: list[tuple[np.ndarray, ...]] = []

    @property
    def protocol(self) -> str:
        """Name and version, to stand above every table of these numbers."""
        return f"OpenLane-V2 centerline {self.version}"

    def update(self, detections: LaneDetections, truth: LaneTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        self.add(match_frame(detections, truth, self.version))

    def add(self, frame: MatchedFrame) -> None:
        """Add one frame that has been matched by this version's rules."""
        self._frames += 1
        self._lanes += frame.lanes
        self._lane_vertices += 2 * frame.lanes
        self._lane_topology += frame.topology.sum(-1)
        self._lane_detections.append((frame.scores, frame.hits))
        if frame.elements is not None:
            elements = frame.elements
            self._frames_with_elements += 1
            self._true_elements += elements.truths
            self._element_vertices += elements.vertices
            self._element_topology += elements.topology
            self._element_detections.append((elements.scores, elements.hits, elements.attributes))

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        if self.version != other.version:
            raise UserError(f"cannot merge {self.protocol} with {other.protocol}: update both with one version")
        merged = type(self)(self.version)
        for name in vars(self).keys() - {"version"}:
            setattr(merged, name, getattr(self, name) + getattr(other, name))
        return merged

    def compute(self) -> dict[str, float]:
        """Return the metrics, 0 to 1, and what they count.

        - `frames`, `lanes`: number of frames and of true lanes;
        - `DET_l` and, per threshold in metres, `DET_l@1.0`, `DET_l@2.0`, `DET_l@3.0` (1 if there is neither a true
          lane nor a detection, as officially);
        - `recall` and `recall@1.0`, `recall@2.0`, `recall@3.0`: share of the true lanes that some detection takes,
          whatever its score. Not official; it moves smoothly where DET_l, which rests on eleven recalls, jumps;
        - `TOP_ll`: 0 without true lanes in v2.1; missing in v1.0, whose official program stops with an error;
        - only if every frame had traffic elements on both sides: `DET_t` and, per attribute, `DET_t@0` ...
          `DET_t@12`; `TOP_lt` (missing like `TOP_ll`); `OLS`, missing if one of its parts is.
        """
        result: dict[str, float] = {"frames": self._frames, "lanes": self._lanes}
        scores, hits = pooled(self._lane_detections, (len(LANE_THRESHOLDS), 0))
        precisions = [average_precision_11(scores, row, self._lanes) for row in hits]
        result["DET_l"] = float(np.mean(precisions))
        result |= {f"DET_l@{t}": value for t, value in zip(LANE_THRESHOLDS, precisions, strict=True)}
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
        if "TOP_ll" in result and "TOP_lt" in result:
            parts = result["DET_l"], result["DET_t"], result["TOP_ll"] ** 0.5, result["TOP_lt"] ** 0.5
            result["OLS"] = float(np.mean(parts))
        return result

    def _topology(self, name: str, total: Float[np.ndarray, " k"], vertices: int) -> dict[str, float]:
        if vertices:
            return {name: float(total.sum() / (len(LANE_THRESHOLDS) * vertices))}
        return {name: 0.0} if self.version == "v2.1" else {}


class GroupedCenterlineMetrics:
    """The centerline metrics of all lanes, of the occluded ones and of those in clear view.

    A true lane is `occluded` if its visibility is below `occluded_below`, else `clear`. Every frame is matched once,
    with all lanes and all detections, by the official rules. Then, for the group S of lanes:

    - DET_l counts the true lanes in S and the detections whose nearest true lane lies in S, false positives included.
      Nearest is the least relaxed Frechet distance, however large (below 3 m it is the lane that the official matching
      looks at). Detections in frames without true lanes count only in `all`;
    - TOP_ll pools the vertex precisions of the lanes in S; their neighbours may lie outside S.

    So `all` is the official number, occluded and clear share out its lanes and its vertices exactly, and its detections
    but for those in frames without lanes. Traffic elements count only in `all`.

    Frames can be shared out, too: a group of frames is measured like `all`, on these frames alone.

    Args:
        groups: the groups to report.
        frame_groups: names of groups of frames.
        occluded_below: visibility (share of the lane in direct line of sight) below which a lane is occluded.
        version: of the topology score.
    """

    def __init__(
        self,
        groups: Sequence[str] = ("all", "occluded", "clear"),
        *,
        frame_groups: Sequence[str] = (),
        occluded_below: float = 0.5,
        version: Version = "v2.1",
    ) -> None:
        self.version: Version = version
        self.occluded_below = occluded_below
        self._frame_groups = frozenset(frame_groups)
        self._metrics = {group: CenterlineMetrics(version) for group in (*groups, *frame_groups)}

    @property
    def protocol(self) -> str:
        """Name and version, to stand above every table of these numbers."""
        return f"OpenLane-V2 centerline {self.version}, occluded: visibility < {self.occluded_below:g}"

    def update(self, detections: LaneDetections, truth: LaneTruth, frame_group: str | None = None) -> None:
        """Add one frame, which may belong to a group of frames.

        Raises UserError for arrays that do not fit together or a visibility that is not known.
        """
        frame = match_frame(detections, truth, self.version)
        for group, metrics in self._metrics.items():
            if group in ("all", frame_group):
                metrics.add(frame)
            elif group not in self._frame_groups:
                metrics.add(frame.select(self._members(group, truth, frame.lanes)))

    def merge(self, other: Self) -> Self:
        """Return an accumulator of the frames of both, in this order (neither changes)."""
        if self.protocol != other.protocol or self._metrics.keys() != other._metrics.keys():
            raise UserError(f"cannot merge metrics of {self.protocol} with {other.protocol}, or of other groups")
        merged = copy.copy(self)
        merged._metrics = {group: metrics.merge(other._metrics[group]) for group, metrics in self._metrics.items()}
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

    Lanes and detections are shared out as `GroupedCenterlineMetrics` says.

    Args:
        edges: distances in the ground plane at which one group ends and the next begins, metres, ascending.
        version: of the topology score.
    """

    def __init__(self, edges: Sequence[float] = (10.0, 20.0, 30.0), *, version: Version = "v2.1") -> None:
        limits = [0.0, *edges, np.inf]
        self._ranges = {
            f"from {low:g} m" if high == np.inf else f"{low:g} to {high:g} m": (low, high)
            for low, high in itertools.pairwise(limits)
        }
        super().__init__(("all", *self._ranges), version=version)

    @property
    def protocol(self) -> str:
        """Name and version, to stand above every table of these numbers."""
        return f"OpenLane-V2 centerline {self.version}, by distance of a lane's nearest vertex"

    def _members(self, group: str, truth: LaneTruth, lanes: int) -> Bool[np.ndarray, " g"]:
        low, high = self._ranges[group]
        distance = np.array([np.linalg.norm(np.asarray(line)[:, :2], axis=-1).min() for line in truth.points])
        return (low <= distance) & (distance < high)
