"""Declared comparisons on the command line: what is tested is written down first and never changes."""

import json
from dataclasses import replace

import pytest

from tests.ablations.test_identity import QUICK
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import workers
from tflane_jax.ablations.declaration import Claim, Declaration, Declared, check, declare
from tflane_jax.ablations.jobs import plan_jobs
from tflane_jax.ablations.recorded import Measured
from tflane_jax.ablations.results import Results
from tflane_jax.cli import main
from tflane_jax.config import load_config
from tflane_jax.errors import UserError

pytestmark = pytest.mark.usefixtures("cheap")
PRIMARY = ["--primary", "all/recall"]


def compare(config, out, seeds, *arguments, rows=("base={}:baseline", "tfm={}")):
    named = [row.format(config) for row in rows]
    return main(["compare", *named, "--seeds", *seeds, "--out", str(out), *QUICK, *arguments])


def test_a_declaration_is_written_first_and_kept(tiny, tmp_path, monkeypatch, capsys):
    out, seen = tmp_path / "out", []
    train_run = workers.train_run

    def train(config, folder, **options):
        seen.append(json.loads((out / "declaration.json").read_text()))
        return train_run(config, folder, **options)

    monkeypatch.setattr(workers, "train_run", train)
    arguments = [*PRIMARY, "--negative-control", "all/DET_l", "--alpha", "0.01"]
    assert compare(tiny, out, "012", *arguments) == 0
    declared = json.loads((out / "declaration.json").read_text())
    assert seen == [declared] * 6
    assert declared["begun"] == 0
    assert (declared["primary"], declared["negative_control"]) == ("all/recall", "all/DET_l")
    assert declared["claims"] == [{"treatment": "tfm", "control": None, "text": "", "paper": []}]
    text = (out / "effects.md").read_text()
    assert "Declared before any run" in text
    assert "level 0.01, 3 seeds" in text
    assert "tfm, traffic of another scene" in text

    # Fewer seeds are an interim look, other measures or further seeds another comparison.
    assert compare(tiny, out, "01", *arguments) == 0
    assert "**Interim**: 2 of 3 declared seeds (0, 1)." in (out / "effects.md").read_text()
    capsys.readouterr()
    for changed in (
        ["0123", *arguments],
        ["012", *PRIMARY],
        ["012", "--primary", "all/DET_l", "--negative-control", "all/recall", "--alpha", "0.01"],
    ):
        assert compare(tiny, out, *changed) == 2
        assert "holds another declaration" in capsys.readouterr().err
    assert json.loads((out / "declaration.json").read_text()) == declared


@pytest.mark.slow
def test_a_late_declaration_says_so_and_holds_for_these_configurations(tiny, tmp_path, capsys):
    assert compare(tiny, tmp_path, "01") == 0
    assert not (tmp_path / "effects.md").exists()
    assert compare(tiny, tmp_path, "01", *PRIMARY) == 0
    assert "Declared when 4 runs had begun already" in (tmp_path / "effects.md").read_text()
    assert compare(tiny, tmp_path, "01", *PRIMARY, "--optim.lr", "0.1", "--retrain") == 2
    assert "holds another declaration (base: optim.lr: 0.01 there, 0.1 here)" in capsys.readouterr().err
    assert json.loads((tmp_path / "base" / "seed_0" / "config.json").read_text())["optim"]["lr"] == 0.01


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--primary", "hiden+traffic/recall"], "base is not measured by hiden+traffic/recall, only by "),
        ([*PRIMARY, "--negative-control", "all/recal"], "not measured by all/recal"),
        ([*PRIMARY, "--negative-control", "all/recall"], "cannot be primary measure and negative control"),
        ([*PRIMARY, "--treatment", "base"], "choose one of the others (tfm)"),
        ([*PRIMARY, "--secondary", "all/recall"], "all/recall cannot be the secondary measure"),
        (["--secondary", "all/recall"], "--secondary belongs to a declared comparison"),
        ([*PRIMARY, "--alpha", "1"], "--alpha 1 is no significance level"),
        (["--treatment", "tfm"], "--treatment belongs to a declared comparison: add --primary"),
        (["--negative-control", "all/recall"], "--negative-control belongs to a declared comparison"),
        (["--test", "rain='--data.test 3"], "--test rain='--data.test 3: no closing quotation"),
    ],
)
def test_mistakes_are_named_before_anything_is_trained(tiny, tmp_path, capsys, arguments, message):
    assert compare(tiny, tmp_path / "out", "0", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_no_configuration_has_the_name_of_an_intervention(tiny, tmp_path, capsys):
    """Regression: its scores took the place of the intervention's."""
    rows = ("base={}:baseline", "tfm={}", "tfm, no traffic flow at inference={}")
    assert compare(tiny, tmp_path / "out", "0", rows=rows) == 2
    assert "'tfm, no traffic flow at inference' is the name of an intervention on tfm" in capsys.readouterr().err
    found = Results(("a", "a, b"), (0,), {})
    found.add("", "last", "a", 0, Measured(1, "p", {"": {}, "b": {}}, {"": {}, "b": {}}))
    with pytest.raises(UserError, match="two rows are called 'a, b', one of a"):
        found.add("", "last", "a, b", 0, Measured(1, "p", {"": {}}, {"": {}}))


@pytest.mark.slow
def test_a_row_may_have_settings_of_its_own(tiny, tmp_path, capsys):
    matched = "matched={} --task.model.priors.traffic-flow.prior.top-instances 0"
    rows = ("base={}:baseline", "tfm={}", matched)
    assert compare(tiny, tmp_path, "0", *PRIMARY, rows=rows) == 2
    assert "--treatment NAME" in capsys.readouterr().err
    assert compare(tiny, tmp_path, "0", *PRIMARY, "--treatment", "tfm", rows=rows) == 0
    saved = {name: (tmp_path / name / "seed_0" / "config.txt").read_text() for name in ("tfm", "matched")}
    setting = "task.model.priors.traffic_flow.prior.top_instances"
    assert f"{setting} = None" in saved["tfm"]
    assert f"{setting} = 0" in saved["matched"]
    # The matched control sees no traffic: it has no interventions.
    assert list(json.loads((tmp_path / "scores.json").read_text())) == [
        "base",
        "tfm",
        "tfm, no traffic flow at inference",
        "tfm, traffic of another scene",
        "matched",
    ]


@pytest.mark.slow
def test_declarations_of_an_earlier_form_name_one_treatment(tiny, tmp_path):
    assert compare(tiny, tmp_path, "01", *PRIMARY) == 0
    path = tmp_path / "declaration.json"
    earlier = json.loads(path.read_text())
    earlier["treatment"] = earlier.pop("claims")[0]["treatment"]
    path.write_text(json.dumps(earlier))
    assert compare(tiny, tmp_path, "01", *PRIMARY) == 0
    assert json.loads(path.read_text()) == earlier


def test_a_claim_is_about_models_or_interventions_on_them(tiny):
    config = load_config(str(tiny))
    configs = {"base": config, "tfm": config}
    check(Declaration("all/recall", (Claim("tfm, no traffic flow at inference", "base"),)), configs)
    for claim in (Claim("tfm", "bse"), Claim("tmf, none", "base")):
        with pytest.raises(UserError, match=r"which is none of the models \(base, tfm\)"):
            check(Declaration("all/recall", (claim,)), configs)


CLAIMED = Declaration("all/recall", (Claim("tfm", "base", "it helps (+2 DET_l)"),), secondary="all/DET_l")


def declared(tiny, out, declaration=CLAIMED, seeds=(0, 1), logs=(), content=None, **settings):
    """Declare a comparison whose row "tfm" has other settings of the training, without training anything."""
    config = load_config(str(tiny))
    configs = {"base": config, "tfm": replace(config, training=replace(config.training, **settings))}
    plan = plan_jobs(configs, seeds, out / "runs", threads={"cores": 1}, tests={})
    return declare(declaration, plan, configs, seeds, out, logs=logs, content=content)


def test_a_treatment_with_a_comma_in_its_name_is_quoted():
    claims = (Claim("GTN"), Claim("GTN, Eq. (2)", "GTN"), Claim("GTN", "GCN"))
    text = Declared(Declaration("all/recall", claims), (0,), "2026-11-26", 0).sentence()
    assert 'treatment GTN, "GTN, Eq. (2)", level 0.05' in text
    alone = Declared(Declaration("all/recall", ()), (0,), "2026-11-26", 0).sentence()
    assert "primary measure all/recall, no claim, level 0.05, 1 seed." in alone


def test_the_configurations_of_the_rows_are_declared(tiny, tmp_path):
    declared(tiny, tmp_path)
    assert declared(tiny, tmp_path).sentence() == declared(tiny, tmp_path, seeds=(0,)).sentence()
    kept = (tmp_path / "declaration.json").read_bytes()
    for settings, difference in (
        ({"steps": 5}, r"tfm: training\.steps: 4 there, 5 here"),
        ({"init_from": "runs/other"}, r"tfm: training\.init_from: None there, runs/other here"),
    ):
        with pytest.raises(UserError, match=rf"holds another declaration \({difference}\): choose another folder"):
            declared(tiny, tmp_path, **settings)
    assert (tmp_path / "declaration.json").read_bytes() == kept


def test_a_declaration_of_an_earlier_version_is_accepted_and_says_what_it_lacks(tiny, tmp_path):
    declared(tiny, tmp_path)
    path = tmp_path / "declaration.json"
    earlier = json.loads(path.read_text())
    for name in ("configurations", "content", "logs", "secondary"):
        del earlier[name]
    path.write_text(json.dumps(earlier))
    text = declared(tiny, tmp_path, steps=5, logs=["log"]).sentence()
    assert "secondary measure all/DET_l (added later, not declared)" in text
    assert "holds no configurations" in text
    for other in (replace(CLAIMED, primary="all/DET_l", secondary=None), replace(CLAIMED, claims=(Claim("tfm"),))):
        with pytest.raises(UserError, match="holds another declaration"):
            declared(tiny, tmp_path, other)
    assert json.loads(path.read_text()) == earlier


def test_words_of_a_claim_may_be_corrected_but_no_measure(tiny, tmp_path):
    declared(tiny, tmp_path)
    declared(tiny, tmp_path, replace(CLAIMED, claims=(Claim("tfm", "base", "it helps"),)))
    with pytest.raises(UserError, match=r"secondary: all/DET_l there, all/TOP_ll here"):
        declared(tiny, tmp_path, replace(CLAIMED, secondary="all/TOP_ll"))


def test_logs_and_files_are_declared(tiny, tmp_path):
    first = declared(tiny, tmp_path, logs=["b", "a"], content={"a": "1", "b": "2"})
    assert first.logs == ("a", "b")
    assert first.interim((1, 0), ["a", "b"]) == ""
    assert first.interim((1,), ["b"]) == ("**Interim**: 1 of 2 declared seeds (1) and 1 of 2 declared logs (b).")
    declared(tiny, tmp_path, logs=["a"], content={"b": "2", "a": "1"})
    with pytest.raises(UserError, match="log c was not declared"):
        declared(tiny, tmp_path, logs=["a", "c"], content={"a": "1", "b": "2"})
    with pytest.raises(UserError, match="content of b: 2 there, 3 here"):
        declared(tiny, tmp_path, logs=["a"], content={"a": "1", "b": "3"})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("claims", "none"),
        ("claims", [{"treatment": "tfm"}]),
        ("configurations", {"tfm": 3}),
        ("seeds", [[1]]),
        ("seeds", [True]),
        ("time", "now\n# Verdict: shown"),
    ],
)
def test_a_damaged_declaration_is_named(tiny, tmp_path, name, value):
    declared(tiny, tmp_path)
    path = tmp_path / "declaration.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}))
    with pytest.raises(UserError, match=rf"declaration\.json is damaged \({name}\)"):
        declared(tiny, tmp_path)
