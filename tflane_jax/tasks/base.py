"""What the program around the training loop must know of a kind of task: its data, its numbers, its pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tflane_jax.training.batches import Prepare
from tflane_jax.training.loop import Draw
from tflane_jax.training.task import Params, Task


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        protocol: of the metrics, with its version.
        groups: numbers by name, for each group that was measured ("all", "occluded", ...).
        counts: names of numbers that count examples instead of rating them.
    """

    protocol: str
    groups: Mapping[str, Mapping[str, float]]
    counts: tuple[str, ...] = field(default=("frames", "lanes"))

    def scores(self) -> dict[str, float]:
        """Return the numbers as "group/name", without counts: what runs record and checkpoints are chosen by."""
        return {
            f"{group}/{name}": value
            for group, values in self.groups.items()
            for name, value in values.items()
            if name not in self.counts
        }


@dataclass(frozen=True)
class Model:
    """A trained model as comparisons and pictures take it.

    Attributes:
        task: model and losses.
        params: of one seed.
    """

    task: Any
    params: Params


class System(Protocol):
    """One kind of task. `config` is a `config.RunConfig`, `source` what its `data.source(split)` gives."""

    columns: tuple[str, ...]
    """Of the evaluation's table, as far as an evaluation has them."""
    compared: tuple[str, ...]
    """Scores ("group/name") that a comparison tests, as far as all of its models have them."""
    errors: tuple[str, ...]
    """Those of them of which less is better."""

    def load(self, source: Any, *, progress: bool = True) -> Any:
        """Return a split, as `evaluate` takes it: in memory, or a `datasets.streaming.Streamed` of it."""
        ...

    def examples(self, config: Any, data: Any) -> Any:
        """Return the examples of a split: what training looks at, as `training.batches` takes it."""
        ...

    def shapes(self, config: Any) -> Any:
        """Return shapes and types of one example of a configuration, as far as can be told without its data."""
        ...

    def check(self, config: Any, data: Any) -> None:
        """Raise UserError where the first example of a split shows that a configuration's model cannot serve it."""
        ...

    def prepare(self, config: Any) -> Prepare | None:
        """Return the augmentation of training examples, None for none."""
        ...

    def evaluate(self, task: Task, params: Params, data: Any, batch_size: int) -> Evaluation:
        """Return the metrics of a model on a split."""
        ...

    def score_names(self, config: Any) -> set[str]:
        """Return the names ("group/name") of the scores that evaluating a configuration gives."""
        ...

    def drawing(self, config: Any) -> Draw:
        """Return the function that draws predictions for a few validation examples while training."""
        ...

    def inference_variants(self, task: Any) -> dict[str, Any]:
        """Return further ways to use a trained model that a comparison lists, by what to add to its name."""
        ...

    def remarks(self, model: Model) -> dict[str, str]:
        """Return further columns of a comparison's row."""
        ...

    def quoted(self) -> list[dict[str, str]]:
        """Return rows that a comparison quotes from papers."""
        ...

    def draw_comparison(self, models: Mapping[str, Model], source: Any, data: Any, path: Path) -> Path:
        """Draw what several models say about the same examples."""
        ...


def spread(size: int, count: int) -> list[int]:
    """Return `count` indices spread evenly over `size` (all of them if there are fewer)."""
    return np.unique(np.linspace(0, size - 1, min(count, size)).round().astype(int)).tolist()
