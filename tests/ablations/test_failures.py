"""Comparisons in which a part fails, further test sets, and the contents of the tables."""

import json
import re
from dataclasses import replace

import pytest

from tests.ablations.test_identity import QUICK
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import scores, workers
from tflane_jax.ablations.jobs import Job, check_rows, plan_jobs
from tflane_jax.ablations.recorded import Measured
from tflane_jax.ablations.report import save_report
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.workers import noted
from tflane_jax.cli import main
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError

pytestmark = pytest.mark.usefixtures("cheap")


def compare(config, out, seeds, *arguments):
    named = [f"base={config}:baseline", f"tfm={config}"]
    return main(["compare", *named, "--seeds", *seeds, "--out", str(out), *QUICK, *arguments])


def failing(monkeypatch, *endings):
    """Let trainings fail whose folder has this ending."""
    train_run, trained = workers.train_run, []

    def train(config, folder, **options):
        trained.append(folder)
        if folder.as_posix().endswith(endings):
            raise (UserError("no such data") if "tfm" in str(folder) else RuntimeError("a fault in the program"))
        return train_run(config, folder, **options)

    monkeypatch.setattr(workers, "train_run", train)
    return trained


def rows(path):
    lines = [line.strip("|").split("|") for line in path.read_text().splitlines() if line.startswith("|")]
    names = [cell.strip() for cell in lines[0]]
    return [dict(zip(names, (cell.strip() for cell in line), strict=True)) for line in lines[2:]]


def test_a_failed_training_stops_no_other_and_is_listed(tiny, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        trained = failing(patch, "base/seed_0", "tfm/seed_1")
        assert compare(tiny, out, "0123", "--test", "few=--data.test 3") == 2
    assert len(trained) == 8
    told = capsys.readouterr()
    assert "2 of 8 trainings failed" in told.err
    assert re.search(r"base/seed_0 failed: its messages are in \S+base/seed_0\.log \(RuntimeError: a fault", told.err)
    assert re.search(r"tfm/seed_1 failed: its messages are in \S+tfm/seed_1\.log \(no such data\)", told.err)
    assert "Traceback" in (out / "base" / "seed_0.log").read_text()
    assert "tflane: no such data" in (out / "tfm" / "seed_1.log").read_text()

    content = json.loads((out / "comparison.json").read_text())
    assert {name: list(by_seed) for name, by_seed in content["scores"]["few"]["best"].items()} == {
        "base": ["1", "2", "3"],
        "tfm": ["0", "2", "3"],
        "tfm, no traffic flow at inference": ["0", "2", "3"],
        "tfm, traffic of another scene": ["0", "2", "3"],
    }
    assert len(content["failed"]) == 2
    last = [row for row in rows(out / "table.md") if row["checkpoint"] == "last"]
    assert [(row["model"], row["seeds"]) for row in last][:2] == [("base", "1, 2, 3"), ("tfm", "0, 2, 3")]
    assert "two-sided t-test over the seeds that both have" in (out / "paired.md").read_text()
    tested = [row for row in rows(out / "paired.md") if row["model"] == "tfm"]
    assert {(row["seeds better"][1:], row["seeds"]) for row in tested} == {(" of 2", "2, 3")}

    # The same command trains what is missing.
    assert compare(tiny, out, "0123", "--test", "few=--data.test 3") == 0
    assert "two-sided t-test over 4 seeds" in (out / "paired.md").read_text()


def test_a_failure_is_listed_where_its_log_cannot_be_written(tmp_path, capsys):
    (tmp_path / "file").touch()
    job, failures = Job(RunConfig(), tmp_path / "file" / "run"), []
    with noted(job, failures):
        raise UserError("no space left")
    assert [failure.reason for failure in failures] == ["no space left"]
    assert "tflane: no space left" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_cannot_be_evaluated_stops_no_table(tiny, tmp_path, monkeypatch, capsys):
    """Regression: the picture opened the damaged run of the first seed again, before any table was written."""
    train_run = workers.train_run

    def train_and_damage(config, folder, **options):
        result = train_run(config, folder, **options)
        if folder.as_posix().endswith("base/seed_0"):
            for manifest in folder.glob("checkpoints/*/manifest.json"):
                manifest.write_text("{")
        return result

    monkeypatch.setattr(workers, "train_run", train_and_damage)
    assert compare(tiny, tmp_path, "01") == 2
    assert "1 of 4 trainings failed" in capsys.readouterr().err
    last = [row for row in rows(tmp_path / "table.md") if row["checkpoint"] == "last"]
    assert [(row["model"], row["seeds"]) for row in last][:2] == [("base", "1"), ("tfm", "-")]  # "-": all


def test_all_rows_are_checked_before_the_first_is_trained(tiny, tmp_path, monkeypatch, capsys):
    trained, out = failing(monkeypatch), tmp_path / "out"
    rows = [
        f"base={tiny}:baseline",
        f"tfm={tiny} --training.best_metric all/NONE",
        f"none={tiny} --training.init-from nowhere",
    ]
    assert main(["compare", *rows, "--seeds", "0", "--out", str(out), *QUICK]) == 2
    said = capsys.readouterr().err
    assert "2 of 3 rows cannot be trained:" in said
    assert re.search(r"\n  tfm: .*training\.best_metric", said)
    assert re.search(r"\n  none: training\.init_from is nowhere", said)
    assert main(["compare", *rows[:2], "--seeds", "0", "--out", str(out), *QUICK]) == 2
    assert re.fullmatch(r"tflane: tfm: .*\n", capsys.readouterr().err)
    assert trained == []
    assert not out.exists()


def test_a_row_may_start_from_another_that_is_not_trained_yet(tmp_path):
    config = RunConfig()
    later = replace(config, training=replace(config.training, init_from=str(tmp_path / "base" / "seed_{seed}")))
    plan = plan_jobs({"base": config, "later": later}, (0, 1), tmp_path, threads={}, tests={})
    check_rows(plan)
    with pytest.raises(UserError, match=r"later: training\.init_from"):
        check_rows({"later": plan["later"]})


def test_without_a_control_there_is_a_table_and_no_test(tiny, tmp_path, monkeypatch, capsys):
    failing(monkeypatch, "base/seed_0", "base/seed_1")
    assert compare(tiny, tmp_path, "01") == 2
    printed = capsys.readouterr().out
    assert "no paired tests (last checkpoint, test split): no run of base" in printed
    assert "no run of base is complete" in (tmp_path / "table.md").read_text()
    interventions = ["tfm, no traffic flow at inference", "tfm, traffic of another scene"]
    assert {row["model"] for row in rows(tmp_path / "table.md")} == {"tfm", *interventions}
    assert not (tmp_path / "paired.md").exists()


def test_paired_tests_name_the_seeds_of_each_checkpoint(tmp_path, capsys):
    """A run has no best checkpoint where no evaluation gave a finite score."""
    results = Results(("base", "tfm"), (0, 1, 2), {})
    for model in results.models:
        for seed in results.seeds:
            measured = Measured(4, "a protocol", {"": {"all/recall": 0.1 * seed + len(model)}}, {"": {}})
            results.add("", "last", model, seed, measured)
            if (model, seed) != ("tfm", 1):
                results.add("", "best", model, seed, measured)
    save_report(results, RunConfig().task, {}, tmp_path)
    title = (tmp_path / "paired.md").read_text().splitlines()[0]
    assert "two-sided t-test over the seeds that both have" in title
    tested = {(row["checkpoint"], row["seeds"]) for row in rows(tmp_path / "paired.md") if row["model"] == "tfm"}
    assert tested == {("last", "-"), ("best", "0, 2")}


def test_the_scores_name_their_seeds(tmp_path, capsys):
    """Regression: scores.json had lists alone, so nobody could tell which run a number of an incomplete row is from."""
    results = Results(("base", "tfm"), (3, 1, 7), {})
    for model, seed in (("base", 7), ("base", 1), ("tfm", 3)):
        results.add("", "last", model, seed, Measured(4, "a protocol", {"": {"all/recall": seed / 10}}, {"": {}}))
    save_report(results, RunConfig().task, {}, tmp_path)
    assert json.loads((tmp_path / "scores.json").read_text()) == {
        "base": [{"seed": 1, "all/recall": 0.1}, {"seed": 7, "all/recall": 0.7}],
        "tfm": [{"seed": 3, "all/recall": 0.3}],
    }


def test_the_table_shows_scores_that_are_not_tested(tmp_path, capsys):
    """Regression: it left scores of the metrics' second version out."""
    results = Results(("base", "tfm"), (0, 1), {})
    for model in results.models:
        for seed in results.seeds:
            scores = {"all/TOP_ll": 0.1 * seed, "all/TOP_ll_v1.0": 0.2 + 0.1 * seed, "lines IoU/mAP": 0.1}
            results.add("", "last", model, seed, Measured(4, "a protocol", {"": scores}, {"": {}}))
    save_report(results, RunConfig().task, {}, tmp_path)
    shown = [name for name in rows(tmp_path / "table.md")[0] if "/" in name]
    assert shown == ["all/TOP_ll", "all/TOP_ll_v1.0", "lines IoU/mAP"]
    assert {row["metric"] for row in rows(tmp_path / "paired.md")} == {"all/TOP_ll"}


def test_a_row_that_lacks_seeds_takes_none_from_another_row(tmp_path, capsys):
    """Regression: paired tests took the seeds that all rows have, so one failed row left the others without any."""
    results = Results(("base", "tfm", "poor", "none"), (0, 1, 2), {})
    has = {"base": (0, 1, 2), "tfm": (0, 1, 2), "poor": (1,)}
    for model, seeds in has.items():
        for seed in seeds:
            scores = {"": {"all/recall": 0.1 * seed + len(model)}}
            results.add("", "last", model, seed, Measured(4, "a protocol", scores, {"": {}}))
    save_report(results, RunConfig().task, {}, tmp_path)
    found = {row["model"]: row for row in rows(tmp_path / "paired.md")}
    assert found["tfm"]["seeds better"] == "0 of 3"
    assert (found["poor"]["seeds better"], found["poor"]["seeds"], found["poor"]["p"]) == ("0 of 1", "1", "n/a")
    assert "no paired tests (best checkpoint, test split): no two seeds with base" in capsys.readouterr().out


@pytest.mark.slow
def test_an_evaluation_that_fails_is_listed_too(tiny, tmp_path, monkeypatch, capsys):
    open_run = scores.open_run

    def opened(folder, step):
        if folder.as_posix().endswith("tfm/seed_0"):
            raise UserError("damaged")
        return open_run(folder, step)

    monkeypatch.setattr(scores, "open_run", opened)
    assert compare(tiny, tmp_path, "0") == 2
    assert "1 of 2 trainings failed" in capsys.readouterr().err
    assert {row["model"] for row in rows(tmp_path / "table.md")} == {"base"}


@pytest.mark.slow
def test_test_sets_have_tables_of_their_own(tiny, tmp_path, capsys):
    tests = ["--test", "rain=--data.world.severity 1 --data.test 3", "--test", "Long Night=--data.test 4"]
    assert compare(tiny, tmp_path, "01", *tests) == 0
    assert "test set rain (--data.world.severity 1 --data.test 3)" in (tmp_path / "table-rain.md").read_text()
    assert "test set Long Night" in (tmp_path / "paired-long_night.md").read_text()
    scores = json.loads((tmp_path / "comparison.json").read_text())["scores"]
    assert {name: set(found) for name, found in scores.items()} == {
        name: {"last", "best"} for name in ("test", "rain", "Long Night")
    }
    capsys.readouterr()
    assert compare(tiny, tmp_path, "01", "--test", "rain=--optim.lr 1") == 2
    assert "--optim.lr is none" in capsys.readouterr().err
    for wrong in (["--test", "rain"], ["--test", "=--data.test 3"], [*tests, *tests]):
        assert compare(tiny, tmp_path, "01", *wrong) == 2


@pytest.mark.parametrize("best", ["2", "4"])
def test_every_table_has_the_last_and_the_best_checkpoint(tiny, tmp_path, monkeypatch, best):
    """Which one is best is decided on the validation split."""
    from tflane_jax.tasks.lane_graph import LaneGraphTask

    evaluate, counted = LaneGraphTask.evaluate, []

    def scored(task, params, data, config):
        evaluation = evaluate(task, params, data, config)
        counted.append(None)
        evaluation.groups["all"]["DET_l"] = 0.9 if str(2 * len(counted)) == best else 0.1
        return evaluation

    with monkeypatch.context() as patch:
        patch.setattr(LaneGraphTask, "evaluate", scored)
        command = ["compare", f"base={tiny}:baseline", "--seeds", "0", "--out", str(tmp_path), *QUICK]
        assert main([*command, "--training.eval-every", "2"]) == 0
    found = [(row["model"], row["checkpoint"]) for row in rows(tmp_path / "table.md")]
    assert found == [("base", "last"), ("base", "best")]
    kept = json.loads((tmp_path / "base" / "seed_0.scores.json").read_text())
    assert {entry["step"] for entry in kept.values()} == {4, int(best)}


def test_data_are_loaded_when_they_are_needed(tiny, tmp_path, monkeypatch):
    from tflane_jax.tasks.lane_graph import LaneGraphTask

    load, train_run, events = LaneGraphTask.load, workers.train_run, []
    monkeypatch.setattr(
        LaneGraphTask, "load", lambda self, source, **options: events.append(source.split) or load(self, source)
    )

    def train(config, folder, **options):
        events.append(f"train {folder.parent.name}")
        return train_run(config, folder, **options)

    monkeypatch.setattr(workers, "train_run", train)
    assert compare(tiny, tmp_path, "0", "--data.test", "5") == 0
    assert events == ["train base", "train", "val", "train tfm", "train", "val", "test"]
