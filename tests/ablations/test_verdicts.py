"""The table of all claims, read back from the sentences of findings."""

import json
from dataclasses import replace

import pytest

from tests.shared import ROOT
from tflane_jax.ablations.declaration import Claim, Declaration
from tflane_jax.ablations.effects import Effect, judged_claims
from tflane_jax.ablations.findings import findings, sentence
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.verdicts import verdicts

EFFECT = Effect(
    claim=Claim("A, Eq. (2)", "B, C", "A helps (+7.7 DET_l)"),
    row="B, C",
    measure="all/DET_l",
    checkpoint="last",
    seeds=(0, 1, 2),
    difference=0.0767,
    low=0.05,
    high=0.09,
    bias_corrected=(0.04, 0.08),
    mean=0.3,
    std=0.01,
    seeds_low=0.04,
    seeds_high=0.1,
    p=0.001,
    p_holm=0.00312,
    better=2,
    finding="shown",
)


def only_row(text):
    (row,) = verdicts({"t": {"findings": [text]}})
    return row


def test_a_sentence_is_read_back():
    assert only_row(sentence([EFFECT])) == {
        "table": "t",
        "treatment": "A, Eq. (2)",
        "control": "B, C",
        "verdict": "shown",
        "difference": "+7.67 points",
        "over scenes": "+5.00 to +9.00",
        "in": "all/DET_l",
        "p": "0.0031",
        "better in seeds": "2 of 3",
        "the paper": "+7.7 DET_l",
    }


@pytest.mark.parametrize(
    ("finding", "corrected", "told"),
    [
        ("shown", (-0.001, 0.08), True),
        ("contradicted", (-0.08, 0.0), True),
        ("shown", (0.001, 0.08), False),
        ("not shown", (-0.001, 0.08), False),
        ("shown", (float("nan"), float("nan")), False),
    ],
)
def test_a_verdict_that_a_correction_for_bias_would_change_says_so(finding, corrected, told):
    text = sentence([replace(EFFECT, finding=finding, bias_corrected=corrected)])
    low, high = (100 * end for end in corrected)
    assert (f", but corrected for bias the interval is {low:+.2f} to {high:+.2f})" in text) == told
    assert ("bias" in text) == told
    assert only_row(text) == only_row(sentence([EFFECT])) | {"verdict": finding}


@pytest.mark.parametrize("second", ["the negative control x/recall", "the secondary measure all/mAP"])
def test_numbers_are_those_of_the_primary_measure(second):
    text = sentence([EFFECT, replace(EFFECT, measure=second, p_holm=0.5, better=1, difference=-0.5)])
    assert only_row(text) == only_row(sentence([EFFECT]))


@pytest.mark.parametrize(
    ("claim", "paper"),
    [
        ("A helps (+7.7 DET_l)", "+7.7 DET_l"),
        ("A helps (+0.19 DET_l, +1.17 OLS)", "+0.19 DET_l, +1.17 OLS"),
        ("the text: it helps; the table: -0.89 mAP with LT/LL", "-0.89 mAP"),
        ("ours: cells within 4 m help", None),
        ("", None),
    ],
)
def test_what_the_paper_reports_is_what_the_claim_quotes(claim, paper):
    assert only_row(sentence([replace(EFFECT, claim=Claim("A", "B", claim))]))["the paper"] == paper


def test_one_seed_has_no_p():
    one = replace(EFFECT, seeds=(0,), finding="not tested", p=float("nan"), p_holm=float("nan"))
    row = only_row(sentence([one]))
    assert (row["verdict"], row["difference"], row["p"], row["better in seeds"]) == (
        "not tested",
        "+7.67 points",
        None,
        None,
    )


@pytest.mark.parametrize(
    "error",
    [
        "out of memory",
        "XlaRuntimeError: INTERNAL (jit): device (0): lost",
        "ValueError: expected ')': got '(': *x*",
    ],
)
def test_the_reason_of_an_untested_claim_may_hold_brackets_and_colons(error):
    """Regression: a reason with a bracket before a colon became part of the treatment."""
    claim = Claim("A (1)", "B", "ours (by us): A is better than *B* (+7.7 DET_l)")
    failed = Results(("A (1)", "B"), (0, 1), {}, failed={"A (1)": error})
    (text,) = findings(judged_claims(failed, Declaration("all/DET_l", (claim,)), ""))
    assert f"({error})" in text
    row = only_row(text)
    assert (row["treatment"], row["control"], row["verdict"]) == ("A (1)", "B", "not tested")
    assert (row["difference"], row["p"], row["the paper"]) == (None, None, "+7.7 DET_l")


def test_every_recorded_finding_is_in_the_table():
    found = {path.stem: json.loads(path.read_text()) for path in (ROOT / "docs" / "results").glob("*.json")}
    rows = verdicts(found)
    assert len(rows) == sum(len(summary["findings"]) for summary in found.values())
    findings = [text for summary in found.values() for text in summary["findings"]]
    for row, text in zip(rows, findings, strict=True):
        assert text.startswith(f"**{row['verdict']}**")
        assert f"{row['treatment']} " in text
        assert f"*{row['control']}*" in text
        assert (row["p"] is None) == (row["verdict"] == "not tested")
    assert all(row["difference"] or row["verdict"] == "not tested" for row in rows)
