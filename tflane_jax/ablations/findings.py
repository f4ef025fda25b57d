"""What a comparison found, for people: a sentence for each declared comparison, and their table."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tflane_jax.ablations.declaration import Claim, Declaration, Declared
from tflane_jax.ablations.effects import DIFFERENCE, SAMPLES, Effect, Tested, Untested, measures, std, values
from tflane_jax.ablations.report import listed
from tflane_jax.ablations.results import Results
from tflane_jax.evaluation.by_scene import SAMPLES as SHARED_SAMPLES
from tflane_jax.metrics.directions import unit_of
from tflane_jax.plots.tables import FRACTIONS, format_table, save_table


def save_effects(
    results: Results, declared: Declared, test: str, tested: Tested, stem: Path, *, no_drives: str = ""
) -> Path:
    """Print the findings and their table, save both as `<stem>.md` and `<stem>.json`, and return the first.

    `no_drives` is that of the test data, see `DataSource`.
    """
    lines = [f"{results.protocol(test)}, {results.title(test)}", "", declared.sentence()]
    seeds = min((effect.seeds for effect in tested.effects if effect.checkpoint == "last"), key=len, default=())
    if seeds and set(seeds) != set(declared.seeds):
        lines.append(f"**Interim**: {len(seeds)} of {len(declared.seeds)} declared seeds ({listed(seeds)}).")
    if mixed := results.mixed_protocols(test):
        lines.append(mixed)
    lines += ["", *(f"- {text}." for text in findings(tested))]
    if tested.effects:
        lines += [
            "",
            "Difference: the claim's model minus the row. From, to: 95 % interval over scenes (seeds averaged,",
            f"{SAMPLES:,} bootstrap samples, {SHARED_SAMPLES} of scores that rank detections); seeds from, to: 95 %",
            "t interval over seeds. Neither is corrected for several claims. p: two-sided paired t-test over seeds;",
            "Holm: corrected for all differences of one measure and checkpoint. The table has fractions,",
            "the sentences points: 0.01 is one point. Distances are in metres in both.",
        ]
        if no_drives:
            lines.append(f"Remark: {no_drives}: the intervals are too narrow.")
    rows, title = _rows(results, declared.declaration, test, tested), "\n".join(lines)
    meta = {"declaration": asdict(declared), "protocol": results.protocol(test), "seeds": list(seeds)}
    meta |= {"unit": FRACTIONS}
    path, _ = save_table(stem, rows, meta, title=title, digits=4)
    print("\n" + format_table(rows, title=title, digits=4))
    return path


def findings(tested: Tested) -> list[str]:
    """Return a sentence for each claim and row, about the last checkpoint; those without any result last."""
    return [*map(sentence, by_row(tested)), *map(_without_result, tested.untested)]


def by_row(tested: Tested) -> list[list[Effect]]:
    """Return the effects at the last checkpoint for each claim and row, in every measure, the primary one first."""
    found: dict[tuple[Claim, str], list[Effect]] = {}
    for effect in tested.effects:
        if effect.checkpoint == "last":
            found.setdefault((effect.claim, effect.row), []).append(effect)
    return list(found.values())


def _without_result(untested: Untested) -> str:
    text = f"**not tested** ({untested.reason}): {untested.claim.treatment} is better than *{untested.row}*; "
    return _with_claim(f"{text}the correction of the other tests counts it", untested.claim)


def sentence(of_row: Sequence[Effect]) -> str:
    """Return the effects against one row as a sentence: primary measure, then the others, see `measures`."""
    primary, *others = of_row
    claim = primary.claim
    if primary.finding == "not tested":
        text = f"**not tested** ({_why(primary)}): {claim.treatment} minus *{primary.row}* in {primary.measure}, "
    else:
        text = f"**{primary.finding}**: {claim.treatment} is better than *{primary.row}* in {primary.measure}, "
    # A difference of two scores has the unit of the first.
    units = [primary.measure if each.measure == DIFFERENCE else each.measure for each in others]
    more = (f"{_judged(each)}{_numbers(each, score)}" for each, score in zip(others, units, strict=True))
    text = "; ".join([text + _numbers(primary, primary.measure), *more])
    return _with_claim(text, claim)


def _judged(effect: Effect) -> str:
    finding = "" if effect.finding == "not tested" else f"{effect.finding} "
    return f"{finding}in the {effect.measure}, "


def _why(effect: Effect) -> str:
    return "one seed" if len(effect.seeds) == 1 else "a run has no number for it"


def _with_claim(text: str, claim: Claim) -> str:
    return f"{text}. Claim: {claim.text}" if claim.text else text


def _numbers(effect: Effect, score: str) -> str:
    """Return a difference in points of percent, or in metres, with its uncertainties.

    Those between seeds are there only if there are several.
    """
    if math.isnan(effect.difference):
        return "no number"
    factor, unit = points(score)
    low, high = factor * effect.low, factor * effect.high
    parts = [] if math.isnan(effect.low) else [f"95 % {low:+.2f} to {high:+.2f}"]
    if effect.finding == "not tested":
        return " ".join([f"{factor * effect.difference:+.2f} {unit}", *(f"({part})" for part in parts)])
    parts += [f"p {told_p(effect.p_holm)}", f"better in {effect.better} of {len(effect.seeds)} seeds"]
    parts += ["no interval over scenes: decided by seeds alone"] if math.isnan(effect.low) else []
    low, high = (factor * end for end in effect.bias_corrected)
    if effect.finding != "not shown" and low <= 0 <= high:
        parts.append(f"but corrected for bias the interval is {low:+.2f} to {high:+.2f}")
    return f"{factor * effect.difference:+.2f} {unit} ({', '.join(parts)})"


def points(score: str) -> tuple[float, str]:
    """Return by what a difference in a score is multiplied for people, and its unit then: points of percent, or m."""
    factor, unit = unit_of(score)
    return factor, "points" if unit == "percent" else unit


def told_p(p: float) -> str:
    """Return p as people read it: four decimals, or that it is smaller than those can tell."""
    return f"{p:.4f}" if p >= 1e-4 else "< 0.0001"


def _rows(results: Results, declaration: Declaration, test: str, tested: Tested) -> list[dict[str, Any]]:
    """Return the table: for each measure, checkpoint and claim the treatment, then what it is compared with.

    Rows that are compared over other seeds have a line of the treatment of their own.
    """
    rows: list[dict[str, Any]] = []
    by_name = {measure.name: measure for measure in measures(declaration, tested.errors)}
    for (which, name, claim, seeds), group in itertools.groupby(
        tested.effects, lambda effect: (effect.checkpoint, effect.measure, effect.claim, effect.seeds)
    ):
        treated = values(results.rows(test, which)[claim.treatment], by_name[name], seeds)
        place = {"measure": name, "checkpoint": which}
        rows.append(place | {"model": claim.treatment, "mean": float(treated.mean()), "std": std(treated)})
        rows += [
            place
            | {"model": effect.row, "mean": effect.mean, "std": effect.std}
            | {"difference": effect.difference, "from": effect.low, "to": effect.high}
            | {"seeds from": effect.seeds_low, "seeds to": effect.seeds_high}
            | {"p": effect.p, "p (Holm)": effect.p_holm}
            | {"seeds better": f"{effect.better} of {len(effect.seeds)}", "finding": effect.finding}
            for effect in group
        ]
    return rows
