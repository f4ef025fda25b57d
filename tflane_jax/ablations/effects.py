"""The effects that a comparison declared: treatments against other rows, on the declared measures alone.

A claim without a control compares its treatment with the other models and the interventions on the treatment itself.
Every difference has two uncertainties: between seeds (paired t-test, corrected by Holm for all differences of one
measure and checkpoint) and between test scenes (bootstrap interval over scenes, the seeds averaged). An effect is
*shown* if the corrected p is below the declared level and the interval excludes 0, *contradicted* if the same holds in
the wrong direction, else *not shown*. With one seed, or where a score is NaN, it is *not tested*.

Ratios of sums over scenes, such as recall and TOP_ll, are resampled here. Scores that rank detections over all scenes,
such as DET_l and mAP, were measured in samples that all runs share (`evaluation.by_scene`). Scores of earlier programs
have neither: their findings stand on p alone, and say so.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.ablations.comparison import Scores
from tflane_jax.ablations.declaration import Claim, Declaration
from tflane_jax.ablations.recorded import Which
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.scores import CHECKPOINTS
from tflane_jax.ablations.statistics import (
    bias_corrected,
    holm,
    interval,
    nothing_drawn,
    paired_difference,
    resampled_ratio,
)
from tflane_jax.errors import UserError
from tflane_jax.evaluation.by_scene import scene_weights
from tflane_jax.evaluation.results import SceneRatio, SceneSamples
from tflane_jax.metrics.directions import ERRORS, lower_is_better

SAMPLES = 10_000
Finding = Literal["shown", "not shown", "contradicted", "not tested"]
DIFFERENCE = "difference of the two"
"""Name of the measure that is primary measure minus negative control."""


@dataclass(frozen=True)
class Measure:
    """A declared score, or the difference of two of them.

    Attributes:
        name: in the table.
        scores: weight of each score.
    """

    name: str
    scores: Mapping[str, float]


@dataclass(frozen=True)
class Effect:
    """The treatment minus another row, in one measure at one checkpoint.

    Attributes:
        measure, checkpoint, claim: name of the measure, checkpoint of both rows, and the claim that is tested.
        row: the other row.
        mean, std: of the other row, over seeds; the standard deviation with n - 1, NaN for one seed.
        difference: treatment minus the other row, mean over seeds.
        low, high: 95 % interval of the difference over scenes, the seeds averaged; NaN where there is none.
        bias_corrected: the same, corrected for bias, see `statistics.bias_corrected`; it decides nothing.
        seeds_low, seeds_high: 95 % t interval over seeds, on these scenes; NaN where `PairedDifference.interval` is.
        p, p_holm: of the two-sided paired t-test over seeds, and corrected for all of this measure and checkpoint.
        better: number of seeds in which the treatment is better.
        seeds: that both rows have.
        finding: about the claim that the treatment is better.
    """

    measure: str
    checkpoint: Which
    claim: Claim
    row: str
    mean: float
    std: float
    difference: float
    low: float
    high: float
    bias_corrected: tuple[float, float]
    seeds_low: float
    seeds_high: float
    p: float
    p_holm: float
    better: int
    seeds: tuple[int, ...]
    finding: Finding


@dataclass(frozen=True)
class Untested:
    """A declared comparison without any result.

    Attributes:
        claim: that is not tested.
        row: the other row.
        reason: why, in words.
    """

    claim: Claim
    row: str
    reason: str


@dataclass(frozen=True)
class Tested:
    """Effects and untested claims of a comparison.

    Attributes:
        effects: at every checkpoint, in the order of measures and claims.
        untested: comparisons without any result at the last checkpoint.
        errors: see `effects`.
    """

    effects: tuple[Effect, ...]
    untested: tuple[Untested, ...]
    errors: Collection[str] = ERRORS


def judged_claims(results: Results, declaration: Declaration, test: str, errors: Collection[str] = ERRORS) -> Tested:
    """Return the effects at both checkpoints, and what could not be tested; arguments as of `effects`."""
    every = (effect for which in CHECKPOINTS for effect in effects(results, declaration, test, which, errors))
    return Tested(tuple(every), tuple(untested(results, declaration, test)), errors)


def measures(declaration: Declaration, errors: Collection[str] = ERRORS) -> tuple[Measure, ...]:
    """Return the primary measure, the negative control, their difference, and the secondary measure.

    The difference tests that the effect differs between primary measure and negative control. Of an error and a score
    where higher is better it is the sum, in which equal effects cancel.
    """
    primary, control, secondary = declaration.primary, declaration.negative_control, declaration.secondary
    found = [Measure(primary, {primary: 1.0})]
    if control is not None:
        found.append(Measure(f"negative control {control}", {control: 1.0}))
        alike = lower_is_better(primary, errors) == lower_is_better(control, errors)
        found.append(Measure(DIFFERENCE, {primary: 1.0, control: -1.0 if alike else 1.0}))
    if secondary is not None:
        found.append(Measure(f"secondary measure {secondary}", {secondary: 1.0}))
    return tuple(found)


def effects(
    results: Results, declaration: Declaration, test: str, which: Which, errors: Collection[str] = ERRORS
) -> list[Effect]:
    """Return the effects in every measure at one checkpoint, claim by claim.

    Two rows are compared over the seeds that both have. A comparison that was declared counts in Holm's correction
    even if it cannot be tested (no seed has both rows at this checkpoint, there is one seed, or a score is NaN):
    leaving it out would make every other test easier to pass.

    Args:
        results: of the comparison.
        declaration: what is tested.
        test: test set.
        which: checkpoint.
        errors: scores where lower is better, without their group.
    """
    found = []
    compared = [(claim, _compared(results, claim, test, which)) for claim in declaration.claims]
    missing = [1.0 for _, rows in compared for seeds in rows.values() if not seeds]
    for measure in measures(declaration, errors):
        sign = -1.0 if lower_is_better(next(iter(measure.scores)), errors) else 1.0
        every = [
            _effect(results, claim, row, seeds, measure, test, which, sign)
            for claim, rows in compared
            for row, seeds in rows.items()
            if seeds
        ]
        holm_p = holm([*(1.0 if math.isnan(effect.p) else effect.p for effect in every), *missing])
        for effect, corrected in zip(every, holm_p[: len(every)], strict=True):
            corrected = math.nan if math.isnan(effect.p) else corrected
            found.append(
                replace(effect, p_holm=corrected, finding=_finding(effect, corrected, declaration.alpha, sign))
            )
    return found


def untested(results: Results, declaration: Declaration, test: str) -> list[Untested]:
    """Return the declared comparisons of which no seed has both rows, such as those with a model that failed."""
    return [
        Untested(claim, row, _why(results, test, claim.treatment, row))
        for claim in declaration.claims
        for row, seeds in _compared(results, claim, test, "last").items()
        if not seeds
    ]


def _why(results: Results, test: str, *rows: str) -> str:
    table, reasons = results.rows(test, "last"), []
    for row in rows:
        if not table.get(row):
            failed = results.failed.get(results.model_of(row))
            reasons.append(f"no run of {row} was measured" + (f" ({failed})" if failed else ""))
    return " and ".join(reasons) or "no seed has both"


def _compared(results: Results, claim: Claim, test: str, which: Which) -> dict[str, tuple[int, ...]]:
    """Return the rows that the treatment of a claim is compared with, and the seeds that both have.

    Without a control these are every other model, measured or not, and the interventions on the treatment.
    """
    table = results.rows(test, which)
    others = [claim.control] if claim.control is not None else _others(results, list(table), claim.treatment)
    treated = table.get(claim.treatment, {})
    return {row: tuple(seed for seed in treated if seed in table.get(row, {})) for row in others}


def _others(results: Results, rows: Sequence[str], treatment: str) -> list[str]:
    found: list[str] = []
    for model in results.models:
        if model != treatment:
            found.append(model)
        else:
            found += [row for row in rows if row != model and results.owners[row] == model]
    return found


def _effect(
    results: Results,
    claim: Claim,
    row: str,
    seeds: tuple[int, ...],
    measure: Measure,
    test: str,
    which: Which,
    sign: float,
) -> Effect:
    """Return the effect of a claim's treatment against a row in one measure, not yet corrected and judged."""
    table, both = results.rows(test, which), (claim.treatment, row)
    treated, other = (values(table[name], measure, seeds) for name in both)
    samples = _samples(results, test, which, measure, both, seeds)
    drawn = samples[claim.treatment] - samples[row] if samples else np.zeros(0)
    low, high = interval(drawn)
    paired = paired_difference(sign * treated, sign * other)
    seeds_low, seeds_high = sorted(sign * end for end in paired.interval())
    return Effect(
        measure=measure.name,
        checkpoint=which,
        claim=claim,
        row=row,
        mean=float(other.mean()),
        std=std(other),
        difference=sign * paired.mean,
        low=low,
        high=high,
        bias_corrected=bias_corrected(drawn, sign * paired.mean),
        seeds_low=seeds_low,
        seeds_high=seeds_high,
        p=paired.p_value,
        p_holm=math.nan,
        better=paired.better,
        seeds=seeds,
        finding="not tested",
    )


def values(by_seed: Mapping[int, Scores], measure: Measure, seeds: Sequence[int]) -> Float[np.ndarray, " s"]:
    """Return a measure of each seed of a row.

    NaN if a run lacks a score, such as an error of matched lanes where none is matched, or one that the earlier state
    of the code that measured the run did not know.
    """
    terms = measure.scores.items()
    return np.array([sum(weight * by_seed[seed].get(score, math.nan) for score, weight in terms) for seed in seeds])


def _samples(
    results: Results, test: str, which: Which, measure: Measure, rows: Sequence[str], seeds: Sequence[int]
) -> dict[str, Float[np.ndarray, " b"]]:
    """Return bootstrap samples of the measure for each row, all of the same draws; empty where a score has none.

    A single scene has none either: all samples of it are alike.

    Raises UserError if rows count different lanes, so that they were not measured on the same scenes.
    """
    parts: dict[str, dict[str, list[Any]]] = {}
    for score in measure.scores:
        for kind in (results.ratios, results.samples):
            found = {row: [kind[test, which][row][seed].get(score) for seed in seeds] for row in rows}
            if not any(part is None for each in found.values() for part in each):
                parts[score] = found
                break
        else:
            return {}
    every = [part for found in parts.values() for of_row in found.values() for part in of_row]
    if any(len(_drawn_from(part)[0]) < 2 for part in every):
        return {}
    ranked = [len(part.values) for found in parts.values() for part in found[rows[0]] if isinstance(part, SceneSamples)]
    samples = dict.fromkeys(rows, np.zeros(min(ranked, default=SAMPLES)))
    for score, weight in measure.scores.items():
        for row, drawn in _of_score(parts[score], score, len(samples[rows[0]])).items():
            samples[row] = samples[row] + weight * drawn
    return samples


def _of_score(found: Mapping[str, Sequence[Any]], score: str, count: int) -> dict[str, Float[np.ndarray, " b"]]:
    """Return as many bootstrap samples of a score for each row, the seeds averaged, from its parts for each seed.

    NaN where a sample has no lanes of the score's group, see `nothing_drawn`.
    """
    (first, (one, *_)), *_ = found.items()
    lanes = one.lanes if isinstance(one, SceneSamples) else one.denominator
    for row, each in found.items():
        if any(_drawn_from(part) != _drawn_from(one) for part in each):
            raise UserError(
                f"{row} and {first} were not measured on the same lanes ({score}): a recorded run, or one that "
                "an earlier state of the code measured, saw other test data; train and measure it again"
            )
    if isinstance(one, SceneSamples):
        empty = nothing_drawn(lanes, scene_weights(len(lanes), len(one.values)))
        means = {row: np.mean([part.values for part in each], axis=0) for row, each in found.items()}
        return {row: np.where(empty, np.nan, mean) for row, mean in means.items()}
    weights = scene_weights(len(lanes), count)
    return {
        row: resampled_ratio(np.array([part.numerator for part in each]), np.array(lanes), weights)
        for row, each in found.items()
    }


def _drawn_from(part: SceneRatio | SceneSamples) -> tuple[tuple[int, ...], int]:
    """Return what the samples of a run are drawn from, the lanes of each scene, and how many are stored."""
    return (part.lanes, len(part.values)) if isinstance(part, SceneSamples) else (part.denominator, 0)


def _finding(effect: Effect, p: float, alpha: float, sign: float) -> Finding:
    if math.isnan(p):
        return "not tested"
    if p >= alpha:
        return "not shown"
    low, high = sorted((sign * effect.low, sign * effect.high))
    if sign * effect.difference > 0:
        return "not shown" if low <= 0 else "shown"
    return "not shown" if high >= 0 else "contradicted"


def std(values: Float[np.ndarray, " s"]) -> float:
    """Return the standard deviation over seeds with n - 1; NaN for one seed."""
    return float(values.std(ddof=1)) if len(values) > 1 else math.nan
