"""OpenLane-V2 centerline metrics: DET_l, DET_t, TOP_ll, TOP_lt and OLS, in both published versions.

The topology score changed between devkit v1.0 and v1.1 (= v2.1) and differs by a factor of about four, so the version
is part of every result. DET is the same in both. Neither TF-Lane nor the marker paper names its version: their numbers
for TopoNet fit v2.1 and v1.0. Source:
openlanev2/centerline/evaluation of the OpenLane-V2 devkit; docs/reference/metrics.md describes the rules. Recall, AP_l
and the groups of lanes are this project's own (docs/metrics.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.metrics.bootstrap import (
    Weights,
    bootstrap_mean,
    bootstrap_precisions,
    frame_numbers,
    kept_in_sample,
)
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, MatchedFrame, match_frame
from tflane_jax.metrics.frames import LaneDetections, LaneTruth
from tflane_jax.metrics.groups import Scope
from tflane_jax.metrics.matching import average_precision_11, average_precision_area, pooled, ranked
from tflane_jax.metrics.merging import by_frame, joined
from tflane_jax.metrics.topology import Version, check_versions


class _Truths(NamedTuple):
    """Numbers of true lanes and elements in every frame.

    Attributes:
        lanes: (F,) true lanes.
        vertices: (F,) of TOP_lt.
        elements: (F, A) traffic elements by attribute.
    """

    lanes: Int[np.ndarray, " f"]
    vertices: Int[np.ndarray, " f"]
    elements: Int[np.ndarray, "f a"]


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
        # Detections of every frame: (scores, hits) of lanes, (scores, hits, attributes) of traffic elements.
        self._lane_detections: list[tuple[np.ndarray, ...]] = []
        self._element_detections: list[tuple[np.ndarray, ...]] = []
        # Of every frame: true lanes, vertices of TOP_lt, true elements by attribute.
        self._frame_truths: list[np.ndarray] = []
        # Of every frame: sums over the vertices of TOP_ll and of TOP_lt, by version and threshold.
        self._frame_topology: list[np.ndarray] = []

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        return _protocol(self.versions)

    def update(self, detections: LaneDetections, truth: LaneTruth) -> None:
        """Add one frame; raise UserError for arrays that do not fit together."""
        self.add(self.match(detections, truth))

    def match(self, detections: LaneDetections, truth: LaneTruth) -> MatchedFrame:
        """Match one frame; raise UserError for arrays that do not fit together."""
        return match_frame(detections, truth, self.versions)

    def add(self, frame: MatchedFrame) -> None:
        """Add one frame that has been matched with at least these versions."""
        truths = np.zeros(2 + ATTRIBUTES, int)
        topology = np.zeros((2, len(self.versions), len(LANE_THRESHOLDS)))
        truths[0] = frame.lanes
        topology[0] = [frame.topology[version].sum(-1) for version in self.versions]
        self._lane_detections.append((frame.scores, frame.hits))
        if frame.elements is not None:
            elements = frame.elements
            truths[1], truths[2:] = elements.vertices, elements.truths
            topology[1] = [elements.topology[version] for version in self.versions]
            self._element_detections.append((elements.scores, elements.hits, elements.attributes))
        self._frame_truths.append(truths)
        self._frame_topology.append(topology)

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

        Raises UserError if some frames alone have traffic elements; so do `compute_sample` and `bootstrap`.
        """
        return self._numbers(np.ones(ATTRIBUTES, bool))

    def compute_sample(self, whole: Self) -> dict[str, float]:
        """Return the metrics of frames that were drawn from a whole test set; `compute` has the names.

        An attribute that the test set has and the sample lacks is left out of `DET_t`: 0, as officially where there are
        detections of it, would be the luck of the draw. Without any attribute, `DET_t` and `OLS` are missing.
        """
        return self._numbers(kept_in_sample(self._truths.elements.sum(0), whole._truths.elements.sum(0)))

    def _numbers(self, counted: Bool[np.ndarray, " a"]) -> dict[str, float]:
        """Return the metrics, with those attributes of traffic elements that count."""
        lanes, elements = int(self._truths.lanes.sum()), self._truths.elements.sum(0)
        result: dict[str, float] = {"frames": len(self._frame_truths), "lanes": lanes}
        scores, hits = ranked(*pooled(self._lane_detections, (len(LANE_THRESHOLDS), 0)))
        precisions = [average_precision_11(scores, row, lanes) for row in hits]
        result["DET_l"] = float(np.mean(precisions))
        result |= {f"DET_l@{t}": value for t, value in zip(LANE_THRESHOLDS, precisions, strict=True)}
        result["AP_l"] = float(np.mean([average_precision_area(scores, row, lanes) for row in hits]))
        found = hits.sum(1) / max(lanes, 1)
        result["recall"] = float(found.mean())
        result |= {f"recall@{t}": float(value) for t, value in zip(LANE_THRESHOLDS, found, strict=True)}
        topology = {
            name: float(sums.sum(0).sum() / (len(LANE_THRESHOLDS) * max(vertices.sum(), 1)))
            for name, (sums, vertices) in self._vertices().items()
        }
        result |= {name: value for name, value in topology.items() if name.startswith("TOP_ll")}
        if not self._with_elements:
            return result

        scores, hits, attributes = pooled(self._element_detections, (0,), (0,))
        precision = {
            i: average_precision_11(scores[attributes == i], hits[attributes == i], int(elements[i]))
            for i in np.flatnonzero(counted).tolist()
        }
        result |= {"DET_t": float(np.mean(list(precision.values())))} if precision else {}
        result |= {f"DET_t@{i}": value for i, value in precision.items()}
        result |= topology
        return result | {name: float(value) for name, value in self._overall(result).items()}

    def means(self) -> dict[str, Float[np.ndarray, "f 2"]]:
        """Return the scores that are means over vertices, TOP_ll and TOP_lt: sum and number of vertices by frame."""
        return {
            name: np.stack([sums.mean(1), vertices.astype(float)], -1)
            for name, (sums, vertices) in self._vertices().items()
        }

    def bootstrap(self, weights: Weights, scope: Scope = "all") -> dict[str, Float[np.ndarray, " b"]]:
        """Return DET, AP_l, TOP and OLS of samples that count the frames as often as `weights` says.

        Attributes count in `DET_t` as in `compute_sample`; it is 0 where none does.
        """
        truths = self._truths
        scores, hits = pooled(self._lane_detections, (len(LANE_THRESHOLDS), 0))
        frame = frame_numbers(self._lane_detections)
        eleven, area = bootstrap_precisions(scores, hits, frame, truths.lanes, weights)
        result = {"DET_l": eleven.mean(1), "AP_l": area.mean(1)}
        result |= {name: bootstrap_mean(parts, weights) for name, parts in self.means().items()}
        if not self._with_elements:
            return result
        scores, hits, attributes = pooled(self._element_detections, (0,), (0,))
        frame, precisions = frame_numbers(self._element_detections), []
        for i in range(ATTRIBUTES):
            own = attributes == i
            eleven, _ = bootstrap_precisions(scores[own], hits[None, own], frame[own], truths.elements[:, i], weights)
            precisions.append(eleven[:, 0])
        counted = kept_in_sample(weights @ truths.elements, truths.elements.sum(0))
        result["DET_t"] = (np.stack(precisions, -1) * counted).sum(-1) / np.maximum(counted.sum(-1), 1)
        return result | self._overall(result)

    @property
    def _truths(self) -> _Truths:
        """Numbers of true lanes, vertices and elements of every frame."""
        counts = by_frame(self._frame_truths, (2 + ATTRIBUTES,), int)
        return _Truths(counts[:, 0], counts[:, 1], counts[:, 2:])

    @property
    def _with_elements(self) -> bool:
        """Whether traffic elements are measured; raises UserError if only some frames have them."""
        frames, missing = len(self._frame_truths), len(self._frame_truths) - len(self._element_detections)
        if 0 < missing < frames:
            raise UserError(f"traffic elements are missing in {missing} of {frames} frames: give all or none")
        return bool(self._element_detections)

    def _suffixes(self) -> list[str]:
        """Return what each version appends to the names of its scores: nothing for the first."""
        return ["", *(f"_{version}" for version in self.versions[1:])]

    def _vertices(self) -> dict[str, tuple[Float[np.ndarray, "f k"], Int[np.ndarray, " f"]]]:
        """Return by topology score, for every frame: sums over its vertices at each threshold, and their number.

        A score of v1.0 without vertices is not defined, and missing.
        """
        sums = by_frame(self._frame_topology, (2, len(self.versions), len(LANE_THRESHOLDS)))
        truths = self._truths
        vertices = {"TOP_ll": 2 * truths.lanes}
        if self._element_detections:
            vertices["TOP_lt"] = truths.vertices
        return {
            name + suffix: (sums[:, row, column], number)
            for row, (name, number) in enumerate(vertices.items())
            for column, (suffix, version) in enumerate(zip(self._suffixes(), self.versions, strict=True))
            if number.any() or version == "v2.1"
        }

    def _overall(self, scores: Mapping[str, Any]) -> dict[str, Any]:
        """Return OLS of every version that has both of its topology scores, marker paper, Eq. (5)."""
        parts = {suffix: [f"TOP_ll{suffix}", f"TOP_lt{suffix}"] for suffix in self._suffixes()}
        return {
            f"OLS{suffix}": overall_score([scores["DET_l"], scores["DET_t"]], [scores[name] for name in names])
            for suffix, names in parts.items()
            if scores.keys() >= {"DET_t", *names}
        }


def overall_score(detection: Sequence[Any], topology: Sequence[Any]) -> Any:
    """Return the mean of detection scores and of the square roots of topology scores: numbers, or arrays of samples."""
    return np.mean([*detection, *(score**0.5 for score in topology)], axis=0)


def _protocol(versions: Sequence[Version]) -> str:
    further = "".join(f", {version} where the name says so" for version in versions[1:])
    return f"OpenLane-V2 centerline {versions[0]}{further}"
