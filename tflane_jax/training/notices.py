"""What a training tells its user beside its progress."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.progress import write
from tflane_jax.training.records import Record
from tflane_jax.training.restarts import RestartsConfig


def missing_scores(step: int, scores: Collection[str], best: str, restarts: RestartsConfig | None) -> list[str]:
    """Return what to say of an evaluation that lacks a score by which a training goes on.

    Args:
        step: of the evaluation.
        scores: that it gives.
        best: `training.best_metric`.
        restarts: their adaptive rule has a score, too; None for none.
    """
    reasons = [(best, "training.best_metric", "no checkpoint is the best")]
    if restarts is not None and restarts.adaptive is not None:
        reasons.append(
            (restarts.adaptive.metric, "optim.restarts.adaptive.metric", "the rule takes it for no improvement")
        )
    return [
        f"step {step}: the evaluation has no {score} ({setting}), so {result}; it stays so if the validation examples "
        "have no such lanes: then choose another score"
        for score, setting, result in reasons
        if score not in scores
    ]


def not_finite(
    values: dict[str, np.ndarray], step: int, seeds: tuple[int, ...], kept: Path, batches: Sequence[Any] = ()
) -> str:
    """Return a message with the step, the seed and everything that is not finite: loss terms, loss, gradient.

    Args:
        values: of the update.
        step: before it.
        seeds: of the run.
        kept: folder of the last good state.
        batches: examples of each seed, if this process has them all; their padding may hold such numbers too.
    """
    bad = int(np.argmin(np.atleast_1d(values["finite"])))
    numbers = {name: float(np.atleast_1d(value)[bad]) for name, value in values.items()}
    terms = [name for name, value in sorted(numbers.items(), reverse=True) if not np.isfinite(value)]
    what = ", ".join(f"{name} = {numbers[name]}" for name in terms)
    fields = _not_finite_in(batches[bad]) if batches else ""
    data = f"Numbers of its examples are not finite either: {fields}; see whether valid ones are. " if fields else ""
    if step == 0:
        advice = (
            "No update has been made, so the optimizer's settings are not the cause: look at the first examples, the "
            "parameters that the run starts from, and the settings of model and losses"
        )
    else:
        lower = "optim.lr or optim.clip_norm"
        if terms == ["grad_norm"]:
            lower = "optim.lr (the loss is finite and its gradient is not: clipping comes after it and cannot help)"
        advice = (
            f"Lower {lower} and train into another folder, from the start or from this run's averaged parameters "
            "(training.init_from)"
        )
    return (
        f"step {step + 1}, seed {seeds[bad]}: {what} is not finite. {data}The last good state (step {step}) is kept in "
        f"{kept}. {advice}"
    )


def _not_finite_in(batch: Any) -> str:
    """Return the names of the arrays of a batch that hold a number that is not finite."""
    found = [
        jax.tree_util.keystr(path, simple=True, separator=".")
        for path, leaf in jax.tree_util.tree_leaves_with_path(batch)
        if np.issubdtype(leaf.dtype, np.floating) and not np.isfinite(np.asarray(leaf)).all()
    ]
    return ", ".join(found)


def term_notices(untold: dict[str, str], record: Record) -> list[str]:
    """Return the notices whose terms are above 0 in a record, and take them from `untold`."""
    due = [name for name in untold if np.max(record.get(name, 0.0)) > 0]
    return [f"step {record['step']}: {name} is {np.max(record[name]):.3g}. {untold.pop(name)}" for name in due]


@contextlib.contextmanager
def only_told(what: str) -> Iterator[None]:
    """Write an error of the user's inside the block as a notice that begins with `what`, and go on."""
    try:
        yield
    except UserError as error:
        write(f"{what}: {error}")


def print_notices(notices: Sequence[str]) -> None:
    """Write each notice on a line of its own."""
    for notice in notices:
        write(notice)
