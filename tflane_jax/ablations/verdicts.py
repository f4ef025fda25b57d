"""The findings of recorded tables in one table, read back from their sentences (see `findings.sentence`)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

# "**shown**: A is better than *B* in all/recall, +0.52 points (95 % ..., p 0.0312, better in 4 of 5 seeds). Claim: ..."
_FINDING = re.compile(
    # The reason may quote an error with any brackets and colons: the last "): " before the treatment ends it.
    r"\*\*(?P<verdict>[a-z ]+)\*\*(?: \((?P<why>.*)\))?: (?P<treatment>.+?) (?:is better than|minus) "
    r"\*(?P<row>.+?)\*(?: in (?P<measure>.+?), (?P<difference>[+-][\d.]+ \w+|no number))?(?P<rest>[;. ].*)?$"
)
_INTERVAL = re.compile(r"95 % ([+-][\d.]+ to [+-][\d.]+)")
_P = re.compile(r"\bp ((?:< )?[\d.]+),")
_SEEDS = re.compile(r"better in (\d+ of \d+) seeds")
_OF_THE_PAPER = re.compile(r"[+-]\d+(?:\.\d+)? [A-Za-z]\w*")  # in a claim: "+7.7 DET_l"


def verdicts(found: Mapping[str, Mapping[str, Any]]) -> list[dict[str, str | None]]:
    """Return a row for each finding of the summaries, by the name of their table, in their order.

    A row has treatment minus control in the primary measure, its 95 % interval over scenes, p, in how many seeds the
    treatment is better, and what the paper reports where the claim quotes it. Sentences of another form are left out.
    """
    rows: list[dict[str, str | None]] = []
    for name, summary in found.items():
        for finding in summary["findings"]:
            effect, _, claim = finding.partition(". Claim: ")
            if parts := _FINDING.match(effect):
                primary = (parts["rest"] or "").split(";")[0]
                interval, p, seeds = (pattern.search(primary) for pattern in (_INTERVAL, _P, _SEEDS))
                rows.append(
                    {
                        "table": name,
                        "treatment": parts["treatment"],
                        "control": parts["row"],
                        "verdict": parts["verdict"],
                        "difference": parts["difference"],
                        "over scenes": interval and interval[1],
                        "in": parts["measure"],
                        "p": p and p[1],
                        "better in seeds": seeds and seeds[1],
                        "the paper": ", ".join(_OF_THE_PAPER.findall(claim)) or None,
                    }
                )
    return rows
