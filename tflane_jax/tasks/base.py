"""What a task is: a model with its loss, its data, its numbers and its pictures, in one typed object.

A task is a frozen dataclass: its fields are settings, and jit takes it as a static argument. The training loop calls
its learning part (`training.task.Trainable`), evaluation its predicting part (`evaluation.predict.Predictor`), and the
program around them the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float

from tflane_jax.datasets.data_source import SplitData
from tflane_jax.datasets.streaming import Prepare, Streamed
from tflane_jax.evaluation.results import Evaluation, EvaluationConfig
from tflane_jax.models.parameters import Params
from tflane_jax.scene import Prediction

ExampleT = TypeVar("ExampleT")
"""What the task learns from: `Example` or `RoadImage`."""
DataT = TypeVar("DataT")
"""A split as `load` returns it and `evaluate` takes it."""

Terms = dict[str, Float[Array, ""] | Params]
"""Numbers to record of a loss; the entry `STATISTICS` holds new running statistics."""
Draw = Callable[[Path, int, Params], None]
"""(run folder, step, averaged parameters) -> pictures in the run folder."""


@dataclass(frozen=True)
class Model:
    """A trained model as comparisons and pictures take it.

    Attributes:
        task: model and losses.
        params: of one seed.
    """

    task: Task[Any, Any]
    params: Params


@dataclass(frozen=True)
class Task(Generic[ExampleT, DataT]):
    """Base of all tasks. `Source` below is what `data.source(split)` gives."""

    columns: ClassVar[tuple[str, ...]] = ()
    """Of the evaluation's table, as far as an evaluation has them."""
    compared: ClassVar[tuple[str, ...]] = ()
    """Scores ("group/name") that a comparison tests, as far as all of its models have them."""
    errors: ClassVar[tuple[str, ...]] = ()
    """Compared scores where lower is better."""

    # -----------------------------------------------------------------------------------------------------------------
    # Learning

    @property
    def frames(self) -> int:
        """Successive frames that training sees as one example; 1 for frames on their own."""
        return 1

    def init(self, key: jax.Array, example: ExampleT) -> Params:
        """Return fresh parameters; `example` gives shapes only."""
        raise NotImplementedError

    def loss(self, params: Params, batch: ExampleT, key: jax.Array) -> tuple[Float[Array, ""], Terms]:
        """Return the loss of a batch (leading axis on every leaf) and what is recorded of it; `key` is for dropout."""
        raise NotImplementedError

    # -----------------------------------------------------------------------------------------------------------------
    # Predicting

    @property
    def streams(self) -> bool:
        """Whether evaluation predicts the frames of a scene one after the other, with memory."""
        return False

    def predict(self, params: Params, example: ExampleT) -> Prediction:
        """Return the last decoder layer's prediction for one example, a frame on its own."""
        raise NotImplementedError

    def start(self) -> Any:
        """Return the memory before the first frame of a sequence; None for a model without memory."""
        return None

    def step(self, params: Params, memory: Any, example: ExampleT) -> tuple[Any, Prediction]:
        """Return the memory for the next frame, and the prediction for this one."""
        return memory, self.predict(params, example)

    # -----------------------------------------------------------------------------------------------------------------
    # Data

    @property
    def parts(self) -> tuple[str, ...]:
        """Fields of an example that training and evaluation read; empty where all are read."""
        return ()

    def load(self, source: Any, *, progress: bool = True) -> DataT:
        """Return a split, in memory or as a `Streamed` that reads it while it is used."""
        raise NotImplementedError

    def examples(self, data: DataT) -> ExampleT | Streamed:
        """Return what training looks at of a split, as `datasets.batches` takes it."""
        raise NotImplementedError

    def shapes(self, data: SplitData) -> ExampleT:
        """Return shapes and types of one example, as far as can be told without its data."""
        raise NotImplementedError

    def check(self, data: SplitData, train: DataT) -> None:
        """Raise UserError where the training split shows that the model cannot learn from these data."""

    def prepare(self, data: SplitData) -> Prepare | None:
        """Return the augmentation of training examples, None for none."""
        return None

    # -----------------------------------------------------------------------------------------------------------------
    # Numbers and pictures

    def evaluate(self, params: Params, data: DataT, config: EvaluationConfig) -> Evaluation:
        """Return the metrics of a model on a split."""
        raise NotImplementedError

    def score_names(self, data: SplitData, config: EvaluationConfig) -> set[str]:
        """Return the names ("group/name") of the scores that evaluating on the validation split gives."""
        raise NotImplementedError

    def drawing(self, data: SplitData, config: EvaluationConfig) -> Draw:
        """Return the function that draws predictions for a few validation examples while training."""
        raise NotImplementedError

    def draw_comparison(self, models: Mapping[str, Model], source: Any, data: DataT, path: Path) -> Path:
        """Draw what several models predict for the same examples; return the picture's path."""
        raise NotImplementedError

    # -----------------------------------------------------------------------------------------------------------------
    # Comparing

    def inference_variants(self) -> dict[str, Task[ExampleT, DataT]]:
        """Return further ways to use a trained model that a comparison lists, by what to add to its name."""
        return {}

    def remarks(self, params: Params) -> dict[str, str]:
        """Return further columns of a comparison's row."""
        del params
        return {}

    def quoted(self) -> list[dict[str, str]]:
        """Return rows that a comparison quotes from papers."""
        return []


def spread(size: int, count: int) -> list[int]:
    """Return `count` indices spread evenly over `size` (all of them if there are fewer)."""
    return np.unique(np.linspace(0, size - 1, min(count, size)).round().astype(int)).tolist()
