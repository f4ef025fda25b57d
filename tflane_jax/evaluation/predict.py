"""Predicting a whole dataset: in batches, or as streams with memory."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import jax
import numpy as np
from jax import lax

from tflane_jax.datasets.base import Dataset
from tflane_jax.datasets.batches import ordered_batches
from tflane_jax.models.parameters import Params
from tflane_jax.scene import Example, Prediction, stack_examples


class Predictor(Protocol):
    """A model as evaluation calls it; hashable, because jit takes it as a static argument."""

    @property
    def streams(self) -> bool:
        """Whether frames of a scene are predicted one after the other, with memory."""
        ...

    def predict(self, params: Params, example: Any) -> Prediction:
        """Return the prediction for one example, a frame on its own: no batch axis, no dropout, no host callback."""
        ...

    def start(self) -> Any:
        """Return the memory before the first frame of a sequence."""
        ...

    def step(self, params: Params, memory: Any, example: Any) -> tuple[Any, Prediction]:
        """Return the memory for the next frame, and the prediction for this one."""
        ...


@functools.partial(jax.jit, static_argnums=0)
def predict_batch(task: Predictor, params: Params, batch: Any) -> Prediction:
    """Return the predictions for a batch (leading axis on every leaf); compiled once per task and shape."""
    return jax.vmap(task.predict, in_axes=(None, 0))(params, batch)


@functools.partial(jax.jit, static_argnums=0)
def predict_stream(task: Predictor, params: Params, memory: Any, frames: Any) -> tuple[Any, Prediction]:
    """Return the memory after some frames (leading axis on every leaf) and their predictions, in order."""
    return lax.scan(functools.partial(task.step, params), memory, frames)


def predictions(task: Predictor, params: Params, arrays: Any, batch_size: int) -> Iterator[tuple[range, Prediction]]:
    """Yield the predictions for all examples in order: their indices and a stacked tree of numpy arrays.

    Args:
        task, params: the model.
        arrays: examples, see `datasets.batches`.
        batch_size: examples predicted at a time. The last batch is filled up and cut, so that one program serves all.
    """
    for indices, _, answers in predicted_batches(task, params, arrays, batch_size):
        yield indices, answers


def predicted_batches(
    task: Predictor, params: Params, arrays: Any, batch_size: int
) -> Iterator[tuple[range, Any, Prediction]]:
    """Yield indices, examples and predictions, the last two stacked; there may be more examples than indices.

    A model with memory goes through the examples in order, as a stream; where a scene begins, `has_previous` empties
    its memory.
    """
    params = jax.device_put(params)
    memory = task.start() if task.streams else None
    for indices, batch in ordered_batches(arrays, batch_size):
        if task.streams:
            memory, answers = predict_stream(task, params, memory, batch)
        else:
            answers = predict_batch(task, params, batch)
        answers, kept = jax.device_get(answers), slice(len(indices))
        yield indices, batch, jax.tree.map(lambda leaf, kept=kept: leaf[kept], answers)


def predict_examples(
    task: Predictor, params: Params, dataset: Dataset, indices: Sequence[int]
) -> tuple[Example, Prediction]:
    """Return some examples whole, with truth and all, and the predictions for them; both stacked, numpy.

    A model with memory goes through each example's scene up to it.
    """
    examples = stack_examples([dataset.example(index) for index in indices])
    if not task.streams:
        ((_, answer),) = predictions(task, params, examples, len(indices))
        return examples, answer
    every = [_streamed(task, params, dataset, index) for index in indices]
    return examples, jax.tree.map(lambda *leaves: np.concatenate(leaves), *every)


def _streamed(task: Predictor, params: Params, dataset: Dataset, index: int) -> Prediction:
    """Return the prediction for an example, as a stack of one, after the earlier frames of its scene."""
    frames = [dataset.example(index)]
    while frames[0].has_previous:
        frames.insert(0, dataset.example(index - len(frames)))
    *_, (_, answer) = predictions(task, params, stack_examples(frames), 1)
    return answer
