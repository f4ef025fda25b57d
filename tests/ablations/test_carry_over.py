"""Leaving each log out once: what is trained and tested, the tables, resuming, and mistakes; on fake examples."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.datasets.test_nuscenes_scenes import content
from tests.tiny_run import CONFIG as TINY
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import carry_over as subject
from tflane_jax.ablations import carry_over_plan as plans
from tflane_jax.ablations.carry_over import CLAIMS, COLUMNS, OTHER, PRIMARY, carry_over
from tflane_jax.ablations.carry_over_plan import ROWS, Settings
from tflane_jax.ablations.declaration import Claim, Declaration, Declared, check, model_of_row
from tflane_jax.ablations.jobs import Failure, Job
from tflane_jax.ablations.recorded import Measured
from tflane_jax.cli import main
from tflane_jax.config import RealMapData, RunConfig, load_config
from tflane_jax.datasets.real_maps import RealMapConfig
from tflane_jax.errors import UserError
from tflane_jax.evaluation.interventions import NO_TRAFFIC
from tflane_jax.world.presets import CITY, REAL_LIKE

pytestmark = pytest.mark.usefixtures("cheap")

ON_MAPS = """

from tflane_jax.config import RealMapData
from tflane_jax.world.presets import REAL_LIKE

_tiny, _others = get_config, ablations


def get_config():
    return replace(_tiny(), data=RealMapData())


def ablations():
    plain = replace(_others()["baseline"], data=RealMapData(generated=0.5))
    mixed = replace(_tiny(), data=RealMapData(generated=0.5))
    generated = RealMapData(generated=1.0)
    closer = replace(_tiny(), data=replace(generated, generated_world=REAL_LIKE))
    return {"generated": replace(_tiny(), data=generated), "mixed": mixed, "plain": plain, "closer": closer}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with three recorded logs, and the results of two models that left each of two out."""
    root = tmp_path_factory.mktemp("carry_over")
    (root / "maps").mkdir()
    for name in ("scene-1", "scene-2", "scene-3"):
        np.savez(root / "maps" / f"{name}.npz", **content(name))
    tiny = root / "tiny.py"
    tiny.write_text(TINY + ON_MAPS)
    rows = {"generated": f"{tiny}:generated", "mixed": f"{tiny}:mixed", "mixed without traffic": f"{tiny}:plain"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plans, "ROWS", rows)
        carry_over(settings(root), root / "out")
        yield root


def settings(root, **other):
    return Settings(root / "maps", logs=("scene-1", "scene-3"), steps=4, **other)


def test_the_models_see_every_log_but_the_one_that_they_are_tested_on(folder):
    tested = {}
    for path in sorted((folder / "out" / "runs").glob("*/config.json")):
        data = json.loads(path.read_text())["data"]
        tested.setdefault(data["generated"], []).append(tuple(data["test_logs"]))
    # Two models on maps, with and without traffic, for each log; one on generated roads for all logs.
    assert sorted(tested[0.5]) == [("scene-1",), ("scene-1",), ("scene-3",), ("scene-3",)]
    assert tested[1.0] == [()]
    train = RealMapData(folder, test_logs=("scene-1",), test_on="recordings").source("train")
    assert train.without == ("scene-1",)


def test_folds_leave_out_several_logs_at_a_time(folder):
    """Scenes 1 and 3 share a fold of two: one training for both, which is tested on each alone."""

    def planned(**other):
        wanted = settings(folder, **other)
        return plans.with_trainings(
            plans.plan_without_trainings(wanted), wanted, plans.model_configs(wanted), folder, {"cores": 1}
        )

    plan, alone = planned(folds=2), planned()
    assert [len(alone.flat()), len(plan.flat())] == [5, 3]
    assert {row: len(jobs) for row, jobs in alone.by_row().items()} == dict(zip(plans.ROWS, (1, 2, 2), strict=True))
    assert {row: len(jobs) for row, jobs in plan.by_row().items()} == dict.fromkeys(plans.ROWS, 1)
    assert {plans.map_data(job.config).test_logs for job in plan.flat()} == {(), ("scene-1", "scene-3")}
    (job,) = plan.of("mixed", "scene-1")
    assert plan.of("mixed", "scene-3") == [job]
    training = plans.map_data(job.config).source("train")
    assert isinstance(training, RealMapConfig)
    assert training.without == ("scene-1", "scene-3")
    tested = plans.map_data(plans.on_log(job.config, "scene-3"))
    assert tested.test_logs == ("scene-3",)
    assert tested.source("train") == training


def test_logs_whose_names_begin_alike_have_runs_of_their_own():
    names = ("downtown_drive_1", "downtown_drive_2", "suburb")
    settings = Settings(Path("maps"), steps=4)
    config = RunConfig(data=RealMapData(generated=0.5))
    plan = plans.with_trainings(plans.Plan(names, names, {}), settings, {"mixed": config}, Path("out"), {"cores": 1})
    assert [plans.map_data(plan.of("mixed", log)[0].config).test_logs for log in names] == [(log,) for log in names]


def test_tables_have_every_model_with_own_without_and_with_other_traffic(folder):
    written = json.loads((folder / "out" / "carry_over.json").read_text())
    assert [row["model"] for row in written["rows"]] == [
        "generated",
        f"generated, {NO_TRAFFIC}",
        f"generated, {OTHER}",
        "mixed",
        f"mixed, {NO_TRAFFIC}",
        f"mixed, {OTHER}",
        "mixed without traffic",
    ]
    assert written["meta"]["logs"] == ["scene-1", "scene-3"]
    each = json.loads((folder / "out" / "logs.json").read_text())["rows"]
    assert len(each) == 2 * 7
    percent = [row["all/recall"] for row in each if row["model"] == "mixed"]
    mean, _, spread = written["rows"][3]["all/recall"].partition(" ± ")
    assert float(mean) == pytest.approx(np.mean(percent), abs=0.06)
    assert float(spread) == pytest.approx(np.std(percent, ddof=1), abs=0.06)


def test_claims_are_tested_in_pairs_of_logs(folder):
    each = json.loads((folder / "out" / "logs.json").read_text())["rows"]
    found = {(row["model"], row["log"]): row["all/recall"] for row in each}
    tests = json.loads((folder / "out" / "effects.json").read_text())["rows"]
    assert [test["control"] for test in tests] == [
        "generated",
        "mixed without traffic",
        f"mixed, {NO_TRAFFIC}",
        f"mixed, {OTHER}",
    ]
    differences = [found["mixed", log] - found["generated", log] for log in ("scene-1", "scene-3")]
    assert tests[0]["difference"] == pytest.approx(np.mean(differences))
    assert tests[0]["logs better"] == f"{sum(d > 0 for d in differences)} of 2"
    # These models are scored by their parameters alone, so no traffic makes a difference.
    assert [test["verdict"] for test in tests[2:]] == ["not shown", "not shown"]
    declared = json.loads((folder / "out" / "declaration.json").read_text())
    assert declared["primary"] == PRIMARY
    assert declared["begun"] == 0
    assert {path.name for path in (folder / "out").glob("*.png")} == {"scene-1.png", "scene-3.png"}


def test_the_same_command_trains_nothing_again(folder, monkeypatch, capsys):
    monkeypatch.setattr("tflane_jax.ablations.workers.train_run", None)
    before = (folder / "out" / "carry_over.json").read_text()
    carry_over(settings(folder), folder / "out")
    assert "5 runs, 5 complete" in capsys.readouterr().out
    assert (folder / "out" / "carry_over.json").read_text() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"logs": ("scene-9",)}, "has no recorded log scene-9, only scene-1"),
        ({"rows": ("best",)}, "there is no model best: choose of generated, mixed"),
        ({"rows": ("mixed",), "seeds": (0, 1)}, "holds another declaration"),
        ({"logs": ("scene-1",), "steps": 8}, r"another declaration \(generated: training\.steps: 4 there, 8 here\)"),
        ({"logs": ("scene-1",), "scenes": 5}, r"another declaration \(generated: data\.train: 2000 there, 5 here\)"),
        ({"logs": ("scene-1", "scene-2")}, "log scene-2 was not declared"),
        ({"logs": ("scene-1", "scene-3"), "folds": 2}, r"another declaration \(content of folds: .* 2 here\)"),
        ({"folds": 1}, "--folds 1: .* has 3 logs, so 2 to 3 folds"),
        ({"folds": 4}, "--folds 4: .* has 3 logs, so 2 to 3 folds"),
        ({"logs": ("scene-1", "scene-3"), "seeds": (0, 1)}, "seed 1 was not declared"),
    ],
)
def test_mistakes_are_named_before_anything_is_trained(folder, change, message):
    with pytest.raises(UserError, match=message):
        carry_over(Settings(folder / "maps", **{"steps": 4, **change}), folder / "out")


def test_other_generated_roads_are_no_part_of_an_earlier_comparison(folder, monkeypatch):
    """Neither are runs of the earlier rows found again, nor does the folder take the new ones."""
    wanted, out = settings(folder), folder / "out"

    def planned():
        plan = plans.with_trainings(
            plans.plan_without_trainings(wanted), wanted, plans.model_configs(wanted), out, {"cores": 1}
        )
        return {job.folder for job in plan.flat()}

    before = planned()
    monkeypatch.setattr(plans, "ROWS", {**plans.ROWS, "generated": f"{folder / 'tiny.py'}:closer"})
    assert len(before & planned()) == len(before) - 1  # all others are the same runs
    with pytest.raises(UserError, match=r"holds another declaration \(generated: data\.generated_world\."):
        carry_over(wanted, out)


def test_every_page_tells_what_the_worlds_know_of_the_tested_logs(folder):
    for name in ("carry_over", "logs", "effects"):
        assert subject.FITTED in (folder / "out" / f"{name}.md").read_text()
        assert json.loads((folder / "out" / f"{name}.json").read_text())["meta"]["fitted"] == subject.FITTED


def test_fewer_logs_are_an_interim_look(folder, capsys):
    out = folder / "out"
    names = ("carry_over.md", "logs.md", "effects.md")
    before = [(out / name).read_bytes() for name in names]
    assert not any(b"Interim" in text for text in before)
    carry_over(Settings(folder / "maps", logs=("scene-3",), steps=4), out)
    for name in names:
        assert "**Interim**: 1 of 2 declared logs (scene-3)." in (out / name).read_text()
    assert "3 runs, 3 complete" in capsys.readouterr().out
    tests = json.loads((out / "effects.json").read_text())["rows"]
    assert {test["verdict"] for test in tests} == {"not tested (one log)"}
    carry_over(settings(folder), out)
    assert [(out / name).read_bytes() for name in names] == before


def test_other_files_of_the_maps_are_other_runs(folder):
    declared = json.loads((folder / "out" / "declaration.json").read_text())
    assert declared["logs"] == ["scene-1", "scene-3"]
    assert sorted(declared["content"]) == ["scene-1", "scene-2", "scene-3"]
    path = folder / "maps" / "scene-2.npz"
    kept = path.read_bytes()
    np.savez(path, **content("scene-2"), more=np.zeros(1))
    try:
        with pytest.raises(UserError, match=r"another declaration \(content of scene-2: \w+ there, \w+ here\)"):
            carry_over(settings(folder), folder / "out")
        configs = plans.model_configs(settings(folder))
        plan = plans.with_trainings(
            plans.plan_without_trainings(settings(folder)), settings(folder), configs, folder / "out", {"cores": 1}
        )
        assert not any(job.exists() for job in plan.flat())
    finally:
        path.write_bytes(kept)


def test_a_single_log_cannot_be_left_out(tmp_path, capsys):
    np.savez(tmp_path / "scene-1.npz", **content("scene-1"))
    assert main(["carry-over", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "there must be two or more" in capsys.readouterr().err
    assert main(["carry-over", str(tmp_path), "--seeds", "0"]) == 2
    assert "--seeds 0: at least one" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_shipped_models_are_measured_by_the_scores_of_the_tables():
    configs = {row: load_config(reference) for row, reference in ROWS.items()}
    check(Declaration(PRIMARY, CLAIMS), configs)
    for config in configs.values():
        assert isinstance(config.data, RealMapData)
        assert set(COLUMNS) <= config.task.score_names(config.data, config.evaluation)
    assert configs["generated"].data.generated == 1.0
    assert configs["maps"].data.generated == 0.0
    for row in ("generated", "mixed", "generated without traffic", "mixed without traffic"):
        assert configs[row].data.generated_world == REAL_LIKE
    # The controls differ in the preset alone, and in the side of the road.
    right_hand = replace(configs["generated"].data, generated_world=replace(REAL_LIKE, mirrored=0.0))
    assert configs["generated, right-hand traffic"] == replace(configs["generated"], data=right_hand)
    city = replace(configs["generated"].data, generated_world=CITY)
    assert configs["generated on city"] == replace(configs["generated"], data=city)


def test_models_are_compared_on_the_seeds_that_all_of_them_have(tmp_path, monkeypatch):
    config = RunConfig(data=RealMapData(generated=1.0))

    def jobs(row):
        of_seed = (replace(config, training=replace(config.training, seeds=(seed,))) for seed in range(3))
        return {"": [Job(each, tmp_path / row / str(each.training.seeds[0]), threads={}) for each in of_seed]}

    def measured(job, config, which):
        return Measured(4, "a protocol", {"": {PRIMARY: float(job.config.training.seeds[0])}}, {"": {}})

    monkeypatch.setattr(subject, "measure", measured)
    plan = plans.Plan(("a", "b"), ("a", "b"), {}, {"mixed": jobs("mixed"), "maps": jobs("maps")})
    means, seeds, _ = subject._evaluated(plan, [Failure(plan.of("maps", "a")[2], "it diverged")])
    assert seeds == {"a": {0, 1}, "b": {0, 1}}
    assert {row: [means[row][log][PRIMARY] for log in "ab"] for row in means} == {
        "mixed": [0.5, 0.5],
        "maps": [0.5, 0.5],
    }


@pytest.mark.parametrize(
    ("seeds", "interim", "over", "once"),
    [
        ({"a": {0, 1, 2}, "b": {0, 1, 2}}, "", "mean over 3 seeds", False),
        ({"a": {1}, "b": {1}}, "1 of 3 declared seeds (1)", "1 seed", True),
        (
            {"a": {0, 1}, "b": {1, 2}},
            "each log has 2 of 3 declared seeds, not all the same",
            "mean over 2 seeds",
            False,
        ),
        ({"a": {0, 1}, "b": {2}}, "each log has 1 to 2 of 3 declared seeds, not all", "mean over 1 to 2 seeds", False),
    ],
)
def test_tables_name_the_seeds_of_every_log(tmp_path, seeds, interim, over, once):
    """Regression: they named those that all logs have, "trained once" where each mean was over two trainings."""
    found = {row: {log: {PRIMARY: 0.5, "all/recall": 0.5} for log in "ab"} for row in ("base", "tfm")}
    declaration = Declaration(PRIMARY, (Claim("tfm", "base"),))
    declared = Declared(declaration, (0, 1, 2), "today", 0, ("a", "b"))
    subject._save(found, seeds, declared, "a protocol", tmp_path, quick=False)
    effects, logs = ((tmp_path / f"{name}.md").read_text() for name in ("effects", "logs"))
    assert interim in effects
    assert ("Interim" in effects) == bool(interim)
    assert ("trained once" in effects) == once
    assert f"percent ({over}" in logs


def test_claims_about_rows_without_a_result_are_listed_and_counted():
    """Two claims, one of them about a model whose trainings failed: the p of the other is doubled by Holm."""
    logs = tuple("abcdef")
    scores = {"mixed": [0.3, 0.31, 0.29, 0.35, 0.3, 0.33], "generated": [0.28, 0.3, 0.28, 0.32, 0.29, 0.3]}
    found = {row: {log: {PRIMARY: value} for log, value in zip(logs, of, strict=True)} for row, of in scores.items()}
    claims = (Claim("mixed", "generated", "maps help"), Claim("mixed", "maps", "roads help"))
    declared = Declared(Declaration(PRIMARY, claims), (0,), "", 0)
    tested, missing = subject._tests(found, logs, declared)
    assert tested["p (Holm)"] == pytest.approx(2.0 * tested["p"])
    assert tested["verdict"] == "shown"
    assert missing["verdict"] == "not tested (no result of maps)"
    assert np.isnan(missing["difference"])


@pytest.mark.parametrize(
    ("row", "model"),
    [
        ("generated", "generated"),
        (f"generated, {NO_TRAFFIC}", "generated"),
        ("generated, right-hand traffic", "generated, right-hand traffic"),
        (f"generated, right-hand traffic, {OTHER}", "generated, right-hand traffic"),
        (f"mixed + BEV, {OTHER}", "mixed + BEV"),
    ],
)
def test_the_model_of_a_row_is_told_from_its_intervention(row, model):
    assert model_of_row(row, ROWS) == model
