"""The search for learning rates that precedes a table."""

import json
from dataclasses import replace

import pytest

from tests.ablations.test_tables import small
from tests.test_cli import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import workers
from tflane_jax.ablations.paper.table import RateSearch
from tflane_jax.ablations.rate_search import search_rates
from tflane_jax.ablations.tables import TABLES
from tflane_jax.cli import main
from tflane_jax.errors import UserError
from tflane_jax.training.records import read_records

pytestmark = pytest.mark.usefixtures("cheap")


def rates_of(out):
    return json.loads((out / "paper.9" / "rates.json").read_text())


def test_the_rate_with_the_best_validation_score_is_taken(tiny, tmp_path, monkeypatch, capsys):
    search = RateSearch(("tfm",), (0.01, 0.02, 0.5), "all/recall", seed=7)
    train_run, trained = workers.train_run, []

    def diverging(config, folder, **options):
        trained.append((config.optim.lr, config.training.seeds))
        if config.optim.lr == 0.5:
            raise UserError("the loss is not finite")
        return train_run(config, folder, **options)

    monkeypatch.setattr(workers, "train_run", diverging)
    search_rates(small(tiny, search=search), tmp_path)
    assert trained == [(0.01, (7,)), (0.02, (7,)), (0.5, (7,))]
    (row,) = rates_of(tmp_path)["rows"]
    scores = {}
    for folder in (path.parent for path in (tmp_path / "runs").glob("*/config.json")):
        last = [record for record in read_records(folder / "metrics.jsonl") if record["split"] == "val"][-1]
        scores[json.loads((folder / "config.json").read_text())["optim"]["lr"]] = last["all/recall"]
    assert {0.01: row["0.01"], 0.02: row["0.02"]} == pytest.approx(scores)
    assert row["0.01"] != row["0.02"]
    assert (row["row"], row["0.5"], float(row["taken"])) == ("tfm", None, max(scores, key=scores.get))
    assert "copy the rates into the table's rows" in capsys.readouterr().out

    trained.clear()
    only = small(tiny, search=replace(search, rates=(0.01, 0.5)))
    search_rates(only, tmp_path)
    assert trained == [(0.5, (7,))]  # complete runs are not repeated
    with pytest.raises(UserError, match="no rate of tfm could be trained"):
        search_rates(small(tiny, search=replace(search, rates=(0.5,))), tmp_path)


def test_tables_without_a_search_are_named(capsys):
    assert main(["tables", "tf_lane.1", "--search"]) == 2
    assert "table tf_lane.1 has no search for learning rates" in capsys.readouterr().err


@pytest.mark.parametrize("name", [name for name, table in TABLES.items() if table.search is not None])
def test_every_search_is_about_rows_of_its_table_on_a_seed_of_its_own(name):
    table = TABLES[name]
    assert set(table.search.rows) <= {row.name for row in table.rows}
    assert table.search.seed not in range(table.seeds)
    config = table.configs(table.rows[:1])[table.rows[0].name]
    assert table.search.score in config.task.score_names(config.data, config.evaluation)
