"""The table of a declared comparison: treatments against other rows, on the declared measures alone.

A claim without a control compares its treatment with the other models and the interventions on the treatment itself.
Every difference has two uncertainties: between seeds (paired t-test, corrected by Holm for all differences of one
measure and checkpoint) and between test scenes (bootstrap interval over scenes, the seeds averaged). An effect is
*shown* if the corrected p is below the declared level and the interval excludes 0, *contradicted* if the same holds in
the wrong direction, else *not shown*; with one seed it is *not tested*.

Ratios of sums over scenes, such as recall and TOP_ll, are resampled here. Scores that rank detections over all scenes,
such as DET_l and mAP, were measured in samples that all runs share (`evaluation.by_scene`). Scores of earlier programs
have neither: their findings stand on p alone, and say so.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.ablations.declaration import Claim, Declaration, Declared
from tflane_jax.ablations.recorded import Which
from tflane_jax.ablations.report import listed
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.scores import CHECKPOINTS
from tflane_jax.ablations.statistics import holm, interval, paired_difference, resampled_ratio
from tflane_jax.errors import UserError
from tflane_jax.evaluation.by_scene import SAMPLES as SHARED_SAMPLES
from tflane_jax.evaluation.by_scene import scene_weights
from tflane_jax.evaluation.results import SceneRatio, SceneSamples
from tflane_jax.plots.tables import format_table, save_table

SAMPLES = 10_000
HAS_INTERVAL = "95 %"
NO_INTERVAL = "no interval over scenes: decided by seeds alone"
Finding = Literal["shown", "not shown", "contradicted", "not tested"]


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
        low, high: 95 % interval of the difference over scenes; NaN where there is none.
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
    p: float
    p_holm: float
    better: int
    seeds: tuple[int, ...]
    finding: Finding


def measures(declaration: Declaration) -> tuple[Measure, ...]:
    """Return the primary measure, the negative control, their difference, and the secondary measure.

    The difference tests that the effect differs between primary measure and negative control.
    """
    primary, control, secondary = declaration.primary, declaration.negative_control, declaration.secondary
    found = [Measure(primary, {primary: 1.0})]
    if control is not None:
        found.append(Measure(f"negative control {control}", {control: 1.0}))
        found.append(Measure("difference of the two", {primary: 1.0, control: -1.0}))
    if secondary is not None:
        found.append(Measure(f"secondary measure {secondary}", {secondary: 1.0}))
    return tuple(found)


def effects(
    results: Results, declaration: Declaration, test: str, which: Which, errors: Collection[str] = ()
) -> list[Effect]:
    """Return the effects in every measure at one checkpoint, claim by claim.

    Each claim is tested over the seeds that all of its rows have; one without such a seed has no effects, but counts in
    Holm's correction (see `unmeasured`).

    Args:
        results: of the comparison.
        declaration: what is tested.
        test: test set.
        which: checkpoint.
        errors: scores where lower is better.
    """
    found = []
    missing = [1.0] * len(unmeasured(results, declaration, test))
    for measure in measures(declaration):
        sign = -1.0 if next(iter(measure.scores)) in errors else 1.0
        every = [e for claim in declaration.claims for e in _of_claim(results, claim, measure, test, which, sign)]
        holm_p = holm([*(effect.p for effect in every), *missing])
        for effect, corrected in zip(every, holm_p[: len(every)], strict=True):
            judged = _finding(effect, corrected, declaration.alpha, sign)
            found.append(replace(effect, p_holm=corrected, finding=judged))
    return found


def unmeasured(results: Results, declaration: Declaration, test: str) -> list[Claim]:
    """Return the claims with a control of which no seed has both rows, such as those of a model that failed.

    They were declared: leaving them out of Holm's correction would make every other test easier to pass.
    """
    table = results.rows(test, "last")
    return [
        claim
        for claim in declaration.claims
        if claim.control is not None and not set(table.get(claim.treatment, ())) & set(table.get(claim.control, ()))
    ]


def _of_claim(results: Results, claim: Claim, measure: Measure, test: str, which: Which, sign: float) -> list[Effect]:
    """Return the effects of a claim in one measure, not yet corrected and judged."""
    table, treatment = results.rows(test, which), claim.treatment
    others = [claim.control] if claim.control is not None else _compared(results, table, treatment)
    shared = tuple(
        seed for seed in results.seeds if others and all(seed in table.get(row, {}) for row in (treatment, *others))
    )
    if not shared:
        return []
    values = {row: _values(table[row], measure, shared) for row in (treatment, *others)}
    samples = _samples(results, test, which, measure, (treatment, *others), shared)
    found = []
    for row in others:
        paired = paired_difference(sign * values[treatment], sign * values[row])
        low, high = interval(samples[treatment] - samples[row]) if samples else (math.nan, math.nan)
        found.append(
            Effect(
                measure=measure.name,
                checkpoint=which,
                claim=claim,
                row=row,
                mean=float(values[row].mean()),
                std=_std(values[row]),
                difference=sign * paired.mean,
                low=low,
                high=high,
                p=paired.p_value,
                p_holm=math.nan,
                better=paired.better,
                seeds=shared,
                finding="not tested",
            )
        )
    return found


def _compared(results: Results, table: Mapping[str, Any], treatment: str) -> list[str]:
    """Return the rows that a claim without a control compares with."""
    return [row for row in table if row != treatment and (row in results.models or results.owners[row] == treatment)]


def _values(by_seed: Mapping[int, Mapping[str, float]], measure: Measure, seeds: Sequence[int]) -> np.ndarray:
    every = [(seed, score) for seed in seeds for score in measure.scores]
    if missing := [(seed, score) for seed, score in every if score not in by_seed[seed]]:
        raise UserError(
            f"the run of seed {missing[0][0]} has no {missing[0][1]}: an earlier state of the code measured it; leave "
            "out --earlier-scores to measure it again"
        )
    return np.array([sum(weight * by_seed[seed][score] for score, weight in measure.scores.items()) for seed in seeds])


def _samples(
    results: Results, test: str, which: Which, measure: Measure, rows: Sequence[str], seeds: Sequence[int]
) -> dict[str, Float[np.ndarray, " b"]]:
    """Return bootstrap samples of the measure for each row, all of the same draws; empty where a score has none.

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
    ranked = [len(part.values) for found in parts.values() for part in found[rows[0]] if isinstance(part, SceneSamples)]
    samples = dict.fromkeys(rows, np.zeros(min(ranked, default=SAMPLES)))
    for score, weight in measure.scores.items():
        for row, drawn in _of_score(parts[score], score, len(samples[rows[0]])).items():
            samples[row] = samples[row] + weight * drawn
    return samples


def _of_score(found: Mapping[str, Sequence[Any]], score: str, count: int) -> dict[str, Float[np.ndarray, " b"]]:
    """Return as many bootstrap samples of a score for each row, the seeds averaged, from its parts for each seed."""
    (first, (one, *_)), *_ = found.items()
    lanes = one.lanes if isinstance(one, SceneSamples) else one.denominator
    for row, each in found.items():
        if any(_drawn_from(part) != _drawn_from(one) for part in each):
            raise UserError(
                f"{row} and {first} were not measured on the same lanes ({score}): a recorded run, or one that "
                "an earlier state of the code measured, saw other test data; train and measure it again"
            )
    if isinstance(one, SceneSamples):
        return {row: np.mean([part.values for part in each], axis=0) for row, each in found.items()}
    weights = scene_weights(len(lanes), count)
    return {
        row: resampled_ratio(np.array([part.numerator for part in each]), np.array(lanes), weights)
        for row, each in found.items()
    }


def _drawn_from(part: SceneRatio | SceneSamples) -> tuple[tuple[int, ...], int]:
    """Return what the samples of a run are drawn from, the lanes of each scene, and how many are stored."""
    return (part.lanes, len(part.values)) if isinstance(part, SceneSamples) else (part.denominator, 0)


def _finding(effect: Effect, p: float, alpha: float, sign: float) -> Finding:
    if len(effect.seeds) < 2:
        return "not tested"
    if not p < alpha:  # NaN too
        return "not shown"
    low, high = sorted((sign * effect.low, sign * effect.high))
    if sign * effect.difference > 0:
        return "not shown" if low <= 0 else "shown"
    return "not shown" if high >= 0 else "contradicted"


def save_effects(results: Results, declared: Declared, test: str, errors: Collection[str], stem: Path) -> list[Path]:
    """Print the findings and their table and save them, `<stem>.md` and `<stem>.json`; nothing without shared seeds."""
    declaration = declared.declaration
    every = [effect for which in CHECKPOINTS for effect in effects(results, declaration, test, which, errors)]
    if not every:
        names = ", ".join(dict.fromkeys(claim.treatment for claim in declaration.claims))
        print(f"\nno effects ({results.title(test)}): no seed that {names} and the rows compared with it have")
        return []
    lines = [f"{results.protocol}, {results.title(test)}", "", declared.sentence()]
    seeds = min((effect.seeds for effect in every), key=len)
    if set(seeds) != set(declared.seeds):
        lines.append(f"**Interim**: {len(seeds)} of {len(declared.seeds)} declared seeds ({listed(seeds)}).")
    missing = unmeasured(results, declaration, test)
    lines += ["", *(f"- {text}." for text in findings(every, missing)), ""]
    lines += [
        "Difference: the claim's model minus the row. From, to: 95 % interval over scenes (seeds averaged,",
        f"{SAMPLES:,} bootstrap samples, {SHARED_SAMPLES} of scores that rank detections). p: two-sided paired t-test",
        "over seeds; Holm: corrected for all differences of one measure and checkpoint.",
    ]
    rows, title = _rows(results, declaration, test, every), "\n".join(lines)
    print("\n" + format_table(rows, title=title, digits=4))
    meta = {"declaration": asdict(declared), "protocol": results.protocol, "seeds": list(seeds)}
    return [save_table(stem, rows, meta, title=title, digits=4)[0]]


def findings(every: Sequence[Effect], missing: Sequence[Claim] = ()) -> list[str]:
    """Return a sentence for each claim and row, about the last checkpoint; then for each claim without a result."""
    by_row: dict[tuple[Claim, str], list[Effect]] = {}
    for effect in every:
        if effect.checkpoint == "last":
            by_row.setdefault((effect.claim, effect.row), []).append(effect)
    return [*map(sentence, by_row.values()), *map(_without_result, missing)]


def _without_result(claim: Claim) -> str:
    text = f"**no result**: {claim.treatment} is better than *{claim.control}*; no seed has both, "
    text += "and the correction of the other tests counts it"
    return f"{text}. Claim: {claim.text}" if claim.text else text


def sentence(of_row: Sequence[Effect]) -> str:
    """Return the effects against one row as a sentence: primary measure, then the others, see `measures`."""
    primary, *others = of_row
    claim = primary.claim
    if primary.finding == "not tested":
        text = f"**not tested** (one seed): {claim.treatment} minus *{primary.row}* in {primary.measure}, "
        text = "; ".join([text + _numbers(primary), *(f"in the {each.measure}, {_numbers(each)}" for each in others)])
    else:
        text = f"**{primary.finding}**: {claim.treatment} is better than *{primary.row}* in {primary.measure}, "
        each = (f"{effect.finding} in the {effect.measure}, {_numbers(effect)}" for effect in others)
        text = "; ".join([text + _numbers(primary), *each])
    return f"{text}. Claim: {claim.text}" if claim.text else text


def _numbers(effect: Effect) -> str:
    """Return a difference in points of percent, with its uncertainties; those between seeds only if there are some."""
    parts = [] if math.isnan(effect.low) else [f"{HAS_INTERVAL} {100 * effect.low:+.2f} to {100 * effect.high:+.2f}"]
    if effect.finding == "not tested":
        return " ".join([f"{100 * effect.difference:+.2f} points", *(f"({part})" for part in parts)])
    parts += [] if math.isnan(effect.p) else [_p_value(effect.p_holm)]
    parts.append(f"better in {effect.better} of {len(effect.seeds)} seeds")
    parts += [NO_INTERVAL] if math.isnan(effect.low) else []
    return f"{100 * effect.difference:+.2f} points ({', '.join(parts)})"


def _p_value(p: float) -> str:
    return f"p {p:.4f}" if p >= 1e-4 else "p < 0.0001"


def _rows(results: Results, declaration: Declaration, test: str, every: Sequence[Effect]) -> list[dict[str, Any]]:
    """Return the table: for each measure, checkpoint and claim the treatment, then what it is compared with."""
    rows: list[dict[str, Any]] = []
    by_name = {measure.name: measure for measure in measures(declaration)}
    for _, group in itertools.groupby(every, lambda effect: (effect.checkpoint, effect.measure, effect.claim)):
        found = list(group)
        which, name, seeds, treatment = found[0].checkpoint, found[0].measure, found[0].seeds, found[0].claim.treatment
        values = _values(results.rows(test, which)[treatment], by_name[name], seeds)
        place = {"measure": name, "checkpoint": which}
        rows.append(place | {"model": treatment, "mean": float(values.mean()), "std": _std(values)})
        rows += [
            place
            | {"model": effect.row, "mean": effect.mean, "std": effect.std}
            | {"difference": effect.difference, "from": effect.low, "to": effect.high}
            | {"p": effect.p, "p (Holm)": effect.p_holm}
            | {"seeds better": f"{effect.better} of {len(effect.seeds)}", "finding": effect.finding}
            for effect in found
        ]
    return rows


def _std(values: np.ndarray) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else math.nan
