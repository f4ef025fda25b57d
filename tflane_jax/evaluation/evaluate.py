"""Predicting a whole dataset and measuring the lanes of it."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
from jax import lax

from tflane_jax.datasets.streaming import Streamed
from tflane_jax.evaluation.centerlines import detections_from_prediction, truth_from_example
from tflane_jax.metrics.openlane_v2 import GroupedCenterlineMetrics
from tflane_jax.scene import Example
from tflane_jax.training.batches import ordered_batches
from tflane_jax.training.task import Params, Task


@functools.partial(jax.jit, static_argnums=0)
def predict_batch(task: Task, params: Params, batch: Any) -> Any:
    """Return the answers for a batch (leading axis on every leaf); compiled once per task and shape."""
    return jax.vmap(task.predict, in_axes=(None, 0))(params, batch)


@functools.partial(jax.jit, static_argnums=0)
def predict_stream(task: Any, params: Params, memory: Any, frames: Any) -> tuple[Any, Any]:
    """Return the memory behind some frames (leading axis on every leaf) and the answers, one frame after the other."""
    return lax.scan(functools.partial(task.step, params), memory, frames)


def predictions(task: Task, params: Params, arrays: Any, batch_size: int) -> Iterator[tuple[range, Any]]:
    """Yield the answers for all examples in order: their indices and a stacked tree of numpy arrays.

    Args:
        task, params: the model; hashable, see `Task`.
        arrays: examples, see `training.batches`.
        batch_size: examples predicted at a time. The last batch is filled up and cut, so that one program serves all.
    """
    for indices, _, answers in _answered(task, params, arrays, batch_size):
        yield indices, answers


def _answered(task: Task, params: Params, arrays: Any, batch_size: int) -> Iterator[tuple[range, Any, Any]]:
    """Yield indices, examples and answers, the last two stacked; there may be more examples than indices.

    A task that is trained on clips goes through the examples in order, as a stream with memory; where a scene begins,
    `has_previous` empties it.
    """
    params, streams = jax.device_put(params), getattr(task, "clip", 1) > 1
    memory = task.start() if streams else None  # pyright: ignore[reportAttributeAccessIssue]
    for indices, batch in ordered_batches(arrays, batch_size):
        if streams:
            memory, answers = predict_stream(task, params, memory, batch)
        else:
            answers = predict_batch(task, params, batch)
        answers, kept = jax.device_get(answers), slice(len(indices))
        yield indices, batch, jax.tree.map(lambda leaf, kept=kept: leaf[kept], answers)


def evaluate_lanes(
    task: Task, params: Params, arrays: Example | Streamed, batch_size: int = 16
) -> GroupedCenterlineMetrics:
    """Return the filled accumulator of OpenLane-V2's centerline metrics (groups all, occluded, clear) of a dataset.

    Traffic elements are measured where the task predicts them and the examples have them. Examples that have markers
    are measured by what is known of markers as well, see `Sightings`.

    Args:
        task: predicts lanes.
        params: of the task.
        arrays: examples with `lanes`, see `training.batches`.
        batch_size: see `predictions`.

    Raises:
        ValueError: the task predicts no lanes.
    """
    sightings, metrics = Sightings(), None
    for indices, batch, answer in _answered(task, params, arrays, batch_size):
        if answer.lanes is None:
            raise ValueError("this task predicts no lanes, so there is nothing to measure")
        both = answer.elements is not None and batch.traffic_elements is not None
        found = answer.lanes, answer.elements if both else None
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
    """Shares out the frames of scenes, in order, by what is known of markers in them.

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
