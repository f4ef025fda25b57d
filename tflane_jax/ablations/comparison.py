"""Several variants of a system, each measured with the same seeds: tables with means, spreads and paired tests."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.ablations.statistics import holm, paired_difference
from tflane_jax.metrics.directions import ERRORS, lower_is_better, unit_of

Scores = dict[str, float]
"""Metrics by "group/name", as `evaluation.results.Evaluation.scores` returns them."""


def summarise(
    rows: Mapping[str, Mapping[int, Scores]], metrics: Sequence[str], errors: Collection[str] = ERRORS
) -> list[dict[str, Any]]:
    """Return one row for each metric and variant: mean, standard deviation, and the difference to the first variant.

    The difference and its tests are over `shared_seeds`, the mean and the standard deviation over all of a variant's.
    "p" is that of the paired t-test, NaN for a single seed, and "p (Holm)" the same corrected for all tests of the
    table. A variant that shares no seed with the first one has no difference.

    Args:
        rows: scores by seed of each variant; the first one is the control.
        metrics: names as in `Scores`.
        errors: metrics where lower is better, without their group.
    """
    found, (control, *_) = [], rows
    for metric in metrics:
        for name, by_seed in rows.items():
            mean, std = _mean_and_std(_column(by_seed.values(), metric))
            row: dict[str, Any] = {"metric": metric, "model": name, "mean": mean, "std": std}
            if name != control and (seeds := shared_seeds(by_seed, rows[control])):
                treated, other = (_column([rows[one][seed] for seed in seeds], metric) for one in (name, control))
                test = paired_difference(treated, other)
                row |= {"difference": test.mean, "std of difference": test.std, "p": test.p_value}
                better = paired_difference(other, treated).better if lower_is_better(metric, errors) else test.better
                row["p (Holm)"], row["seeds better"] = None, f"{better} of {test.seeds}"
            found.append(row)
    tested = [row for row in found if "p" in row]
    for row, corrected in zip(tested, holm([row["p"] for row in tested]), strict=True):
        row["p (Holm)"] = corrected
    return found


def shared_seeds(one: Mapping[int, Scores], other: Mapping[int, Scores]) -> list[int]:
    """Return the seeds of one variant that the other has, too."""
    return [seed for seed in one if seed in other]


def compact(rows: Mapping[str, Collection[Scores]], metrics: Sequence[str]) -> list[dict[str, str]]:
    """Return one row for each variant with "mean ± std" as papers print tables; "n/a" if one is NaN.

    Numbers are in percent; those of distances have their unit beside them.

    Args:
        rows: scores of each variant, one for each seed.
        metrics: names as in `Scores`.
    """
    found = []
    for name, scores in rows.items():
        row = {"model": name}
        for metric in metrics:
            factor, unit = unit_of(metric)
            digits, mark = (1, "") if unit == "percent" else (2, f" {unit}")
            values = factor * _column(scores, metric)
            spread = f" ± {values.std(ddof=1):.{digits}f}" if len(values) > 1 else ""
            row[metric] = f"{values.mean():.{digits}f}{spread}{mark}" if np.isfinite(values).all() else "n/a"
        found.append(row)
    return found


def _column(scores: Iterable[Scores], metric: str) -> Float[np.ndarray, " s"]:
    return np.array([of_seed[metric] for of_seed in scores])


def _mean_and_std(values: Float[np.ndarray, " s"]) -> tuple[float, float | None]:
    return float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else None
