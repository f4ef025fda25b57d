"""`tflane tables A B`: several tables of one command."""

import dataclasses
import json
import re
from types import SimpleNamespace

import pytest

from tests.ablations.test_tables import small
from tests.slow import with_slow
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import workers
from tflane_jax.ablations.paper.table import RateSearch, TableRow
from tflane_jax.cli import build_parser, main
from tflane_jax.errors import UserError

pytestmark = pytest.mark.usefixtures("cheap")


def test_all_tables_are_checked_before_the_first_is_trained(tiny, tmp_path, monkeypatch, capsys):
    wrong = TableRow("tfm", str(tiny), ("--training.best_metric", "all/NONE"))
    tables = {"paper.9": small(tiny), "paper.10": small(tiny, name="paper.10", rows=(*small(tiny).rows[:1], wrong))}
    monkeypatch.setattr("tflane_jax.commands.tables.find_table", tables.get)
    assert main(["tables", *tables, "--seeds", "1", "--out", str(tmp_path / "out")]) == 2
    assert re.search(r"tfm: .*training\.best_metric", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_all_searches_are_checked_before_the_first_is_trained(tiny, tmp_path, monkeypatch, capsys):
    search = RateSearch(("fast",), (1e-3,), "all/DET_l")
    tables = {"paper.9": dataclasses.replace(small(tiny), search=search), "paper.10": small(tiny, name="paper.10")}
    monkeypatch.setattr("tflane_jax.commands.tables.find_table", tables.get)
    assert main(["tables", *tables, "--search", "--out", str(tmp_path / "out")]) == 2
    assert "table paper.10 has no search" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_table_without_a_finished_run_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    begun = []

    def begin(table, *_, **__):
        begun.append(table.name)
        raise UserError("no run is finished")

    monkeypatch.setattr("tflane_jax.ablations.table_run.begin_table", begin)
    assert main(["tables", "tf_lane.1", "tf_lane.2", "--finished", "--out", str(tmp_path)]) == 2
    assert begun == ["tf_lane.1", "tf_lane.2"]


@pytest.mark.parametrize("together", with_slow([False, True], quick=[True]))
def test_tables_of_one_command_are_trained_one_by_one_or_together(tiny, tmp_path, monkeypatch, together):
    """The second table adds one row to two of the first. Together they advance seed by seed."""
    other = TableRow("slow", str(tiny), ("--optim.lr", "0.001"))
    rows = (*small(tiny).rows[:2], other)
    tables = {"paper.9": small(tiny), "paper.10": small(tiny, name="paper.10", rows=rows)}
    trained, train_run = [], workers.train_run

    def noting(config, folder, **options):
        trained.append((config.training.seeds[0], config.optim.lr))
        return train_run(config, folder, **options)

    monkeypatch.setattr("tflane_jax.commands.tables.find_table", tables.get)
    monkeypatch.setattr(workers, "train_run", noting)
    options = ["--together"] if together else []
    assert main(["tables", *tables, *options, "--seeds", "2", "--out", str(tmp_path)]) == 0
    seeds = [seed for seed, _ in trained]
    assert len(trained) == 8  # two rows are trained once for both
    assert seeds == ([0] * 4 + [1] * 4 if together else [0] * 3 + [1] * 3 + [0, 1])
    for name in tables:
        rates = json.loads((tmp_path / name / "summary.json").read_text())["rows"]
        assert {row["seeds"] for row in rates} == {2}


def test_chosen_seeds_of_a_table_are_an_interim_look_at_it(tiny, tmp_path, monkeypatch, capsys):
    table = small(tiny, rows=small(tiny).rows[:2], claims=small(tiny).claims[:1], seeds=3)
    monkeypatch.setattr("tflane_jax.commands.tables.find_table", {"paper.9": table}.get)
    assert main(["tables", "paper.9", "--seeds", "0,2-2", "--out", str(tmp_path)]) == 0
    assert "**Interim**: 2 of 3 declared seeds (0, 2)." in (tmp_path / "paper.9" / "effects.md").read_text()
    assert json.loads((tmp_path / "paper.9" / "summary.json").read_text())["seeds"] == [0, 2]
    declaration = tmp_path / "paper.9" / "declaration.json"
    assert json.loads(declaration.read_text())["begun"] == 0
    declaration.unlink()
    assert main(["tables", "paper.9", "--seeds", "1-1", "--out", str(tmp_path)]) == 0
    # Regression: runs of declared seeds that this command leaves out did not count.
    assert json.loads(declaration.read_text())["begun"] == 4
    capsys.readouterr()
    assert main(["tables", "paper.9", "--seeds", "3", "--out", str(tmp_path)]) == 0
    assert "6 runs, 6 complete" in capsys.readouterr().out
    assert "Interim" not in (tmp_path / "paper.9" / "effects.md").read_text()


@pytest.mark.parametrize(
    ("text", "seeds"), [("2", [0, 1]), ("2-2", [2]), ("5,0-1,1", [0, 1, 5]), ("0,4-7", [0, 4, 5, 6, 7])]
)
def test_seeds_are_a_number_or_a_list(text, seeds):
    assert list(build_parser().parse_args(["tables", "tf_lane.1", "--seeds", text]).seeds) == seeds


@pytest.mark.parametrize("text", ["0", "", "-1", "3-1", "0,7-4", "1,", "1-2-3", "x", "²", "0-999999999", "9" * 5000])
def test_other_seeds_are_refused(text, capsys):
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args(["tables", "tf_lane.1", f"--seeds={text}"])
    assert ended.value.code == 2
    assert "argument --seeds: " in capsys.readouterr().err


def test_a_table_that_fails_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    """Regression: a training that diverges does so each time, and later tables of a command were never reached."""
    reached, recorded = [], []

    def failing_first(begun, failures):
        reached.append(begun.table.name)
        if len(reached) == 1:
            raise UserError("1 of 40 trainings failed")
        return tmp_path / begun.table.name / "table.md"

    run = "tflane_jax.ablations.table_run"
    monkeypatch.setattr(f"{run}.begin_table", lambda table, *_, **__: SimpleNamespace(table=table))
    monkeypatch.setattr(f"{run}.train_tables", lambda *_: [])
    monkeypatch.setattr(f"{run}.finish_table", failing_first)
    monkeypatch.setattr("tflane_jax.ablations.table_plan.plan_table", lambda *_, **__: None)
    monkeypatch.setattr("tflane_jax.commands.tables.record", lambda paths, folder: recorded.append(paths) or folder)
    command = ["tables", "tf_lane.1", "tf_lane.2", "--out", str(tmp_path), "--record", str(tmp_path / "results")]
    assert main(command) == 2
    told = capsys.readouterr().err
    assert reached == ["tf_lane.1", "tf_lane.2"]
    assert recorded == [[tmp_path / "tf_lane.2" / "summary.json"]]
    assert "tf_lane.1: 1 of 40 trainings failed\nthe other tables go on\n" in told
    assert told.endswith("tflane: tf_lane.1: 1 of 40 trainings failed\n")
