"""Tables of the papers: their data, and a small one from training to summary."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import workers
from tflane_jax.ablations.declaration import Claim, check
from tflane_jax.ablations.paper.table import PaperTable, Quoted, TableRow, longer, shortened
from tflane_jax.ablations.published import page, record
from tflane_jax.ablations.scores import is_measured
from tflane_jax.ablations.store import stored_jobs
from tflane_jax.ablations.table_run import run_table
from tflane_jax.ablations.tables import TABLES
from tflane_jax.cli import main
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.models.marker_fusion import as_written
from tflane_jax.training.restarts import RestartsConfig
from tflane_jax.training.schedule import DropsConfig, OptimConfig, make_optimizer

pytestmark = pytest.mark.usefixtures("cheap")
TABLE_FILES = {"table.md", "table.json", "table.tex", "effects.md", "effects.json", "summary.json"}


@pytest.mark.parametrize("name", TABLES)
def test_every_table_is_about_its_rows_and_measured_by_its_scores(name):
    table = TABLES[name]
    configs, hosts = table.configs(table.rows), table.configs(table.hosts)
    check(table.declaration, configs)
    for row in (row for row in table.rows if row.start):
        # So that all parameters of the host are found again.
        model, host = configs[row.name].task.model, hosts[row.start].task.model
        assert replace(model, denoising=host.denoising, priors=host.priors) == host, row.name
    for config in configs.values():
        known = config.task.score_names(config.data, config.evaluation)
        assert set(table.columns) <= known
    quick = {name: shortened(config) for name, config in (configs | hosts).items()}
    for config in quick.values():
        assert (config.training.steps, config.data.train) == (8, 24)
        make_optimizer(config.optim, config.training.steps)  # raises where the schedule does not fit
    rows = {repr(quick[name]) for name in configs}
    assert len(rows) == len(configs)  # a smoke test tests every row
    assert len({tuple(row) for row in table.quoted.rows}) <= 1  # the same columns


def small(tiny, **changes):
    settings = {
        "name": "paper.9",
        "title": "a small table",
        "rows": (
            TableRow("base", f"{tiny}:baseline"),
            TableRow("tfm", str(tiny)),
            TableRow("again", str(tiny), ("--optim.lr", "0.02")),
        ),
        "claims": (Claim("tfm", "base", "it helps"), Claim("tfm, no traffic flow at inference", "base")),
        "primary": "all/recall",
        "columns": ("all/DET_l", "all/recall"),
        "quoted": Quoted("a dataset", ({"model": "base", "DET_l": 1.5},)),
        "steps": 4,
        "note": "This data set has no TOP_lt.",
    }
    return PaperTable(**{**settings, **changes})


def stopped_at_the_third(table, out, monkeypatch):
    """Begin a table of two seeds, whose third training never returns; return the folders of all three."""
    train_run, begun = workers.train_run, []

    def stopped(config, folder, **options):
        begun.append(folder)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return train_run(config, folder, **options)

    with monkeypatch.context() as patch:
        patch.setattr(workers, "train_run", stopped)
        with pytest.raises(KeyboardInterrupt):
            run_table(table, range(2), out)
    return begun


def test_a_table_from_training_to_page(tiny, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    path = run_table(small(tiny), range(2), out)
    folder = out / "paper.9"
    assert path == folder / "table.md"
    assert {file.name for file in folder.iterdir()} >= TABLE_FILES | {"declaration.json", "curves.png"}
    told = capsys.readouterr().out
    assert "paper.9, a small table: 6 runs, 0 complete; the updates of the others take about" in told
    assert "), evaluation and compiling come on top\n" in told
    text = path.read_text()
    assert "tfm, traffic of another scene" in text
    assert "The paper's own numbers, not comparable with these: a dataset" in text
    assert "\nThis data set has no TOP_lt.\n" in text
    tex = (folder / "table.tex").read_text()
    assert tex.count(r"\begin{tabular}") == 2
    assert re.search(r"(?<!\\)[_%&#]", tex.replace(" & ", "")) is None
    assert "\nThis data set has no TOP\\_lt.\n" in tex
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["seeds"] == [0, 1]
    assert summary["cores of a run"]
    assert len(summary["findings"]) == 2
    assert "Claim: it helps" in summary["findings"][0]
    rows = [(effect["treatment"], effect["control"], effect["claim"]) for effect in summary["effects"]]
    assert rows == [("tfm", "base", "it helps"), ("tfm, no traffic flow at inference", "base", "")]
    assert summary["runs begun"] == 0

    rows = small(tiny).configs(small(tiny).rows)
    (job, *_), *_ = stored_jobs(rows, range(2), out / "runs", threads=workers.worker_threads(1)).values()
    assert job.is_complete()
    assert is_measured(job)
    job.folder.with_name(f"{job.folder.name}.scores.json").unlink()
    assert not is_measured(job)

    # Another table with one of its rows trains only what is new, and the same table nothing.
    before = {name: (folder / name).read_bytes() for name in TABLE_FILES}
    assert len(list((out / "runs").glob("*/config.json"))) == 6
    run_table(small(tiny, name="paper.10"), range(2), out)
    assert len(list((out / "runs").glob("*/config.json"))) == 6
    for name in ("table.md", "summary.json", "comparison.png", "curves.png"):
        (folder / name).unlink()
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        run_table(small(tiny), range(2), out)
    assert {name: (folder / name).read_bytes() for name in TABLE_FILES} == before
    assert list(folder.glob("*.png")) == []
    assert capsys.readouterr().err.count("no pictures, which need matplotlib: ") == 1

    record([folder / "summary.json"], tmp_path / "results")
    written = (tmp_path / "results.md").read_text()
    assert "## paper.9: a small table" in written
    assert "\nThis data set has no TOP_lt.\n" in written
    assert "tflane tables paper.9 --seeds 2 --jobs 2" in written
    assert "2 seeds, 4 updates a run, each on" in written
    assert max(map(len, (line for line in written.splitlines() if not line.startswith("|")))) <= 120
    assert written == page(tmp_path / "results")


@pytest.mark.slow
def test_a_table_that_was_stopped_ends_with_the_same_bytes(tiny, tmp_path, monkeypatch):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run_table(small(tiny), range(2), whole)
    stopped_at_the_third(small(tiny), parts, monkeypatch)
    assert not list(parts.rglob("*.reserved"))
    run_table(small(tiny), range(2), parts)
    for name in ("table.md", "table.json", "table.tex"):
        assert (parts / "paper.9" / name).read_bytes() == (whole / "paper.9" / name).read_bytes()


@pytest.mark.slow
def test_fewer_seeds_are_an_interim_look_and_equal_rows_are_trained_once(tiny, tmp_path):
    rows = (TableRow("base", f"{tiny}:baseline"), TableRow("tfm", str(tiny)), TableRow("same", str(tiny)))
    table = small(tiny, rows=rows, seeds=3)
    run_table(table, range(2), tmp_path, parallel=1)
    assert len(list((tmp_path / "runs").glob("*/config.json"))) == 4
    assert "**Interim**: 2 of 3 declared seeds (0, 1)." in (tmp_path / "paper.9" / "effects.md").read_text()
    run_table(table, range(3), tmp_path)
    text = (tmp_path / "paper.9" / "effects.md").read_text()
    assert "Interim" not in text
    assert "Declared before any run" in text
    with pytest.raises(UserError, match="seed 3 was not declared"):
        run_table(table, range(4), tmp_path)
    # After the results were seen, no row may become another one.
    with pytest.raises(UserError, match=r"another declaration \(base: training\.steps: 4 there, 6 here\)"):
        run_table(replace(table, steps=6), range(3), tmp_path)


def test_rows_start_from_hosts_of_their_seed(tiny, tmp_path):
    rows = (TableRow("base", f"{tiny}:baseline", start="host"),)
    claims = (Claim("base", "base"),)
    table = small(tiny, rows=rows, claims=claims, hosts=(TableRow("host", f"{tiny}:baseline", ("--optim.lr", "0.1")),))
    run_table(table, range(2), tmp_path)
    configs = [json.loads(path.read_text()) for path in (tmp_path / "runs").glob("*/config.json")]
    starts = {c["training"]["init_from"]: c["training"]["seeds"] for c in configs if c["training"]["init_from"]}
    hosts = {path.parent for path in (tmp_path / "runs").glob("*/config.json")}
    assert len(starts) == 2
    declared = json.loads((tmp_path / "paper.9" / "declaration.json").read_text())["configurations"]
    assert declared["base"]["training"]["init_from"] == "host host"
    assert declared["host host"]["optim"]["lr"] == 0.1
    other = (replace(table.hosts[0], settings=("--optim.lr", "0.2")),)
    with pytest.raises(UserError, match=r"host host: optim\.lr: 0\.1 there, 0\.2 here"):
        run_table(replace(table, hosts=other), range(2), tmp_path)
    shutil.rmtree(next(iter(starts)))
    run_table(table, range(2), tmp_path)  # whose rows are complete: no host is trained for them
    assert sum(host.exists() for host in hosts) == 3
    for start, seeds in list(starts.items())[1:]:
        assert Path(start).parent == tmp_path / "runs"
        assert next(host for host in hosts if str(host) == start)
        assert json.loads((Path(start) / "config.json").read_text())["training"]["seeds"] == seeds


@pytest.mark.slow
def test_no_row_starts_from_a_host_that_failed(tiny, tmp_path, monkeypatch, capsys):
    host = TableRow("host", f"{tiny}:baseline", ("--optim.lr", "0.1"))
    rows = (host, TableRow("base", f"{tiny}:baseline", start="host"), TableRow("alone", f"{tiny}:baseline"))
    table = small(tiny, rows=rows, claims=(Claim("base", "alone"),), hosts=(host,))
    train_run, trained = workers.train_run, []

    def interrupted(config, folder, **options):
        result = train_run(config, folder, **options)
        trained.append(config.optim.lr)
        if config.optim.lr == 0.1 and config.training.seeds == (0,):
            shutil.rmtree(folder / "checkpoints" / "step_00000004")  # one of an earlier step is left
            raise UserError("the disk is full")
        return result

    with monkeypatch.context() as patch:
        patch.setattr(workers, "train_run", interrupted)
        with pytest.raises(UserError, match="2 of 6 trainings failed") as failed:
            run_table(table, range(2), tmp_path)
    assert len(trained) == 5
    assert "host, seed 0, the run that it starts from, is not complete" in str(failed.value)
    table_rows = json.loads((tmp_path / "paper.9" / "table.json").read_text())["rows"]
    counts = {row["model"]: row["seeds"] for row in table_rows if row["checkpoint"] == "last"}
    assert counts == {"host": 1, "base": 1, "alone": 2}
    run_table(table, range(2), tmp_path)  # the same command goes on


def test_a_table_with_more_steps_has_another_name_and_slower_schedules():
    table = TABLES["tf_lane.2"]
    assert table.lengthened(1) is table
    long = table.lengthened(10)
    assert (long.name, long.title) == ("tf_lane.2.steps_x10", f"{table.title}, 10 times the steps")
    for name, config in long.configs(long.rows).items():
        short = table.configs(table.rows)[name].training
        assert config.training == replace(short, steps=10 * short.steps, eval_every=10 * short.eval_every)
    drops = OptimConfig(epoch_steps=3, drops=DropsConfig((5, 9)))
    assert longer(RunConfig(optim=drops), 10).optim == replace(drops, epoch_steps=30, drops=DropsConfig((50, 90)))
    restarts = longer(RunConfig(optim=OptimConfig(restarts=RestartsConfig(cycle_steps=7))), 10).optim.restarts
    assert restarts == RestartsConfig(cycle_steps=70)
    assert main(["tables", "tf_lane.2", "--steps-factor", "2", "--record", "docs"]) == 2
    assert main(["tables", "tf_lane.2", "--steps-factor", "0"]) == 2


@pytest.mark.slow
def test_a_quick_table_is_no_result(tiny, tmp_path, monkeypatch, capsys):
    run_table(small(tiny), range(2), tmp_path, quick=True)
    assert "6 runs, 0 complete; the others compile, train a few updates" in capsys.readouterr().out
    path = tmp_path / "quick" / "paper.9" / "table.md"
    assert "SMOKE TEST" in path.read_text()
    with pytest.raises(UserError, match="smoke test and no result"):
        record([path.with_name("summary.json")], tmp_path / "results")
    assert not (tmp_path / "results").exists()
    # So another declaration may follow: a smoke test is for tables that change.
    run_table(replace(small(tiny), alpha=0.01), range(2), tmp_path, quick=True)
    assert "level 0.01" in (path.parent / "effects.md").read_text()


def test_the_command_lists_tables_and_names_mistakes(capsys):
    assert main(["tables"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in TABLES)
    assert "Updates alone: evaluation and compiling come on top." in listed
    for arguments, message in (
        (["tf_lane1"], "no table tf_lane1: there is tf_lane.1"),
        (["tf_lane.1", "--jobs", "0"], "at least one training"),
        (["tf_lane.1", "--cores", "0"], "--cores 0: at least one"),
        (["tf_lane.1", "--quick", "--record", "docs"], "--quick runs are no results and never recorded"),
        (["gtn_lane.1", "--search", "--seeds", "3"], "--search trains other runs than the table's"),
        (["--quick"], "--quick is about a table: name one"),
        (["--record", "nowhere"], "--record nowhere is no folder of results"),
    ):
        assert main(["tables", *arguments]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", [name for name in TABLES if name.endswith("_as_written")])
def test_every_marker_of_a_table_as_written_enters_by_eq_3_to_the_letter(name):
    table, ours = TABLES[name], TABLES[name.removesuffix("_as_written")]
    priors = [config.task.model.priors.markers for config in table.configs(table.rows).values()]
    assert [row.name for row in table.rows] == [row.name for row in ours.rows]
    assert any(priors)
    markers = [config.task.model.priors.markers for config in ours.configs(ours.rows).values()]
    assert [found and as_written(found) for found in markers] == priors  # nothing else is different
