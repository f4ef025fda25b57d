"""The page of a declared comparison: what was declared, found, and not tested."""

import json
from dataclasses import replace

import pytest

from tests.ablations.effect_cases import CONTROL, DECLARED, PRIMARY, SEEDS, made_results, measured
from tflane_jax.ablations.declaration import Claim, Declaration, Declared
from tflane_jax.ablations.effects import DIFFERENCE, Effect, effects, judged_claims
from tflane_jax.ablations.findings import findings, save_effects, sentence
from tflane_jax.ablations.report import save_report
from tflane_jax.ablations.results import Results
from tflane_jax.config import RunConfig
from tflane_jax.datasets.tusimple import SOURCE as TUSIMPLE


@pytest.fixture(scope="module")
def results():
    return made_results()


def test_the_report_says_what_was_declared_and_found(results, tmp_path, capsys):
    declared = Declared(DECLARED, (0, 1, 2, 3, 4), "2026-01-01T00:00:00+00:00", 0)
    path = save_effects(results, declared, "", judged_claims(results, DECLARED, ""), tmp_path / "effects")
    text = path.read_text()
    assert text.strip() in capsys.readouterr().out
    assert f"Declared before any run (2026-01-01T00:00:00+00:00): primary measure {PRIMARY}" in text
    assert "**Interim**: 4 of 5 declared seeds (0, 1, 2, 3)." in text
    line = next(line for line in text.splitlines() if "*matched*" in line)
    assert line.startswith(f"- **shown**: +TFM is better than *matched* in {PRIMARY}, +")
    assert f"; not shown in the negative control {CONTROL}, " in line
    assert "; shown in the difference of the two, +" in line
    assert line.count("better in 4 of 4 seeds") >= 2
    assert line.count("95 % ") == line.count("p 0.") == 3
    rows = json.loads(path.with_suffix(".json").read_text())["rows"]
    assert {row["checkpoint"] for row in rows} == {"last", "best"}
    assert [row["model"] for row in rows[:4]] == ["+TFM", "baseline", "+TFM, none", "matched"]
    assert "finding" not in rows[0]
    for row in rows:
        if "difference" in row:  # its interval over seeds excludes 0 where the test does, before correction
            assert row["seeds from"] < row["difference"] < row["seeds to"]
            assert (row["seeds from"] * row["seeds to"] > 0) == (row["p"] < 0.05)
    assert "too narrow" not in text
    why = TUSIMPLE.no_drives
    path = save_effects(results, declared, "", judged_claims(results, DECLARED, ""), tmp_path / "drives", no_drives=why)
    assert "Remark: TuSimple labels one image of each clip" in path.read_text()
    assert "the intervals are too narrow." in path.read_text()
    late = Declared(DECLARED, SEEDS, "2026-01-01T00:00:00+00:00", 3)
    path = save_effects(results, late, "", judged_claims(results, DECLARED, ""), tmp_path / "late")
    assert "Declared when 3 runs had begun already" in path.read_text()
    assert "Interim" not in path.read_text()


def test_without_shared_seeds_the_report_says_so(tmp_path, capsys):
    found = Results(("baseline", "+TFM"), (0, 1), {})
    found.add("", "last", "baseline", 0, measured(0, own=(0.3, 0.3)))
    found.add("", "last", "+TFM", 1, measured(1, own=(0.3, 0.3)))
    path = save_effects(found, Declared(DECLARED, (0, 1), "now", 0), "", judged_claims(found, DECLARED, ""), tmp_path)
    line = "- **not tested** (no seed has both): +TFM is better than *baseline*; the correction"
    assert line in path.read_text()
    assert line in capsys.readouterr().out
    assert "|" not in path.read_text()


def test_the_page_names_claims_without_a_result(results, tmp_path):
    """A model that failed does not make the tests of the others easier."""
    claims = (Claim("+TFM", "baseline", "it helps"), Claim("failed, none", "baseline", "this too"))
    whole, part = (effects(results, Declaration(PRIMARY, c), "", "last")[0].p_holm for c in (claims, claims[:1]))
    assert whole == pytest.approx(2 * part)
    more = replace(results, models=(*results.models, "failed"), failed={"failed": "the disk is full"})
    declared = Declared(Declaration(PRIMARY, claims), SEEDS, "now", 0)
    tested = judged_claims(more, declared.declaration, "")
    text = save_effects(more, declared, "", tested, tmp_path / "effects").read_text().replace("\n", " ")
    assert "- **not tested** (no run of failed, none was measured (the disk is full)): failed, none is better" in text
    assert "Claim: this too" in text


def test_where_every_row_but_one_failed_all_comparisons_are_named(tmp_path):
    found = Results(("baseline", "+TFM", "matched"), SEEDS, {}, failed={"+TFM": "out of memory"})
    found.add("", "last", "baseline", 0, measured(0, own=(0.3, 0.3)))
    said = findings(judged_claims(found, DECLARED, ""))
    assert said[0].startswith("**not tested** (no run of +TFM was measured (out of memory)): +TFM is better than *bas")
    assert "(no run of +TFM was measured (out of memory) and no run of matched was measured)" in said[1]
    assert len(said) == 2


def test_models_that_are_measured_by_several_protocols_are_named(results, tmp_path):
    by_heights = [replace(measured(seed, own=(0.5, 0.3)), protocol="with heights") for seed in SEEDS]
    results = Results(("flat", "heights"), SEEDS, {})
    for seed, own in zip(SEEDS, by_heights, strict=True):
        results.add("", "last", "flat", seed, measured(seed, own=(0.3, 0.3)))
        results.add("", "last", "heights", seed, own)
    assert results.mixed_protocols("") == (
        "**Different protocols** (flat by a protocol; heights by with heights): where these differ, scores of one name "
        "are not comparable."
    )
    assert results.mixed_protocols("rain") == ""
    declared = Declaration(PRIMARY, (Claim("heights"),))
    tested = judged_claims(results, declared, "")
    path = save_effects(results, Declared(declared, SEEDS, "now", 0), "", tested, tmp_path / "effects")
    assert "**Different protocols** (flat by" in path.read_text()
    for written in save_report(results, RunConfig().task, {}, tmp_path):  # tables and paired tests, undeclared ones too
        if written.suffix == ".md":
            title, _, warning = written.read_text().splitlines()[:3]
            assert title.startswith("a protocol / with heights, test split")
            assert warning.startswith("**Different protocols** (flat by")


def test_runs_without_a_best_checkpoint_are_no_interim_look(tmp_path):
    results = Results(("baseline", "+TFM"), SEEDS, {})
    for seed in SEEDS:
        for which in ("last", "best") if seed else ("last",):
            results.add("", which, "baseline", seed, measured(seed, own=(0.3, 0.3)))
            results.add("", which, "+TFM", seed, measured(seed, own=(0.6, 0.3)))
    declared = Declaration(PRIMARY, (Claim("+TFM"),))
    path = save_effects(
        results, Declared(declared, SEEDS, "now", 0), "", judged_claims(results, declared, ""), tmp_path / "x"
    )
    assert "Interim" not in path.read_text()


def test_distances_are_metres_in_sentences():
    def effect(measure):
        claim, numbers = Claim("a", "b"), {"p": 0.01, "p_holm": 0.02, "better": 2, "seeds": (0, 1), "finding": "shown"}
        spread = {"low": -0.2, "high": -0.1, "bias_corrected": (-0.2, -0.1), "seeds_low": -0.3, "seeds_high": 0.0}
        return Effect(measure, "last", claim, "b", mean=0.8, std=0.1, difference=-0.12, **spread, **numbers)

    names = ("all/AE_dist", "negative control clear/AE_dist", DIFFERENCE, "secondary measure all/mAP")
    said = sentence([effect(name) for name in names])
    assert said.count("-0.12 m (95 % -0.20 to -0.10, ") == 3
    assert said.count("-12.00 points (95 % -20.00 to -10.00, ") == 1
