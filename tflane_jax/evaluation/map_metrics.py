"""MapTR's metrics of one model's lines: Chamfer AP with groups of lines, AP by overlap, consistency over sequences."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.evaluation.line_tracks import LineTracks
from tflane_jax.evaluation.vector_maps import detections_of_lines, truth_of_lines, truth_of_segment_lines
from tflane_jax.metrics.bootstrap import Weights
from tflane_jax.metrics.consistency import CONFIDENT, MapConsistency
from tflane_jax.metrics.groups import FrameGroup, GroupedMetrics
from tflane_jax.metrics.map_matching import Dims, MatchedMap, Measure, match_map
from tflane_jax.metrics.partitions import BY_OCCLUSION
from tflane_jax.metrics.vector_map import VectorMapMetrics
from tflane_jax.scene import Example, LinePrediction

LineLabel = Literal["visibility", "identity"]
"""Labels of lines beside shape and class."""


class MapLineMetrics:
    """Accumulator over frames, those of a scene in succession.

    | group | numbers |
    |---|---|
    | `lines` | Chamfer AP of all lines; `C-mAP` if lines have identities |
    | `lines occluded`, `lines clear` | Chamfer AP by visibility, if it is labelled |
    | `lines hidden+traffic` ... | Chamfer AP of the further groups of lines |
    | `lines near training` ... | Chamfer AP of all lines in a group of frames |
    | `lines IoU` | AP by overlap of buffers, if asked for |

    Args:
        measures: "chamfer", always measured, and "iou".
        labels: that the true lines have.
        groups: names of further groups of lines, see `evaluation.lane_groups`.
        dims: 3 measures heights, too; only labelled lines have them.
        frame_groups: names of groups of frames.
    """

    def __init__(
        self,
        measures: Collection[Measure] = ("chamfer",),
        labels: Collection[LineLabel] = (),
        groups: Sequence[str] = (),
        dims: Dims = 2,
        frame_groups: Sequence[str] = (),
    ) -> None:
        self._dims: Dims = dims
        partition = BY_OCCLUSION.names if "visibility" in labels else ()
        make = partial(VectorMapMetrics, dims=dims)
        self._chamfer = GroupedMetrics(make, ("all", *partition), frame_groups=frame_groups, lane_groups=groups)
        self._overlap = VectorMapMetrics(measure="iou", dims=dims) if "iou" in measures else None
        self._consistency = MapConsistency() if "identity" in labels else None
        self._tracks = LineTracks()

    @property
    def protocol(self) -> str:
        """Names and versions."""
        measured = (self._chamfer, self._overlap, self._consistency)
        return "; ".join(metrics.protocol for metrics in measured if metrics is not None)

    def update(
        self,
        lines: LinePrediction,
        example: Example,
        frame_group: FrameGroup = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one frame.

        Args:
            lines: the last decoder layer's prediction.
            example: with labelled lines; without, they are derived from its lane segments and areas.
            frame_group: the groups that this frame belongs to.
            members: for each of the further groups, which of the measured true lines belong to it.
        """
        lines = replace(lines, points=lines.points[..., : self._dims])
        detections = detections_of_lines(lines)
        truth = truth_of_segment_lines(example.segments, example.areas)
        if example.map_lines is not None:
            truth = truth_of_lines(example.map_lines, lines)
        frame = match_map(detections, truth, dims=self._dims, nearest="all")
        self._chamfer.add(frame, truth, frame_group, members)
        if self._overlap is not None:
            self._overlap.update(detections, truth)
        if self._consistency is not None and truth.identity is not None:
            points = np.asarray(detections.points)
            self._track(self._consistency, frame, points, np.asarray(truth.identity), example)

    def _track(
        self,
        consistency: MapConsistency,
        frame: MatchedMap,
        points: np.ndarray,
        lines: Int[np.ndarray, " g"],
        example: Example,
    ) -> None:
        if not example.has_previous:
            consistency.start()
            self._tracks.start()
        confident = frame.scores > CONFIDENT
        kept = frame.detections(confident)
        identities = self._tracks.step(points[confident][..., :2], kept.classes, np.asarray(example.previous_from_ego))
        consistency.add(kept, identities, lines)

    def compute(self) -> dict[str, dict[str, float]]:
        """Return metrics by name, for every group."""
        groups = {_name(group): values for group, values in self._chamfer.compute().items()}
        if self._consistency is not None:
            groups["lines"] |= self._consistency.compute()
        if self._overlap is not None:
            groups["lines IoU"] = self._overlap.compute()
        return groups

    def bootstrap(self, weights: Weights) -> dict[str, dict[str, Float[np.ndarray, " b"]]]:
        """Return by group the Chamfer AP, and `C-mAP`, in samples of the frames, see `metrics.bootstrap`."""
        groups = {_name(group): values for group, values in self._chamfer.bootstrap(weights).items()}
        if self._consistency is not None:
            groups["lines"] |= self._consistency.bootstrap(weights)
        return groups

    def recalled(self) -> dict[str, Int[np.ndarray, "f 2"]]:
        """Return by group, for every frame: true lines, and hits summed over the thresholds."""
        return {_name(group): counts for group, counts in self._chamfer.recalled().items()}


def _name(group: str) -> str:
    return "lines" if group == "all" else f"lines {group}"
