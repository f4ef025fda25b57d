"""The effects in a table's summary: their numbers, the row of each in the table of claims, and earlier summaries."""

import json
import math
from dataclasses import replace

import pytest

from tests.shared import ROOT
from tflane_jax.ablations.declaration import Claim, Declaration, Reported
from tflane_jax.ablations.effect_records import claim_row, effect_records, judged_together, records_of
from tflane_jax.ablations.effects import Effect, judged_claims
from tflane_jax.ablations.effects import Tested as Judged  # pytest collects what is named Test...
from tflane_jax.ablations.findings import findings, sentence
from tflane_jax.ablations.paper.table import claim
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.tables import TABLES
from tflane_jax.errors import UserError

EFFECT = Effect(
    claim=claim("A, Eq. (2)", "B, C", "A helps ({})", Reported(7.7, "DET_l")),
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
NUMBERS = {"measure": "all/DET_l", "verdict": "shown", "difference": 0.0767, "low": 0.05, "high": 0.09}
NUMBERS |= {"p": 0.00312, "p alone": 0.001, "better": 2, "seeds": 3}


def only_record(*effects):
    (record,) = effect_records(Judged(effects, ()))
    return json.loads(json.dumps(record, allow_nan=False))


def only_row(*effects):
    return claim_row("t", only_record(*effects))


def test_a_record_has_the_numbers_of_its_effect():
    assert only_record(EFFECT) == {
        "treatment": "A, Eq. (2)",
        "control": "B, C",
        "claim": "A helps (+7.7 DET_l)",
        "paper": [{"difference": 7.7, "measure": "DET_l", "decimals": 1}],
        **NUMBERS,
        "further": [],
    }


def test_the_row_of_a_record_is_what_people_read():
    assert only_row(EFFECT) == {
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
    effect = replace(EFFECT, finding=finding, bias_corrected=corrected)
    text, (low, high) = sentence([effect]), (100 * end for end in corrected)
    assert (f", but corrected for bias the interval is {low:+.2f} to {high:+.2f})" in text) == told
    assert ("bias" in text) == told
    assert only_row(effect) == only_row(EFFECT) | {"verdict": finding}


@pytest.mark.parametrize("second", ["negative control x/recall", "secondary measure all/mAP"])
def test_numbers_are_those_of_the_primary_measure(second):
    other = replace(EFFECT, measure=second, p_holm=0.5, better=1, difference=-0.5, finding="not shown")
    assert only_row(EFFECT, other) == only_row(EFFECT)
    (further,) = only_record(EFFECT, other)["further"]
    assert further == NUMBERS | {
        "measure": second,
        "verdict": "not shown",
        "difference": -0.5,
        "p": 0.5,
        "better": 1,
    }


def test_the_best_checkpoint_decides_nothing():
    assert effect_records(Judged((EFFECT, replace(EFFECT, checkpoint="best", better=0)), ())) == [only_record(EFFECT)]


@pytest.mark.parametrize(
    ("reported", "paper"),
    [
        ((Reported(7.7, "DET_l"),), "+7.7 DET_l"),
        ((Reported(0.19, "DET_l", 2), Reported(1.17, "OLS", 2)), "+0.19 DET_l, +1.17 OLS"),
        ((Reported(-0.89, "mAP", 2),), "-0.89 mAP"),
        ((Reported(0.7, "mAP", 2),), "+0.70 mAP"),
        ((), None),
    ],
)
def test_what_the_paper_reports_is_what_the_claim_quotes(reported, paper):
    made = claim("A", "B", "the table: {} with LT/LL", *reported)
    assert made.text == f"the table: {paper or ''} with LT/LL"
    assert only_row(replace(EFFECT, claim=made))["the paper"] == paper


def test_claims_of_tables_quote_all_that_their_papers_report():
    claims = [claim for table in TABLES.values() for claim in table.claims]
    assert sum(map(bool, (claim.paper for claim in claims))) >= 40
    for each in claims:
        assert all(str(reported) in each.text for reported in each.paper)
        assert bool(each.paper) == any(sign in each.text for sign in ("(+", " -")), each.text


def test_one_seed_has_no_p():
    one = replace(EFFECT, seeds=(0,), finding="not tested", p=float("nan"), p_holm=float("nan"))
    row = only_row(one)
    assert (row["verdict"], row["difference"], row["p"], row["better in seeds"]) == (
        "not tested",
        "+7.67 points",
        None,
        None,
    )


def test_what_is_no_number_is_none_in_the_record():
    nan = math.nan
    nothing = replace(EFFECT, finding="not tested", difference=nan, low=nan, high=nan, p_holm=nan)
    record = only_record(nothing)
    assert all(record[name] is None for name in ("difference", "low", "high", "p", "better"))
    row = claim_row("t", record)
    assert (row["difference"], row["over scenes"], row["in"]) == ("no number", None, "all/DET_l")
    assert only_row(replace(EFFECT, low=nan, high=nan)) == only_row(EFFECT) | {"over scenes": None}


def test_distances_are_told_in_metres():
    metres = replace(EFFECT, measure="all/AE_dist", difference=-0.12, low=-0.2, high=-0.1)
    row = only_row(metres)
    assert (row["difference"], row["over scenes"]) == ("-0.12 m", "-0.20 to -0.10")


@pytest.mark.parametrize(
    ("changes", "told"),
    [({"p": 1e-5}, "< 0.0001"), ({"p": None, "p below": 1e-4}, "< 0.0001"), ({"p": 1e-4}, "0.0001")],
)
def test_a_small_p_is_told_as_one(changes, told):
    assert claim_row("t", only_record(EFFECT) | changes)["p"] == told


def record_of(p, verdict="shown", row="B"):
    return only_record(replace(EFFECT, p=math.nan if p is None else p, finding=verdict, row=row))


def test_all_tables_are_corrected_together():
    """By hand: 0.001 x 4 = 0.004 and 0.02 x 3 = 0.06; one that could not be tested counts as the fourth."""
    found = {
        "t1": [record_of(0.02, row="far"), record_of(0.001, "contradicted")],
        "t2": [record_of(0.03, "not shown"), record_of(None, "not tested")],
    }
    assert judged_together(found) == (
        "Corrected by Holm over all 4 claims whose uncorrected p is recorded, 1 of the 2 verdicts shown or "
        "contradicted would stay at the level 0.05; these would not: A, Eq. (2) against far in t1 (shown; p 0.0600)."
    )
    found["t1"][0]["p alone"] = 0.012
    assert judged_together(found).endswith("2 of the 2 verdicts shown or contradicted would stay at the level 0.05.")


def test_claims_without_an_uncorrected_p_are_left_out_and_named():
    earlier = record_of(0.001)
    del earlier["p alone"]
    assert judged_together({"t1": [earlier]}) == judged_together({}) == ""
    text = judged_together({"t1": [earlier], "t2": [record_of(0.04), record_of(0.9, "not shown")]})
    assert "over all 2 claims whose uncorrected p is recorded (not those of t1), 0 of the 1 verdicts" in text


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
    made = claim("A (1)", "B", "ours (by us): A is better than *B* ({})", Reported(7.7, "DET_l"))
    failed = Results(("A (1)", "B"), (0, 1), {}, failed={"A (1)": error})
    tested = judged_claims(failed, Declaration("all/DET_l", (made,)), "")
    (text,), (record,) = findings(tested), effect_records(tested)
    assert f"({error})" in text
    row = claim_row("t", record)
    assert (row["treatment"], row["control"], row["verdict"]) == ("A (1)", "B", "not tested")
    assert (row["difference"], row["p"], row["the paper"]) == (None, None, "+7.7 DET_l")


def test_records_are_in_the_order_of_the_sentences():
    """Those without any result stand last in both."""
    untested = Results(("a", "b"), (0,), {}, failed={"a": "x"})
    (missing,) = judged_claims(untested, Declaration("all/DET_l", (Claim("a", "b"),)), "").untested
    tested = Judged((EFFECT, replace(EFFECT, row="D"), replace(EFFECT, measure="x/recall")), (missing,))
    records, sentences = effect_records(tested), findings(tested)
    assert [record["control"] for record in records] == ["B, C", "D", "b"]
    assert [f"*{record['control']}*" in text for record, text in zip(records, sentences, strict=True)] == [True] * 3
    assert [len(record["further"]) for record in records] == [1, 0, 0]


def recorded():
    """Return a pair of sentence and record for each claim in docs."""
    folders = (ROOT / "docs" / "results", ROOT / "docs" / "controls")
    found = [json.loads(path.read_text()) for folder in folders for path in folder.glob("*.json")]
    return [pair for each in found for pair in zip(each["findings"], each["effects"], strict=True)]


def test_every_recorded_sentence_tells_the_numbers_of_its_record():
    pairs = recorded()
    assert len(pairs) >= 100
    for text, record in pairs:
        row = claim_row("t", record)
        assert text.startswith(f"**{row['verdict']}**")
        assert f"{row['treatment']} " in text
        assert f"*{row['control']}*" in text
        assert text.endswith(f". Claim: {record['claim']}" if record["claim"] else "")
        assert all(str(Reported(**reported)) in record["claim"] for reported in record["paper"])
        assert (row["p"] is None) == (row["verdict"] == "not tested")
        assert row["difference"] or row["verdict"] == "not tested"
        told = text.partition(". Claim: ")[0].split("; ")
        of_measures = [record, *record["further"]] if record["measure"] else []
        for part, numbers in zip(told, of_measures, strict=bool(of_measures)):
            cells = claim_row("t", {name: cell for name, cell in record.items() if name != "p below"} | numbers)
            interval = f"95 % {cells['over scenes']}, " if cells["over scenes"] else ""
            assert f"{numbers['measure']}, {cells['difference']} ({interval}p {cells['p']}, " in part
            assert f"better in {cells['better in seeds']} seeds" in part
            assert numbers["verdict"] in part


def test_a_summary_of_an_earlier_version_is_named_with_the_remedy():
    summary = {"table": "markers.3", "findings": ["**shown**: ..."]}
    with pytest.raises(UserError, match=r"^x/y\.json is the summary of an earlier version, .*tflane tables markers\.3"):
        records_of(summary, "x/y.json")


@pytest.mark.parametrize("name", ["treatment", "difference", "paper", "further"])
def test_a_record_that_lacks_something_is_named(name):
    record = {key: value for key, value in only_record(EFFECT).items() if key != name}
    with pytest.raises(UserError, match=rf"y\.json: effects\[1\] lacks the entry '{name}'"):
        records_of({"table": "t", "effects": [only_record(EFFECT), record]}, "y.json")
