"""All protocols for lanes around the vehicle, selected by what a model predicts and an example labels.

| predicted part | protocol | groups of numbers |
|---|---|---|
| `centerlines` (with `elements`) | OpenLane-V2 centerline | all, occluded, clear; those of `lane_groups`; seen, gap, |
| | | before for markers |
| `segments` (with `elements`) | LaneSegNet; in `all` also the devkit's | the same (`segments all` and so on beside |
| | | centerlines) |
| `lines` | MapTR | lines, and those of `map_metrics` |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.datasets.batches import ordered_batches
from tflane_jax.datasets.streaming import Streamed
from tflane_jax.evaluation.by_scene import counted_ratio, scene_numbers, shared_samples, summed_ratio
from tflane_jax.evaluation.centerlines import detections_of_centerlines, truth_of_centerlines
from tflane_jax.evaluation.geometric_topology import Topology
from tflane_jax.evaluation.interventions import with_traffic
from tflane_jax.evaluation.lane_groups import LANE_GROUPS, lane_groups, line_groups
from tflane_jax.evaluation.lane_segments import detections_of_segments, truth_of_segments
from tflane_jax.evaluation.map_metrics import LineLabel, MapLineMetrics
from tflane_jax.evaluation.predict import FOR_SCORES, Predictor, predicted_batches
from tflane_jax.evaluation.results import EvaluationConfig, SceneRatio, SceneSamples
from tflane_jax.evaluation.vector_maps import measured_lines
from tflane_jax.geometry import PerceptionRange
from tflane_jax.metrics.bootstrap import Weights
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS
from tflane_jax.metrics.groups import FrameGroup, GroupedMetrics
from tflane_jax.metrics.lane_segment import LaneSegmentMetrics
from tflane_jax.metrics.map_matching import MAP_THRESHOLDS, Dims, Measure
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics
from tflane_jax.metrics.segment_matching import match_segments
from tflane_jax.metrics.topology import Version
from tflane_jax.models.parameters import Params
from tflane_jax.scene import Example, MapLines, Prediction, row_of

T = TypeVar("T")

# Both kinds of protocols, for lanes and for lines, have three thresholds.
_THRESHOLDS = len(LANE_THRESHOLDS)
assert len(MAP_THRESHOLDS) == _THRESHOLDS

Members = Mapping[str, Bool[np.ndarray, " g"]]
"""For each group of lanes, which of the valid true lanes belong to it."""


class LaneGraphMetrics:
    """Accumulator of all protocols that apply to the predicted parts.

    Args:
        versions: versions of the OpenLane-V2 centerline metrics.
        frame_groups, lane_groups: names of the groups of frames and of further groups of lanes, see
            `metrics.groups.GroupedMetrics`.
        parts: predicted parts of which `compute` gives numbers before the first frame; each frame replaces them by its
            own.
        map_measures, line_labels, line_dims: of the lines of vector maps, see `MapLineMetrics`.
        topology: confidences of edges, see `geometric_topology.edge_confidences`.
    """

    def __init__(
        self,
        versions: Sequence[Version] = ("v2.1",),
        frame_groups: Sequence[str] = (),
        parts: Sequence[str] = ("centerlines",),
        lane_groups: Sequence[str] = (),
        map_measures: Sequence[Measure] = ("chamfer",),
        line_labels: Sequence[LineLabel] = (),
        line_dims: Dims = 2,
        topology: Topology = "learned",
    ) -> None:
        grouped = partial(GroupedMetrics, frame_groups=frame_groups, lane_groups=lane_groups)
        self._centerlines = grouped(partial(CenterlineMetrics, versions))
        self._continues: list[bool] = []  # whether a frame belongs to the scene of the frame before
        self._segments = grouped(partial(LaneSegmentMetrics, "LaneSegNet"))
        self._devkit = LaneSegmentMetrics("OpenLane-V2")
        self._lines = MapLineMetrics(
            map_measures, line_labels, lane_groups if line_labels else (), line_dims, frame_groups
        )
        self._measured = tuple(parts)
        self._topology: Topology = topology

    @property
    def protocol(self) -> str:
        """Names and versions of the protocols that apply."""
        return "; ".join(metrics.protocol for metrics in self._applied())

    def update(
        self,
        prediction: Prediction,
        example: Example,
        frame_group: FrameGroup = None,
        members: Mapping[str, Members] | None = None,
    ) -> None:
        """Add one frame; the frames of a scene come in succession.

        Args:
            prediction: the last decoder layer's prediction for this example.
            example: ground truth of all predicted parts. Traffic elements are measured if both have them.
            frame_group: the groups that this frame belongs to.
            members: by "centerlines", "segments" and "lines": for each of `lane_groups`, which of the valid true lanes
                (of the measured true lines) belong to it.

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
        members = members or {}
        if prediction.centerlines is not None:
            detections = detections_of_centerlines(prediction.centerlines, found, self._topology)
            lanes = truth_of_centerlines(example.lanes, true)
            self._centerlines.update(detections, lanes, frame_group, members.get("centerlines"))
        if prediction.segments is not None:
            segments = truth_of_segments(example.segments, example.areas, true, example.lanes)
            detected = detections_of_segments(prediction.segments, found, self._topology)
            frame = match_segments(detected, segments, nearest="all")
            self._segments.add(frame, segments, frame_group, members.get("segments"))
            self._devkit.add(frame)
        if prediction.lines is not None:
            self._lines.update(prediction.lines, example, frame_group, members.get("lines"))

    def compute(self) -> dict[str, dict[str, float]]:
        """Return metrics by name, for every group of every protocol that applies."""
        groups: dict[str, dict[str, float]] = {}
        if "centerlines" in self._measured:
            groups |= self._centerlines.compute()
        if "segments" in self._measured:
            segments = self._segments.compute()
            segments["all"] |= _of_devkit(self._devkit.compute())
            groups |= {self._prefix + group: values for group, values in segments.items()}
        if "lines" in self._measured:
            groups |= self._lines.compute()
        return groups

    def ratios(self) -> dict[str, SceneRatio]:
        """Return recall and topology scores of every group of lanes, and recall of lines, as sums over each scene."""
        if not self._continues:
            return {}
        recalled = self._centerlines.recalled() if "centerlines" in self._measured else {}
        means = self._centerlines.means() if "centerlines" in self._measured else {}
        if "segments" in self._measured:
            recalled |= {self._prefix + group: counts for group, counts in self._segments.recalled().items()}
            means |= {self._prefix + group: parts for group, parts in self._segments.means().items()}
        if "lines" in self._measured:
            recalled |= self._lines.recalled()
        scene, ratios = scene_numbers(self._continues), {}
        for group, counts in recalled.items():
            lanes, hits = counts.T
            ratios[f"{group}/recall"] = counted_ratio(np.stack([hits, _THRESHOLDS * lanes], -1), scene)
            for name, parts in means.get(group, {}).items():
                ratios[f"{group}/{name}"] = summed_ratio(parts, scene)
        return ratios

    def samples(self) -> dict[str, SceneSamples]:
        """Return the scores that rank detections, of every group, in bootstrap samples of the scenes."""
        return shared_samples(self._bootstrap, scene_numbers(self._continues), self.ratios())

    def _bootstrap(self, weights: Weights) -> dict[str, dict[str, Float[np.ndarray, " b"]]]:
        groups = self._centerlines.bootstrap(weights) if "centerlines" in self._measured else {}
        if "segments" in self._measured:
            segments = self._segments.bootstrap(weights)
            if "TOP_lt" in self._devkit.means():  # elements were measured: its own scores
                segments["all"] |= _of_devkit(self._devkit.bootstrap(weights))
            groups |= {self._prefix + group: values for group, values in segments.items()}
        return groups | (self._lines.bootstrap(weights) if "lines" in self._measured else {})

    @property
    def _prefix(self) -> str:
        """Prefix of the names of groups of segments, to distinguish them from groups of centerlines."""
        return "segments " if "centerlines" in self._measured else ""

    def _applied(self) -> list[Any]:
        """Return the accumulators that apply."""
        applied: list[Any] = [self._centerlines] if "centerlines" in self._measured else []
        applied += [self._segments, self._devkit] if "segments" in self._measured else []
        return applied + ([self._lines] if "lines" in self._measured else [])


def _of_devkit(values: Mapping[str, T]) -> dict[str, T]:
    """Return the devkit's numbers that LaneSegNet's do not contain; TOP_lt is TOP_lste of its papers."""
    names = {"DET_a": "DET_a", "DET_t": "DET_t", "TOP_lt": "TOP_lste", "OLUS": "OLUS"}
    names |= {name: name for name in values if name.startswith("DET_t@")}
    return {theirs: values[name] for name, theirs in names.items() if name in values}


def line_labels(lines: MapLines | None) -> tuple[LineLabel, ...]:
    """Return the labels that lines have beside shape and class."""
    known = () if lines is None else (("visibility", lines.visibility), ("identity", lines.identity))
    return tuple(name for name, values in known if values is not None)  # pyright: ignore[reportReturnType]


def _line_dims(batch: Example, answer: Prediction) -> Dims:
    """Return 3 for a model that predicts heights, if they are labelled."""
    heights = answer.lines is not None and answer.lines.points.shape[-1] == 3
    return 3 if heights and batch.map_lines is not None else 2


def evaluate_lanes(
    task: Predictor,
    params: Params,
    arrays: Example | Streamed,
    config: EvaluationConfig | None = None,
    *,
    ground: PerceptionRange | None = None,
    frame_groups: Sequence[str] = (),
) -> LaneGraphMetrics:
    """Return the filled accumulator of a dataset.

    Frames of examples with markers are grouped by marker visibility as well, see `Sightings`. Lanes of examples with
    BEV evidence and traffic flow are grouped by both, see `evaluation.lane_groups`, whatever traffic the model sees;
    so are labelled lines of a vector map.

    Args:
        task: a model that predicts lanes of any kind.
        params: its parameters.
        arrays: examples with ground truth, see `datasets.batches`.
        config: batch size, versions, and traffic flow that the model sees.
        ground: the range that the BEV evidence covers; None for a model that does not see it, without those groups.
        frame_groups: the name of a further group for each example, in their order; () for none.

    Raises:
        ValueError: the task predicts no lanes.
        UserError: the examples do not allow the configured traffic flow, see `with_traffic`.
    """
    config = config or EvaluationConfig()
    sightings = Sightings()
    metrics: LaneGraphMetrics | None = None
    changed = with_traffic(arrays, config.traffic)
    predicted = predicted_batches(task, params, changed, config.batch_size, _without_images, what=FOR_SCORES)
    originals = None if changed is arrays else ordered_batches(arrays, config.batch_size)
    for indices, batch, answer in predicted:
        if originals is not None:
            _, batch = next(originals)
        if metrics is None:  # the first batch tells what is predicted and labelled
            of_markers = () if batch.markers is None else sightings.groups
            metrics = LaneGraphMetrics(
                config.versions,
                frame_groups=(*of_markers, *dict.fromkeys(frame_groups)),
                lane_groups=LANE_GROUPS if _members(batch, answer, 0, ground) else (),
                map_measures=config.map_measures,
                line_labels=line_labels(batch.map_lines),
                line_dims=_line_dims(batch, answer),
                topology=config.topology,
            )
        for row, index in enumerate(indices):
            prediction, example = jax.tree.map(lambda leaf, i=row: leaf[i], (answer, _labels(batch)))
            groups = [frame_groups[index]] if frame_groups else []
            if batch.markers is not None:
                groups.append(sightings.next(batch.markers.valid[row].any(), batch.has_previous[row]))
            metrics.update(prediction, example, groups, _members(batch, answer, row, ground))
    return LaneGraphMetrics(config.versions) if metrics is None else metrics


def _members(batch: Example, answer: Prediction, row: int, ground: PerceptionRange | None) -> dict[str, Members]:
    """Return the lane groups of one example by predicted part; none without a raster, its range, or traffic flow."""
    if ground is None or batch.bev is None or batch.traffic_flow is None:
        return {}
    bev, flow = row_of((batch.bev, batch.traffic_flow), row)
    true = {"centerlines": batch.lanes, "segments": batch.segments}
    members: dict[str, Members] = {
        part: lane_groups(row_of(lanes, row), bev, flow, ground)
        for part, lanes in true.items()
        if getattr(answer, part) is not None
    }
    if answer.lines is not None and batch.map_lines is not None:
        found, lines = row_of((answer.lines, batch.map_lines), row)
        members["lines"] = line_groups(replace(lines, valid=measured_lines(lines, found)), bev, flow, ground)
    return members


def _labels(batch: Example) -> Example:
    """Return examples without sensor data and priors, which no protocol reads."""
    inputs = ("bev", "hidden", "cameras", "traffic_flow", "markers", "sd_map")
    return batch.replace(**dict.fromkeys(inputs))  # pyright: ignore[reportAttributeAccessIssue]


def _without_images(batch: Example) -> Example:
    return batch.replace(cameras=None)  # pyright: ignore[reportAttributeAccessIssue]


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
