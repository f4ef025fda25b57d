"""Effects of a declared comparison: differences, intervals and findings, on results made by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.ablations.effect_cases import (
    CONTROL,
    DECLARED,
    DIFFERENCE,
    NEGATIVE,
    PRIMARY,
    SCENES,
    SEEDS,
    made_results,
    measured,
)
from tflane_jax.ablations.declaration import Claim, Declaration
from tflane_jax.ablations.effects import SAMPLES, Untested, effects, judged_claims, untested
from tflane_jax.ablations.findings import findings, sentence
from tflane_jax.ablations.recorded import Measured
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.statistics import holm, paired_difference
from tflane_jax.errors import UserError
from tflane_jax.evaluation.by_scene import scene_weights
from tflane_jax.evaluation.results import SceneRatio


@pytest.fixture(scope="module")
def results():
    return made_results()


def test_differences_and_tests_are_those_of_the_scores(results):
    found = effects(results, DECLARED, "", "last")
    names = [PRIMARY, NEGATIVE, DIFFERENCE]
    # Interventions on other models than the treatment are not compared with.
    assert [(e.measure, e.row) for e in found] == [
        (name, row) for name in names for row in ("baseline", "+TFM, none", "matched")
    ]
    table = results.rows("", "last")
    value = {
        PRIMARY: lambda row, seed: table[row][seed][PRIMARY],
        NEGATIVE: lambda row, seed: table[row][seed][CONTROL],
        DIFFERENCE: lambda row, seed: table[row][seed][PRIMARY] - table[row][seed][CONTROL],
    }
    for name in names:
        of_measure = [e for e in found if e.measure == name]
        for e in of_measure:
            treated, other = (np.array([value[name](row, seed) for seed in SEEDS]) for row in ("+TFM", e.row))
            test = paired_difference(treated, other)
            assert (e.difference, e.p, e.better) == (pytest.approx(test.mean), pytest.approx(test.p_value), test.better)
            assert e.mean == pytest.approx(other.mean())
            assert e.low < e.difference < e.high
        assert [e.p_holm for e in of_measure] == holm([e.p for e in of_measure])


def test_intervals_against_a_loop_over_drawn_scenes(results):
    effect = effects(results, DECLARED, "", "last")[6]  # primary minus control, against the baseline
    counts = results.ratios["", "last"]

    def recall(row, name, drawn):
        ratios = [counts[row][seed][name] for seed in SEEDS]
        return np.mean([np.array(r.numerator)[drawn].sum() / np.array(r.denominator)[drawn].sum() for r in ratios])

    samples = []
    for times in scene_weights(SCENES, SAMPLES)[:: SAMPLES // 200]:
        drawn = np.repeat(np.arange(SCENES), times)
        both = [recall(row, PRIMARY, drawn) - recall(row, CONTROL, drawn) for row in ("+TFM", "baseline")]
        samples.append(both[0] - both[1])
    low, high = np.quantile(samples, [0.025, 0.975])
    assert (effect.low, effect.high) == (pytest.approx(low, abs=0.01), pytest.approx(high, abs=0.01))


def test_findings(results):
    finding = {(e.measure, e.row): e.finding for e in effects(results, DECLARED, "", "last")}
    for row in ("baseline", "+TFM, none", "matched"):
        assert finding[PRIMARY, row] == finding[DIFFERENCE, row] == "shown"
        assert finding[NEGATIVE, row] == "not shown"
    worse = Declaration(PRIMARY, (Claim("matched"),))
    assert {e.row: e.finding for e in effects(results, worse, "", "last")} == {
        "baseline": "not shown",
        "+TFM": "contradicted",
        "matched, none": "contradicted",
    }
    # The same numbers, read as errors.
    as_errors = {e.row: (e.finding, e.better) for e in effects(results, worse, "", "last", ["recall"])}
    assert as_errors["+TFM"] == ("shown", 4)
    strict = Declaration(PRIMARY, (Claim("+TFM"),), alpha=1e-9)
    assert {e.finding for e in effects(results, strict, "", "last")} == {"not shown"}


def test_numbers_read_as_errors_are_the_same_but_for_what_is_better(results):
    for score, error in zip(
        *(effects(results, DECLARED, "", "last", errors) for errors in ([], ["recall"])), strict=True
    ):
        for name in ("difference", "low", "high", "seeds_low", "seeds_high", "p"):
            assert getattr(error, name) == pytest.approx(getattr(score, name), rel=1e-9), name
        assert error.seeds_low < error.difference < error.seeds_high


@pytest.mark.parametrize(("alpha", "finding"), [(0.0625, "not shown"), (0.0626, "shown")])
def test_p_must_be_below_the_level(alpha, finding):
    """Five seeds that differ by one number: the sign test gives 2^-4."""
    found = Results(("baseline", "+TFM"), tuple(range(5)), {})
    for seed in found.seeds:
        for model, hits in (("baseline", (5, 5, 5)), ("+TFM", (7, 8, 9))):
            ratio = SceneRatio(hits, (10, 10, 10))
            found.add(
                "",
                "last",
                model,
                seed,
                Measured(1, "a protocol", {"": {PRIMARY: sum(hits) / 30}}, {"": {PRIMARY: ratio}}),
            )
    (effect,) = effects(found, Declaration(PRIMARY, (Claim("+TFM"),), alpha=alpha), "", "last")
    assert effect.p_holm == 0.0625
    assert effect.finding == finding


def test_an_effect_of_few_scenes_is_not_shown():
    """All seeds agree, but one scene makes the whole difference."""
    found = Results(("baseline", "+TFM"), SEEDS, {})
    for seed in SEEDS:
        for model, hits in (("baseline", [5, 5, 0]), ("+TFM", [5, 5, 5 + seed % 2])):
            ratio = SceneRatio(tuple(hits), (10, 10, 10))
            scores = Measured(1, "a protocol", {"": {PRIMARY: sum(hits) / 30}}, {"": {PRIMARY: ratio}})
            found.add("", "last", model, seed, scores)
    (effect,) = effects(found, Declaration(PRIMARY, (Claim("+TFM"),)), "", "last")
    assert effect.p_holm < 0.01
    assert effect.low == 0.0
    assert effect.finding == "not shown"


def test_one_seed_tests_nothing():
    found = Results(("baseline", "+TFM"), range(1), {})
    for model, hits in (("baseline", (5, 5, 5)), ("+TFM", (7, 8, 9))):
        ratio = {"": {PRIMARY: SceneRatio(hits, (10, 10, 10))}}
        found.add("", "last", model, 0, Measured(1, "a protocol", {"": {PRIMARY: sum(hits) / 30}}, ratio))
    (effect,) = effects(found, Declaration(PRIMARY, (Claim("+TFM", text="it helps"),)), "", "last")
    assert effect.low > 0
    assert effect.finding == "not tested"
    text = f"**not tested** (one seed): +TFM minus *baseline* in {PRIMARY}, +30.00 points (95 % +20.00 to +40.00)."
    assert f"{sentence([effect])}." == f"{text} Claim: it helps."


def test_scores_without_parts_by_scene_have_no_interval(results):
    found = effects(results, Declaration("all/AP_l", (Claim("+TFM"),)), "", "last")
    assert all(math.isnan(e.low) and math.isnan(e.high) and not math.isnan(e.p) for e in found)
    assert "95 %" not in sentence(found[:1])
    assert "seeds, no interval over scenes: decided by seeds alone)" in sentence(found[:1])


def test_rows_of_other_scenes_are_refused():
    found = Results(("baseline", "+TFM"), (0,), {})
    for model, lanes in (("baseline", (4, 4)), ("+TFM", (4, 5))):
        ratio = SceneRatio((1, 2), lanes)
        found.add("", "last", model, 0, Measured(1, "a protocol", {"": {PRIMARY: 0.3}}, {"": {PRIMARY: ratio}}))
    with pytest.raises(UserError, match="not measured on the same lanes"):
        effects(found, Declaration(PRIMARY, (Claim("+TFM"),)), "", "last")


def test_claims_about_pairs_are_corrected_together(results):
    """Treatment and control may be interventions; a claim that lacks a row has no finding, but was declared."""
    claims = (
        Claim("+TFM", "baseline", "it helps"),
        Claim("+TFM, none", "matched"),
        Claim("baseline", "+TFM"),
        Claim("+TFM", "not measured"),
    )
    found = effects(results, Declaration(PRIMARY, claims), "", "last")
    assert [(e.claim, e.row) for e in found] == [(claim, claim.control) for claim in claims[:3]]
    assert [e.p_holm for e in found] == holm([*(e.p for e in found), 1.0])[:3]
    expected = [Untested(claims[3], "not measured", "no run of not measured was measured")]
    assert untested(results, Declaration(PRIMARY, claims), "") == expected
    assert [e.finding for e in found] == ["shown", "contradicted", "contradicted"]
    assert found[0].difference == pytest.approx(-found[2].difference)
    assert sentence(found[:1]).endswith("Claim: it helps")


def test_a_row_without_a_best_checkpoint_counts_at_that_checkpoint_too():
    found = Results(("b", "a", "c"), SEEDS, {})
    for seed in SEEDS:
        for which in ("last", "best"):
            found.add("", which, "b", seed, measured(seed, own=(0.34, 0.3)))
            found.add("", which, "a", seed, measured(seed, own=(0.3, 0.3)))
        found.add("", "last", "c", seed, measured(seed, own=(0.3, 0.3)))
    declared = Declaration(PRIMARY, (Claim("b", "a"), Claim("b", "c")))
    last, best = (effects(found, declared, "", which) for which in ("last", "best"))
    assert [(effect.row, effect.p_holm) for effect in best] == [("a", pytest.approx(2 * best[0].p))]
    assert [effect.p_holm for effect in last] == holm([effect.p for effect in last])


def test_a_claim_about_all_rows_names_those_that_failed():
    """`compare` declares one treatment: a row that failed is not passed over, and takes no other row's seeds away."""
    found = Results(("baseline", "+TFM", "matched", "gone"), SEEDS, {}, failed={"gone": "loss is not finite"})
    for seed in SEEDS:
        found.add("", "last", "+TFM", seed, measured(seed, own=(0.6, 0.3), none=(0.2, 0.3)))
        found.add("", "last", "baseline", seed, measured(seed, own=(0.3, 0.3)))
    found.add("", "last", "matched", 3, measured(3, own=(0.31, 0.3)))
    every = [e for e in effects(found, DECLARED, "", "last") if e.measure == PRIMARY]
    assert [(e.row, e.seeds) for e in every] == [("baseline", SEEDS), ("+TFM, none", SEEDS), ("matched", (3,))]
    whole = [e.p for e in every[:2]]
    assert [e.p_holm for e in every[:2]] == holm([*whole, 1.0, 1.0])[:2]  # one seed and a failed row count as well
    assert [e.finding for e in every] == ["shown", "shown", "not tested"]
    assert math.isnan(every[2].p_holm)
    *_, one, last = findings(judged_claims(found, DECLARED, ""))
    assert one.startswith("**not tested** (one seed): +TFM minus *matched*")
    reason = "no run of gone was measured (loss is not finite)"
    assert last.startswith(f"**not tested** ({reason}): +TFM is better than *gone*")


def test_a_score_that_is_no_number_is_not_tested_and_counts():
    """It says nothing about the claim: "not shown" would sound like a test."""
    found, claims = Results(("a", "b", "c"), SEEDS, {}), (Claim("a", "b"), Claim("c", "b"))
    for seed in SEEDS:
        for model, score in (("a", math.nan if seed == 2 else 0.3), ("b", 0.2 + 0.01 * seed), ("c", 0.4)):
            found.add("", "last", model, seed, Measured(1, "p", {"": {PRIMARY: score}}, {"": {}}))
    broken, other = effects(found, Declaration(PRIMARY, claims), "", "last")
    assert (broken.finding, other.finding) == ("not tested", "shown")
    assert other.p_holm == holm([other.p, 1.0])[0]
    text = f"**not tested** (a run has no number for it): a minus *b* in {PRIMARY}, no number"
    assert sentence([broken]) == text


def test_a_secondary_measure_is_corrected_apart(results):
    more = replace(DECLARED, secondary="all/AP_l")
    found, plain = effects(results, more, "", "last"), effects(results, DECLARED, "", "last")
    assert repr(found[: len(plain)]) == repr(plain)  # nan too
    extra = found[len(plain) :]
    assert [(e.measure, e.row) for e in extra] == [
        ("secondary measure all/AP_l", row) for row in ("baseline", "+TFM, none", "matched")
    ]
    assert [e.p_holm for e in extra] == holm([e.p for e in extra])
    text = sentence([e for e in found if e.row == "baseline"])
    assert text.startswith(f"**shown**: +TFM is better than *baseline* in {PRIMARY}, +")
    assert "; not shown in the secondary measure all/AP_l, " in text
    # Read as errors, its sign alone turns.
    as_errors = effects(results, more, "", "last", ["AP_l"])
    assert repr(as_errors[: len(plain)]) == repr(plain)
    assert [e.better for e in as_errors[len(plain) :]] == [len(SEEDS) - e.better for e in extra]


def test_a_score_that_a_run_lacks_is_not_tested_and_the_others_are(results):
    """Regression: a run without matched lanes, say, ended the report of all."""
    found = effects(results, Declaration(PRIMARY, (Claim("+TFM"),), secondary="all/mAP"), "", "last")
    by_measure = {e.measure: e for e in found if e.row == "baseline"}
    assert by_measure[PRIMARY].finding == "shown"
    assert by_measure["secondary measure all/mAP"].finding == "not tested"
    effect, *_ = effects(results, Declaration("all/mAP", (Claim("+TFM"),)), "", "last")
    assert "**not tested** (a run has no number for it)" in sentence([effect])


@pytest.mark.parametrize("score", ["all/loss", "all/FN", "clear/AE_dist", "segments all/AE_type"])
def test_the_row_with_the_larger_error_is_not_better(score):
    found = Results(("base", "new"), SEEDS, {})
    for seed in SEEDS:
        for row, value in (("base", 0.2 + 0.001 * seed), ("new", 0.4 + 0.002 * seed)):
            found.add("", "last", row, seed, Measured(1, "p", {"": {score: value}}, {"": {}}))
    (effect,) = effects(found, Declaration(score, (Claim("new"),)), "", "last")
    assert (effect.better, effect.finding) == (0, "contradicted")


def test_an_error_and_a_score_that_gain_alike_differ_by_nothing():
    primary, control = "all/Accuracy", "all/FP"
    rng, found = np.random.default_rng(0), Results(("base", "new"), SEEDS, {})
    for seed in SEEDS:
        noise = rng.normal(0, 1e-3, 4)
        for row, gain, (a, b) in (("base", 0.0, noise[:2]), ("new", 0.02, noise[2:])):
            scores = {primary: 0.9 + gain + a, control: 0.1 - gain + b}
            found.add("", "last", row, seed, Measured(1, "p", {"": scores}, {"": {}}))
    declared = Declaration(primary, (Claim("new"),), control)
    by_measure = {effect.measure: effect for effect in effects(found, declared, "", "last")}
    assert by_measure[primary].finding == by_measure[f"negative control {control}"].finding == "shown"
    difference = by_measure["difference of the two"]
    assert difference.finding == "not shown"
    assert abs(difference.difference) < 0.005
