"""All protocols for lanes around the vehicle, selected by what a model predicts and an example labels.

| predicted part | protocol | groups of numbers |
|---|---|---|
| `centerlines` (with `elements`) | OpenLane-V2 centerline | all, occluded, clear; those of `lane_groups`; seen, gap, |
| | | before for markers |
| `segments` | OpenLane-V2 lane segment; LaneSegNet | segments; lanesegnet |
| `lines` | MapTR | lines |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool
from scipy.special import expit

from tflane_jax.datasets.batches import ordered_batches
from tflane_jax.datasets.streaming import Streamed
from tflane_jax.evaluation.centerlines import detections_from_prediction, element_detections, truth_from_example
from tflane_jax.evaluation.interventions import with_traffic
from tflane_jax.evaluation.lane_groups import LANE_GROUPS, lane_groups
from tflane_jax.evaluation.lane_segments import segment_detections, segment_truth
from tflane_jax.evaluation.predict import Predictor, predicted_batches
from tflane_jax.evaluation.results import EvaluationConfig, SceneRatio
from tflane_jax.evaluation.vector_maps import map_detections, map_lines, map_truth
from tflane_jax.geometry import PerceptionRange
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS
from tflane_jax.metrics.lane_segment import LaneSegmentMetrics
from tflane_jax.metrics.openlane_v2 import GroupedCenterlineMetrics
from tflane_jax.metrics.topology import Version
from tflane_jax.metrics.vector_map import CLASSES, MapDetections, MapTruth, VectorMapMetrics
from tflane_jax.models.parameters import Params
from tflane_jax.scene import ElementPrediction, Example, LinePrediction, Prediction, SegmentPrediction, TrafficElements


class LaneGraphMetrics:
    """Accumulator of all protocols that apply to the predicted parts.

    Args:
        versions: versions of the OpenLane-V2 centerline metrics.
        frame_groups, lane_groups: names of the groups of frames and of further groups of lanes, see
            `GroupedCenterlineMetrics`.
        parts: predicted parts that are measured as long as no frame was seen.
    """

    def __init__(
        self,
        versions: Sequence[Version] = ("v2.1",),
        frame_groups: Sequence[str] = (),
        parts: Sequence[str] = ("centerlines",),
        lane_groups: Sequence[str] = (),
    ) -> None:
        self._centerlines = GroupedCenterlineMetrics(
            versions=versions, frame_groups=frame_groups, lane_groups=lane_groups
        )
        self._continues: list[bool] = []  # whether a frame belongs to the scene of the frame before
        self._segments = {"segments": LaneSegmentMetrics("OpenLane-V2"), "lanesegnet": LaneSegmentMetrics("LaneSegNet")}
        self._lines = VectorMapMetrics()
        self._measured = tuple(parts)

    @property
    def protocol(self) -> str:
        """Names and versions of the protocols that apply."""
        return "; ".join(metrics.protocol for metrics in self._applied().values())

    def update(
        self,
        prediction: Prediction,
        example: Example,
        frame_group: str | None = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one frame; the frames of a scene come in succession.

        Args:
            prediction: the last decoder layer's prediction for this example.
            example: ground truth of all predicted parts. Traffic elements are measured if both have them.
            frame_group: the group that this frame belongs to.
            members: for each of `lane_groups`, which of the valid true lanes belong to it.

        Raises:
            ValueError: no protocol measures any predicted part.
        """
        parts = tuple(name for name in ("centerlines", "segments", "lines") if getattr(prediction, name) is not None)
        if not parts:
            raise ValueError("this task predicts no lanes, so there is nothing to measure")
        self._measured = parts
        self._continues.append(bool(example.has_previous))
        both = prediction.elements is not None and example.traffic_elements is not None
        found, true = (prediction.elements, example.traffic_elements) if both else (None, None)
        if prediction.centerlines is not None:
            detections = detections_from_prediction(prediction.centerlines, found)
            self._centerlines.update(detections, truth_from_example(example.lanes, true), frame_group, members)
        if prediction.segments is not None:
            self._update_segments(prediction.segments, found, true, example)
        if prediction.lines is not None:
            self._lines.update(_lines(prediction.lines), _true_lines(example))

    def _update_segments(
        self,
        segments: SegmentPrediction,
        found: ElementPrediction | None,
        true: TrafficElements | None,
        example: Example,
    ) -> None:
        confidence = expit(np.asarray(segments.logits))
        edges = segments.successor_logits
        successor = np.zeros((len(confidence),) * 2) if edges is None else expit(np.asarray(edges))
        detections = segment_detections(
            np.asarray(segments.points),
            np.asarray(segments.left),
            np.asarray(segments.right),
            confidence.argmax(-1),
            confidence.max(-1),
            successor,
            elements=None if found is None else element_detections(found),
        )
        truth = segment_truth(example.segments, example.areas, true, None if true is None else example.lanes)
        for metrics in self._segments.values():
            metrics.update(detections, truth)

    def compute(self) -> dict[str, dict[str, float]]:
        """Return metrics by name, for every group of every protocol that applies."""
        groups: dict[str, dict[str, float]] = {}
        for name, metrics in self._applied().items():
            groups |= metrics.compute() if name == "centerlines" else {name: metrics.compute()}
        return groups

    def ratios(self) -> dict[str, SceneRatio]:
        """Return the recall of every group of centerlines as hits and lanes of each scene."""
        if "centerlines" not in self._measured or not self._continues:
            return {}
        scene = np.cumsum(~np.array([True, *self._continues[1:]]))
        ratios = {}
        for group, counts in self._centerlines.recalled().items():
            lanes, hits = (np.bincount(scene, column).astype(int).tolist() for column in counts.T)
            ratios[f"{group}/recall"] = SceneRatio(tuple(hits), tuple(len(LANE_THRESHOLDS) * n for n in lanes))
        return ratios

    def _applied(self) -> dict[str, Any]:
        """Return the accumulators that apply, by the part that they measure."""
        applied: dict[str, Any] = {"centerlines": self._centerlines} if "centerlines" in self._measured else {}
        applied |= self._segments if "segments" in self._measured else {}
        return applied | ({"lines": self._lines} if "lines" in self._measured else {})


def _lines(lines: LinePrediction) -> MapDetections:
    """Return the lines whose most likely class is measured by MapTR's metric."""
    confidence = expit(np.asarray(lines.logits))
    classes = confidence.argmax(-1)
    return map_detections(np.asarray(lines.points), classes, confidence.max(-1), classes < len(CLASSES))


def _true_lines(example: Example) -> MapTruth:
    """Return the labelled map lines; without labels, those derived from lane segments and areas."""
    lines = example.map_lines
    if lines is None:
        return map_truth(example.segments, example.areas)
    return map_lines(
        lines.points, lines.category, np.asarray(lines.valid) & (np.asarray(lines.category) < len(CLASSES))
    )


def evaluate_lanes(
    task: Predictor,
    params: Params,
    arrays: Example | Streamed,
    config: EvaluationConfig | None = None,
    *,
    ground: PerceptionRange | None = None,
) -> LaneGraphMetrics:
    """Return the filled accumulator of a dataset.

    Frames of examples with markers are grouped by marker visibility as well, see `Sightings`. Lanes of examples with
    BEV evidence and traffic flow are grouped by both, see `evaluation.lane_groups`, whatever traffic the model sees.

    Args:
        task: a model that predicts lanes of any kind.
        params: its parameters.
        arrays: examples with ground truth, see `datasets.batches`.
        config: batch size, versions, and traffic flow that the model sees.
        ground: the range that the BEV evidence covers; None for a model that does not see it, without those groups.

    Raises:
        ValueError: the task predicts no lanes.
        UserError: the examples do not allow the configured traffic flow, see `with_traffic`.
    """
    config = config or EvaluationConfig()
    sightings, metrics = Sightings(), LaneGraphMetrics(config.versions)
    changed = with_traffic(arrays, config.traffic)
    predicted = predicted_batches(task, params, changed, config.batch_size)
    originals = None if changed is arrays else ordered_batches(arrays, config.batch_size)
    for number, (indices, batch, answer) in enumerate(predicted):
        if originals is not None:
            _, batch = next(originals)
        if number == 0:
            metrics = LaneGraphMetrics(
                config.versions,
                () if batch.markers is None else sightings.groups,
                lane_groups=() if _members(batch, 0, ground) is None else LANE_GROUPS,
            )
        for row in range(len(indices)):
            prediction, example = jax.tree.map(lambda leaf, i=row: leaf[i], (answer, _labels(batch)))
            group = None
            if batch.markers is not None:
                group = sightings.next(batch.markers.valid[row].any(), batch.has_previous[row])
            metrics.update(prediction, example, group, _members(batch, row, ground))
    return metrics


def _members(batch: Example, row: int, ground: PerceptionRange | None) -> dict[str, Bool[np.ndarray, " g"]] | None:
    """Return the lane groups of one example; None without a raster, its range, or traffic flow."""
    if ground is None or batch.bev is None or batch.traffic_flow is None:
        return None
    lanes, flow = jax.tree.map(lambda leaf: leaf[row], (batch.lanes, batch.traffic_flow))
    return lane_groups(lanes, np.asarray(batch.bev[row]), flow, ground)


def _labels(batch: Example) -> Example:
    """Return examples without sensor data and priors, which no protocol reads."""
    inputs = ("bev", "hidden", "cameras", "traffic_flow", "markers", "sd_map")
    return batch.replace(**dict.fromkeys(inputs))  # pyright: ignore[reportAttributeAccessIssue]


class Sightings:
    """Groups the frames of scenes, in order, by marker visibility.

    "seen": a marker is detected; "gap": none is, but one was earlier in this scene; "before": none so far.
    """

    groups: tuple[str, ...] = ("seen", "gap", "before")

    def __init__(self) -> None:
        self._ever = False

    def next(self, seen: Any, has_previous: Any) -> str:
        """Return the group of the next frame."""
        before = self._ever and bool(has_previous)
        self._ever = before or bool(seen)
        return "seen" if seen else "gap" if before else "before"
