"""The demo: what it trains, and what it says about the result."""

from dataclasses import replace
from functools import partial

from tests.shared import ROOT
from tests.tiny_run import CONFIG, fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax import demo
from tflane_jax.ablations.recorded import Measured
from tflane_jax.ablations.results import Results
from tflane_jax.cli import main
from tflane_jax.config import load_ablations, load_config
from tflane_jax.evaluation.results import SceneRatio

LANES = {"all/recall": (30, 20, 10), "hidden+traffic/recall": (6, 6, 6), "hidden-traffic/recall": (3, 3, 3)}


def measured(**hits):
    """Return a measurement with the given hits by way: for each score, those of three scenes at three thresholds."""
    scores, ratios = {}, {}
    for way, every in hits.items():
        way = "" if way == "own" else "no traffic flow at inference"
        lanes = {name: tuple(3 * number for number in counts) for name, counts in LANES.items()}
        ratios[way] = {name: SceneRatio(tuple(every[i]), lanes[name]) for i, name in enumerate(LANES)}
        scores[way] = {name: sum(ratio.numerator) / sum(ratio.denominator) for name, ratio in ratios[way].items()}
    return Measured(1500, "a protocol", scores, ratios)


def results(baseline, own, none):
    found = Results(("baseline", "+traffic"), (0,), {})
    found.add("", "last", "baseline", 0, measured(own=baseline))
    found.add("", "last", "+traffic", 0, measured(own=own, none=none))
    return found


def hits(everywhere, hidden, control=0):
    """Return hits that are the same in every scene: of all lanes, of hidden ones with traffic, and without."""
    return [[everywhere] * 3, [hidden] * 3, [control] * 3]


def test_the_summary_gives_percent_by_group_and_the_difference():
    text = demo.summary(results(hits(6, 6), hits(12, 9, 1), hits(3, 3)))
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines() if "|" in line]
    assert rows[0] == ["true lanes", "number", "baseline", "+traffic", "+traffic, none at inference"]
    assert [row[1:] for row in rows[2:]] == [
        ["60", "10.0", "20.0", "5.0"],
        ["18", "33.3", "50.0", "16.7"],
        ["9", "0.0", "11.1", "0.0"],
    ]
    assert "on 3 unseen scenes" in text
    assert "finds 16.7 points more than the baseline\n(95 % interval over scenes: +16.7 to +16.7)" in text
    assert "33.3 points more than itself" in text
    assert "(the control), 11.1 points more than the baseline (+11.1 to +11.1)" in text


def test_the_summary_hides_no_loss():
    text = demo.summary(results(hits(6, 9), hits(6, 6), hits(6, 9)))
    assert "finds 16.7 points less than the baseline\n(95 % interval over scenes: -16.7 to -16.7)" in text
    assert "16.7 points less than itself" in text
    assert "(the control), 0.0 points more than the baseline (+0.0 to +0.0)" in text


def test_both_models_have_the_same_data_and_training():
    baseline, treatment = demo.configs().values()
    shipped = load_config("tf_lane/toponet_tfm:street_bev")
    assert treatment.task == shipped.task
    assert baseline.task == load_config("tf_lane/toponet:street").task
    assert (baseline.data, baseline.training, baseline.optim) == (treatment.data, treatment.training, treatment.optim)
    assert treatment.data.example == shipped.data.example
    assert treatment.data.world == shipped.data.world
    assert treatment.training.steps == demo.STEPS


def test_the_experiment_that_it_names_is_the_documented_one():
    assert demo.EXPERIMENT in (ROOT / "docs" / "tf_lane_results.md").read_text()


def test_the_demo_trains_compares_and_draws(tmp_path, monkeypatch, capsys):
    path, out = tmp_path / "tiny.py", tmp_path / "demo"
    path.write_text(CONFIG)
    tiny = {"baseline": quick(load_ablations(str(path))["baseline"]), "+traffic": quick(load_config(str(path)))}
    monkeypatch.setattr(demo, "configs", lambda: tiny)
    monkeypatch.setattr("tflane_jax.runs._drawing", lambda *_: None)  # curves of the trainings take seconds
    # In this process: the fake model does not travel to workers.
    monkeypatch.setattr(demo, "compare", partial(_compare_here, demo.compare))
    assert main(["demo", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("| all ") == 1
    assert "DET_l" not in printed
    assert "DET_l" in (out / "table.md").read_text()
    assert f"{out / 'comparison.png'}\n" in printed
    assert (out / "comparison.png").stat().st_size > 10_000
    assert printed.rstrip().endswith(demo.EXPERIMENT)


def quick(config):
    """Return the configuration with one evaluation and no pictures of its own."""
    training = replace(config.training, eval_every=config.training.steps)
    return replace(config, training=training, evaluation=replace(config.evaluation, pictures=0))


def _compare_here(compare, *arguments, parallel, **options):
    return compare(*arguments, **options)
