"""Base class of tasks: a model with its loss, data, metrics and pictures, in one typed object.

A task is a frozen dataclass: its fields are settings, and jit takes it as a static argument. The training loop uses its
methods for learning (`training.task.Trainable`), evaluation those for prediction (`evaluation.predict.Predictor`), and
the commands the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import jax
from jaxtyping import Array, Float

from tflane_jax.datasets.data_source import SplitData
from tflane_jax.datasets.streaming import Prepare, Streamed
from tflane_jax.evaluation.results import Evaluation, EvaluationConfig
from tflane_jax.metrics.directions import ERRORS
from tflane_jax.models.parameters import Params
from tflane_jax.scene import Prediction

ExampleT = TypeVar("ExampleT")
"""Type of an example: `Example` or `RoadImage`."""
DataT = TypeVar("DataT")
"""Type of a split, as returned by `load` and taken by `evaluate`."""
SourceT = TypeVar("SourceT")
"""Type of the configuration that names a split, as returned by `data.source(split)`."""
MemoryT = TypeVar("MemoryT")
"""Type of what a model carries from frame to frame; None for a model without memory."""

Recorded = dict[str, Float[Array, ""] | Params]
"""Numbers to record beside a loss; the entry `STATISTICS` holds the new running statistics."""
Draw = Callable[[Path, int, Params], None]
"""(run folder, step, averaged parameters) -> None; writes pictures to the run folder."""


@dataclass(frozen=True)
class Model:
    """A trained model of a comparison.

    Attributes:
        task: model and losses.
        params: parameters of one seed.
        batch_size: of its evaluation, whose compiled program also predicts what is drawn.
    """

    task: AnyTask
    params: Params
    batch_size: int = 16


@dataclass(frozen=True)
class Task(Generic[ExampleT, DataT, SourceT, MemoryT]):
    """Base class of all tasks."""

    columns: ClassVar[tuple[str, ...]] = ()
    """Columns of the evaluation's table; those that an evaluation lacks are left out."""
    compared: ClassVar[tuple[str, ...]] = ()
    """Scores ("group/name") that a comparison tests; those that some model lacks are left out."""
    shown: ClassVar[Sequence[str]] = ()
    """Scores in the tables of a comparison, in this order; () for `compared`."""
    errors: ClassVar[tuple[str, ...]] = ERRORS
    """Scores where lower is better, without their group ("loss", not "all/loss")."""
    open_base: ClassVar[bool] = True
    """Settings of this type accept any subclass, see `config_io.subclasses`."""

    # -----------------------------------------------------------------------------------------------------------------
    # Learning

    @property
    def frames(self) -> int:
        """Number of successive frames in a training example; 1 for single frames."""
        return 1

    @property
    def loops(self) -> bool:
        """Whether the gradient of the loss has loops around the model, see `training.loop_convolutions`."""
        return False

    @property
    def unrolled(self) -> AnyTask:
        """The same task with a program that has no such loops."""
        return self

    @property
    def frozen(self) -> tuple[str, ...]:
        """Paths of modules that are never trained, and so need weights to start from."""
        return ()

    def init(self, key: jax.Array, example: ExampleT) -> Params:
        """Return initial parameters; only the shapes of `example` are used."""
        raise NotImplementedError

    def loss(self, params: Params, batch: ExampleT, key: jax.Array) -> tuple[Float[Array, ""], Recorded]:
        """Return the loss of a batch (leading axis on every leaf) and the numbers to record; `key` is for dropout."""
        raise NotImplementedError

    # -----------------------------------------------------------------------------------------------------------------
    # Predicting

    @property
    def streams(self) -> bool:
        """Whether evaluation predicts the frames of a scene in order, with memory."""
        return False

    def predict(self, params: Params, example: ExampleT) -> Prediction:
        """Return the last decoder layer's prediction for one example, without memory of earlier frames."""
        raise NotImplementedError

    def start(self) -> MemoryT:
        """Return the memory before the first frame of a sequence."""
        raise NotImplementedError

    def step(self, params: Params, memory: MemoryT, example: ExampleT) -> tuple[MemoryT, Prediction]:
        """Return the memory for the next frame, and the prediction for this one."""
        return memory, self.predict(params, example)

    # -----------------------------------------------------------------------------------------------------------------
    # Data

    @property
    def parts(self) -> tuple[str, ...]:
        """Fields of an example that training and evaluation read; empty: all fields."""
        return ()

    def load(self, source: SourceT, *, progress: bool = True) -> DataT:
        """Return a split, in memory or as a `Streamed` that reads examples on demand."""
        raise NotImplementedError

    def training_form(self, source: SourceT, data: SplitData) -> SourceT:
        """Return a split of which `load` gives the examples that `prepare` takes."""
        return source

    def examples(self, data: DataT) -> ExampleT | Streamed:
        """Return the training examples of a split, as `datasets.batches` takes them."""
        raise NotImplementedError

    def shapes(self, data: SplitData) -> ExampleT:
        """Return shapes and types of one example without loading the data."""
        raise NotImplementedError

    def check_settings(self, data: SplitData) -> None:
        """Raise UserError if the model cannot be trained on such data, whatever the examples are."""

    def check(self, data: SplitData, train: DataT) -> None:
        """Raise UserError if the model cannot be trained on this training split."""

    def check_evaluation(self, data: DataT, config: EvaluationConfig) -> None:
        """Raise UserError if these examples cannot be evaluated as the settings say."""

    def prepare(self, data: SplitData) -> Prepare | None:
        """Return the augmentation of training examples, None for none."""
        return None

    # -----------------------------------------------------------------------------------------------------------------
    # Numbers and pictures

    def evaluate(
        self, params: Params, data: DataT, config: EvaluationConfig, frame_groups: Sequence[str] = ()
    ) -> Evaluation:
        """Return the metrics of a model on a split; `frame_groups` names a further group for each example."""
        raise NotImplementedError

    def score_names(self, data: SplitData, config: EvaluationConfig) -> set[str]:
        """Return the names ("group/name") of the scores that evaluating on the validation split gives."""
        raise NotImplementedError

    def drawing(self, data: SplitData, config: EvaluationConfig) -> Draw:
        """Return the function that draws predictions for a few validation examples during training."""
        raise NotImplementedError

    def draw_comparison(self, models: Mapping[str, Model], source: SourceT, data: DataT, path: Path) -> Path:
        """Draw what several models predict for the same examples; return the picture's path."""
        raise NotImplementedError

    # -----------------------------------------------------------------------------------------------------------------
    # Comparing

    def interventions(self, data: DataT, config: EvaluationConfig) -> dict[str, EvaluationConfig]:
        """Return further evaluations of a trained model on a split, which a comparison shows as rows.

        Args:
            data: the split.
            config: the evaluation without intervention.

        Returns:
            By the suffix of the row's name.
        """
        del data, config
        return {}

    def remarks(self, params: Params) -> dict[str, str]:
        """Return further columns of a comparison's row."""
        del params
        return {}

    def quoted(self) -> list[dict[str, str]]:
        """Return rows that a comparison quotes from papers."""
        return []


AnyTask = Task[Any, Any, Any, Any]
"""A task of which only the common methods are used."""
