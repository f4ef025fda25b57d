"""Several variants of a system, each measured with the same seeds: tables with means, spreads and paired tests."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tflane_jax.ablations.statistics import holm, paired_difference
from tflane_jax.errors import UserError

Scores = dict[str, float]
"""Metrics by "group/name", as `tasks.Evaluation.scores` returns them."""


@dataclass(frozen=True)
class Variant:
    """A row of the table.

    Attributes:
        name: of the row.
        scores: of each seed. For paired tests, entry i of all variants comes from the same seed.
    """

    name: str
    scores: tuple[Scores, ...]


def summarise(
    variants: Sequence[Variant], metrics: Sequence[str], errors: Collection[str] = ()
) -> list[dict[str, Any]]:
    """Return one row for each variant and metric: mean, standard deviation, and the difference to the first variant.

    "p" is that of the paired t-test, "p (Holm)" the same corrected for all tests in the rows.

    Args:
        variants: the first one is the control.
        metrics: names as in `Scores`.
        errors: metrics where lower is better.

    Raises:
        UserError: variants have different numbers of seeds, so that nothing can be paired.
    """
    if len({len(variant.scores) for variant in variants}) > 1:
        counts = ", ".join(f"{v.name}: {len(v.scores)}" for v in variants)
        raise UserError(f"a paired test needs the same seeds for all variants, got {counts}")
    rows = []
    for metric in metrics:
        control = _column(variants[0], metric)
        for variant in variants:
            values = _column(variant, metric)
            row: dict[str, Any] = {"metric": metric, "model": variant.name, "mean": float(values.mean())}
            row["std"] = float(values.std(ddof=1)) if len(values) > 1 else None
            if variant is not variants[0]:
                test = paired_difference(values, control)
                row |= {"difference": test.mean, "std of difference": test.std, "p": test.p_value}
                better = paired_difference(control, values).better if metric in errors else test.better
                row["p (Holm)"], row["seeds better"] = None, f"{better} of {test.seeds}"
            rows.append(row)
    tested = [row for row in rows if "p" in row]
    for row, corrected in zip(tested, holm([row["p"] for row in tested]), strict=True):
        row["p (Holm)"] = corrected
    return rows


def compact(variants: Sequence[Variant], metrics: Sequence[str]) -> list[dict[str, str]]:
    """Return one row for each variant with "mean ± std" in percent, as papers print tables; "n/a" if one is NaN."""
    rows = []
    for variant in variants:
        row = {"model": variant.name}
        for metric in metrics:
            values = 100.0 * _column(variant, metric)
            spread = f" ± {values.std(ddof=1):.1f}" if len(values) > 1 else ""
            row[metric] = f"{values.mean():.1f}{spread}" if np.isfinite(values).all() else "n/a"
        rows.append(row)
    return rows


def _column(variant: Variant, metric: str) -> np.ndarray:
    return np.array([scores[metric] for scores in variant.scores])
