"""Every protocol for what is around the vehicle: centerlines, lane segments, vector maps, by what a model predicts."""

from __future__ import annotations

from typing import Any

import jax

from tflane_jax.datasets.streaming import Streamed
from tflane_jax.evaluation.centerlines import detections_from_prediction, truth_from_example
from tflane_jax.evaluation.predict import Predictor, predicted_batches
from tflane_jax.metrics.openlane_v2 import GroupedCenterlineMetrics
from tflane_jax.models.parameters import Params
from tflane_jax.scene import Example


def evaluate_lanes(
    task: Predictor, params: Params, arrays: Example | Streamed, batch_size: int = 16
) -> GroupedCenterlineMetrics:
    """Return the filled accumulator of OpenLane-V2's centerline metrics (groups all, occluded, clear) of a dataset.

    Traffic elements are measured where the task predicts them and the examples have them. Examples that have markers
    are measured by marker visibility as well, see `Sightings`.

    Args:
        task: predicts centerlines.
        params: of the task.
        arrays: examples with `lanes`, see `datasets.batches`.
        batch_size: see `predictions`.

    Raises:
        ValueError: the task predicts no centerlines.
    """
    sightings, metrics = Sightings(), None
    for indices, batch, answer in predicted_batches(task, params, arrays, batch_size):
        if answer.centerlines is None:
            raise ValueError("this task predicts no lanes, so there is nothing to measure")
        both = answer.elements is not None and batch.traffic_elements is not None
        found = answer.centerlines, answer.elements if both else None
        true = batch.lanes, batch.traffic_elements if both else None
        metrics = metrics or GroupedCenterlineMetrics(frame_groups=sightings.groups if batch.markers else ())
        for row in range(len(indices)):
            metrics.update(
                detections_from_prediction(*jax.tree.map(lambda leaf, i=row: leaf[i], found)),
                truth_from_example(*jax.tree.map(lambda leaf, i=row: leaf[i], true)),
                sightings.next(batch.markers.valid[row].any(), batch.has_previous[row]) if batch.markers else None,
            )
    return metrics or GroupedCenterlineMetrics()


class Sightings:
    """Groups the frames of scenes, in order, by marker visibility.

    "seen": a marker is detected; "gap": none is, but one was before in this scene; "before": none was yet.
    """

    groups: tuple[str, ...] = ("seen", "gap", "before")

    def __init__(self) -> None:
        self._ever = False

    def next(self, seen: Any, has_previous: Any) -> str:
        """Return the group of the next frame."""
        before = self._ever and bool(has_previous)
        self._ever = before or bool(seen)
        return "seen" if seen else "gap" if before else "before"
