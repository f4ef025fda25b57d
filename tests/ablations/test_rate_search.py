"""The search for learning rates that precedes a table."""

import json
from dataclasses import replace

import pytest

from tests.ablations.test_tables import small
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import rate_search, workers
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
    search = RateSearch(("tfm",), (0.01, 0.02, 0.5), "all/recall", seeds=(7,))
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
    said = capsys.readouterr().out
    assert "copy the rates into the table's rows" in said
    assert ("at the edge of the grid" in said) == (float(row["taken"]) in (0.01, 0.5))

    trained.clear()
    only = small(tiny, search=replace(search, rates=(0.01, 0.5)))
    search_rates(only, tmp_path)
    assert trained == [(0.5, (7,))]  # complete runs are not repeated
    with pytest.raises(UserError, match="no rate of tfm could be trained"):
        search_rates(small(tiny, search=replace(search, rates=(0.5,))), tmp_path)


@pytest.mark.parametrize(
    ("scores", "taken", "edge"),
    [
        ({0.1: [0.9, 0.1], 0.2: [0.6, 0.6], 0.3: [0.5, 0.5]}, "0.2", False),  # by the mean, not by the best seed
        ({0.1: [0.7, 0.7], 0.2: [0.6, 0.6], 0.3: [0.5, 0.5]}, "0.1", True),
        ({0.1: [0.4, 0.4], 0.2: [0.4, 0.5], 0.3: [0.5, 0.5]}, "0.3", True),
        ({0.1: [0.4, 0.4], 0.2: [0.4, 0.5], 0.3: [0.9, None]}, "0.2", False),  # a seed of 0.3 failed
        ({0.1: [None, 0.4], 0.2: [None, 0.5], 0.3: [0.9, None]}, None, False),
    ],
)
def test_rates_are_judged_by_the_mean_over_seeds(scores, taken, edge, monkeypatch):
    monkeypatch.setattr(rate_search, "_last_score", lambda job, name: job)
    (row,) = rate_search.rated(RateSearch(("a",), tuple(scores), "all/recall", seeds=(7, 8)), {"a": scores})
    assert (row["taken"], "at the edge of the grid" in row["remark"]) == (taken, edge)
    assert row["0.1"] == (None if None in scores[0.1] else pytest.approx(sum(scores[0.1]) / 2))


def test_every_seed_of_a_search_is_trained(tiny, tmp_path):
    search = RateSearch(("tfm",), (0.01, 0.02), "all/recall", seeds=(7, 8))
    plan = rate_search.plan_search(small(tiny, search=search), tmp_path)
    trained = {rate: [job.config.training.seeds for job in jobs] for rate, jobs in plan["tfm"].items()}
    assert trained == {rate: [(7,), (8,)] for rate in search.rates}


def test_tables_without_a_search_are_named(capsys):
    assert main(["tables", "tf_lane.1", "--search"]) == 2
    assert "table tf_lane.1 has no search for learning rates" in capsys.readouterr().err


@pytest.mark.parametrize("name", [name for name, table in TABLES.items() if table.search is not None])
def test_every_search_is_about_rows_of_its_table_on_a_seed_of_its_own(name):
    table = TABLES[name]
    assert set(table.search.rows) <= {row.name for row in table.rows}
    assert not set(table.search.seeds) & set(range(table.seeds))
    config = table.configs(table.rows[:1])[table.rows[0].name]
    assert table.search.score in config.task.score_names(config.data, config.evaluation)
