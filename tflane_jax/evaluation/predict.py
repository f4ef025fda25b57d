"""Prediction for a whole dataset: in batches, or as streams with memory."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh

from tflane_jax.datasets.base import Dataset
from tflane_jax.datasets.batches import ordered_batches
from tflane_jax.datasets.loading import keep
from tflane_jax.devices import divided, everywhere, prediction_mesh, replicated, share
from tflane_jax.models.parameters import Params
from tflane_jax.processes import all_rows, process_count
from tflane_jax.scene import Example, Prediction, stack_examples
from tflane_jax.startup import compiled

# Examples of one call of `predict_examples`: a model needs memory for the activations of all of them.
_AT_ONCE = 16
# What a stage of compiling is for. One program does both in a training and a comparison, and is compiled for scores.
PREDICTION = "the prediction"
FOR_SCORES, FOR_PICTURES = f"{PREDICTION} for scores", f"{PREDICTION} for pictures"


class Predictor(Protocol):
    """The methods of a model that evaluation calls; hashable, because jit takes it as a static argument."""

    @property
    def streams(self) -> bool:
        """Whether the frames of a scene are predicted in order, with memory."""
        ...

    def predict(self, params: Params, example: Any) -> Prediction:
        """Return the prediction for one example without memory: no batch axis, no dropout, no host callback."""
        ...

    def start(self) -> Any:
        """Return the memory before the first frame of a sequence."""
        ...

    def step(self, params: Params, memory: Any, example: Any) -> tuple[Any, Prediction]:
        """Return the memory for the next frame, and the prediction for this one."""
        ...


@functools.partial(jax.jit, static_argnums=(0, 3))
def predict_batch(task: Predictor, params: Params, batch: Any, mesh: Mesh | None = None) -> Prediction:
    """Return the predictions for a batch (leading axis on every leaf); compiled once per task and shape.

    With a mesh, which divides the batch, every device gets all predictions.
    """
    answers = jax.vmap(task.predict, in_axes=(None, 0))(params, batch)
    return answers if mesh is None else lax.with_sharding_constraint(answers, everywhere(mesh))


@functools.partial(jax.jit, static_argnums=0)
def predict_stream(task: Predictor, params: Params, memory: Any, frames: Any) -> tuple[Any, Prediction]:
    """Return the memory after some frames (leading axis on every leaf) and their predictions, in order."""
    return lax.scan(functools.partial(task.step, params), memory, frames)


def predictions(
    task: Predictor, params: Params, arrays: Any, batch_size: int, *, what: str = PREDICTION
) -> Iterator[tuple[range, Prediction]]:
    """Yield indices and stacked predictions (numpy) for all examples, in order.

    Args:
        task, params: the model.
        arrays: examples, see `datasets.batches`.
        batch_size: examples per call. The last batch is padded and its predictions cut, so that all batches use one
            compiled program.
        what: what is computed, for the names of the stages that compile it.
    """
    for indices, _, answers in predicted_batches(task, params, arrays, batch_size, lambda batch: None, what=what):
        yield indices, answers


def predicted_batches(
    task: Predictor,
    params: Params,
    arrays: Any,
    batch_size: int,
    needed: Callable[[Any], Any] | None = None,
    *,
    what: str = PREDICTION,
) -> Iterator[tuple[range, Any, Prediction]]:
    """Yield indices, stacked examples and stacked predictions; padding may add examples beyond the indices.

    A model with memory processes the examples in order, as a stream; at the start of a scene, `has_previous` is False
    and its memory is ignored. Several devices share each batch, if they can do so evenly. Each of several processes
    then loads its own rows alone.

    Args:
        task, params: the model.
        arrays, batch_size, what: see `predictions`.
        needed: batch -> what the caller reads of it, which alone is exchanged between processes; None for all.
    """
    mesh = None if task.streams else prediction_mesh(batch_size)
    params, part = replicated(params, mesh), share(mesh)
    memory = task.start() if task.streams else None
    running = None
    # While the device predicts a batch, the caller reads the one before, and the next one is loaded.
    for indices, batch in ordered_batches(arrays, batch_size, part):
        predicted = None if running is None else _fetched(*running)
        if task.streams:
            memory, answers = _run_compiled(predict_stream, what, task, params, memory, batch)
        else:
            rows = divided(batch, mesh) if mesh is not None else batch
            answers = _run_compiled(predict_batch, what, task, params, rows, mesh)
            if part[1] > 1:
                batch = all_rows(batch if needed is None else needed(batch))
        running = indices, batch, answers
        if predicted is not None:
            yield predicted
    if running is not None:
        yield _fetched(*running)


def undivided_notices(task: Predictor, batch_size: int) -> list[str]:
    """Return what to tell where an evaluation uses one of several devices, because they cannot share its batches."""
    devices = jax.device_count()
    if task.streams or batch_size % devices == 0:
        return []
    lone = "each process predicts everything on one device" if process_count() > 1 else "one predicts everything"
    return [
        f"{devices} devices cannot share batches of {batch_size} (evaluation.batch_size), so that {lone}: batches of "
        f"{-(-batch_size // devices) * devices} would use all"
    ]


def _fetched(indices: range, batch: Any, answers: Prediction) -> tuple[range, Any, Prediction]:
    answers = jax.device_get(answers)
    return indices, batch, jax.tree.map(lambda leaf: leaf[: len(indices)], answers)


def _run_compiled(program: Any, what: str, task: Predictor, *arguments: Any) -> Any:
    """Return `program(task, *arguments)`; what it has to compile first is shown, and can be interrupted."""
    leaves, tree = jax.tree.flatten(arguments)
    kinds = tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves if not isinstance(leaf, Mesh))
    if (key := (program, task, tree, kinds)) not in _compiled:
        compiled(program, task, *arguments, what=what)
        _compiled.add(key)
    return program(task, *arguments)


_compiled: set[Any] = set()


def predict_examples(
    task: Predictor,
    params: Params,
    dataset: Dataset,
    indices: Sequence[int],
    *,
    batch_size: int | None = None,
    parts: Collection[str] = (),
    what: str = PREDICTION,
) -> tuple[Example, Prediction]:
    """Return some examples with all their fields, and the predictions for them; both stacked, numpy.

    A model with memory first processes the earlier frames of each example's scene. With the batch size and the parts of
    an evaluation, the program is that of the evaluation, and not compiled again.

    Args:
        task, params: the model.
        dataset, indices: the examples.
        batch_size: examples per call, or frames of a scene; None: up to 16, or one.
        parts: fields of `Example` that the model sees, see `Task.parts`; none for all.
        what: see `predictions`.
    """
    examples = stack_examples([dataset.example(index) for index in indices])
    predicted = functools.partial(_predicted, task, params, batch_size=batch_size, parts=parts, what=what)
    if task.streams:
        every = [jax.tree.map(lambda leaf: leaf[-1:], predicted(_frames_until(dataset, index))) for index in indices]
        return examples, jax.tree.map(lambda *leaves: np.concatenate(leaves), *every)
    return examples, predicted(examples)


def _predicted(
    task: Predictor, params: Params, examples: Example, *, batch_size: int | None, parts: Collection[str], what: str
) -> Prediction:
    size = batch_size or (1 if task.streams else min(len(examples.has_previous), _AT_ONCE))
    seen = keep(examples, parts) if parts else examples
    every = [answer for _, answer in predictions(task, params, seen, size, what=what)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *every)


def _frames_until(dataset: Dataset, index: int) -> Example:
    """Return the frames of an example's scene up to it, stacked."""
    frames = [dataset.example(index)]
    while frames[0].has_previous:
        frames.insert(0, dataset.example(index - len(frames)))
    return stack_examples(frames)
