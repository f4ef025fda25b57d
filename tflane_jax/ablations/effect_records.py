"""The effects of a table as its summary keeps them: names and numbers, from which the page and the picture are made.

A record is about one claim and one row that it is compared with, at the last checkpoint:

treatment, control  the rows
claim, paper        its words, and what the paper reports, see `declaration.Claim`
measure, verdict, difference, low, high, p, better, seeds
                    of the primary measure, see `effects.Effect`; p is the corrected one
p alone             before the correction; earlier summaries have none
further             the same for the other measures of the declaration

Differences are fractions, or metres, as in a table's `effects.json`. None stands for what does not exist: the measure
of a claim without any result, p of one seed, an interval. Records that were made from the sentences of earlier
summaries have rounded numbers, and "p below" in place of a p that those told as "< 0.0001".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from tflane_jax.ablations.declaration import Claim, Reported
from tflane_jax.ablations.effects import Effect, Tested
from tflane_jax.ablations.findings import by_row, points, told_p
from tflane_jax.ablations.statistics import holm
from tflane_jax.errors import UserError
from tflane_jax.files.fields import items, member

Record = Mapping[str, Any]

_NAMES = ("treatment", "control", "claim", "paper", "further")
_NUMBERS = ("measure", "verdict", "difference", "low", "high", "p", "better", "seeds")
_ALONE = "p alone"
_LEVEL = 0.05


def effect_records(tested: Tested) -> list[dict[str, Any]]:
    """Return a record for each claim and row, in the order of `findings`."""
    found = [
        _named(primary.claim, primary.row) | _numbers(primary) | {"further": [_numbers(effect) for effect in others]}
        for primary, *others in by_row(tested)
    ]
    without = dict.fromkeys((*_NUMBERS, _ALONE)) | {"verdict": "not tested", "further": []}
    return found + [_named(untested.claim, untested.row) | without for untested in tested.untested]


def _named(claim: Claim, row: str) -> dict[str, Any]:
    paper = [asdict(reported) for reported in claim.paper]
    return {"treatment": claim.treatment, "control": row, "claim": claim.text, "paper": paper}


def _numbers(effect: Effect) -> dict[str, Any]:
    numbers = {"difference": effect.difference, "low": effect.low, "high": effect.high}
    numbers |= {"p": effect.p_holm, _ALONE: effect.p}
    return {
        "measure": effect.measure,
        "verdict": effect.finding,
        **{name: None if math.isnan(number) else number for name, number in numbers.items()},
        "better": None if effect.finding == "not tested" else effect.better,
        "seeds": len(effect.seeds),
    }


def records_of(summary: Mapping[str, Any], where: str) -> Sequence[Record]:
    """Return the records of a summary.

    Raises UserError that names the file: one of an earlier version has none, a damaged one not all of them.
    """
    if "effects" not in summary:
        name = member(summary, "table", where)
        raise UserError(
            f"{where} is the summary of an earlier version, which kept its effects as sentences alone: move it away, "
            f"and make the table anew from its recorded scores (tflane tables {name} --finished --from FOLDER "
            "--record FOLDER)"
        )
    found = items(summary, "effects", where)
    for i, record in enumerate(found):
        for name in (*_NAMES, *_NUMBERS):
            member(record, name, f"{where}: effects[{i}]")
    return found


def claim_row(table: str, record: Record) -> dict[str, str | None]:
    """Return the row of a record in the table of all claims, whose numbers are those of the primary measure."""
    measure, difference, interval = record["measure"], None, None
    if measure is not None:
        factor, unit = points(measure)
        number = record["difference"]
        difference = "no number" if number is None else f"{factor * number:+.2f} {unit}"
        if record["low"] is not None:
            interval = f"{factor * record['low']:+.2f} to {factor * record['high']:+.2f}"
    p = None if record["p"] is None else told_p(record["p"])
    if "p below" in record:
        p = f"< {record['p below']:.4f}"
    return {
        "table": table,
        "treatment": record["treatment"],
        "control": record["control"],
        "verdict": record["verdict"],
        "difference": difference,
        "over scenes": interval,
        "in": measure,
        "p": p,
        "better in seeds": None if record["better"] is None else f"{record['better']} of {record['seeds']}",
        "the paper": ", ".join(str(Reported(**reported)) for reported in record["paper"]) or None,
    }


def judged_together(found: Mapping[str, Sequence[Record]]) -> str:
    """Return in words which verdicts would fall if p were corrected for the claims of all tables; "" for no claim.

    Only claims whose uncorrected p is recorded count. One that could not be tested counts like p = 1, as in its table.

    Args:
        found: records by table.
    """
    claims = [(table, record) for table, records in found.items() for record in records if _ALONE in record]
    if not claims:
        return ""
    corrected = holm([1.0 if record[_ALONE] is None else record[_ALONE] for _, record in claims])
    decided = [
        (p, table, record)
        for p, (table, record) in zip(corrected, claims, strict=True)
        if record["verdict"] in ("shown", "contradicted")
    ]
    fallen = sorted((each for each in decided if each[0] >= _LEVEL), key=lambda each: each[0])
    told = [
        f"{record['treatment']} against {record['control']} in {table} ({record['verdict']}; p {told_p(p)})"
        for p, table, record in fallen
    ]
    without = [table for table, records in found.items() if any(_ALONE not in record for record in records)]
    return (
        f"Corrected by Holm over all {len(claims)} claims whose uncorrected p is recorded"
        + (f" (not those of {', '.join(without)})" if without else "")
        + f", {len(decided) - len(fallen)} of the {len(decided)} verdicts shown or contradicted would stay at the "
        f"level {_LEVEL:g}" + (f"; these would not: {'; '.join(told)}." if told else ".")
    )
