"""Rows of a table that start from published weights, which the command converts first."""

import pytest

from tests.shared import shared_path
from tflane_jax.ablations.tables import TABLES
from tflane_jax.cli import main
from tflane_jax.config import load_config
from tflane_jax.runs import open_run

CONVERTED = [name for name, table in TABLES.items() if table.conversions]


@pytest.mark.parametrize("name", CONVERTED)
def test_every_row_starts_from_weights_of_its_own_model(name):
    table = TABLES[name]
    models = {made.out: load_config(made.config).task.model for made in table.conversions}
    for row in table.configs(table.rows).values():
        assert row.training.init_from is not None
        assert models[row.training.init_from] == row.task.model


@pytest.mark.parametrize("name", CONVERTED)
def test_missing_weights_are_named_before_anything_is_written(name, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TFLANE_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    assert main(["tables", name, "--quick"]) == 2
    said = capsys.readouterr().err
    assert "the weights lstr (" in said
    assert "TFLANE_WEIGHTS" in said
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.golden
def test_weights_are_converted_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TFLANE_WEIGHTS", str(shared_path("data/lstr")))
    monkeypatch.chdir(tmp_path)
    trained = []
    monkeypatch.setattr("tflane_jax.ablations.rate_search.search_rates", lambda table, *_, **__: trained.append(table))
    command = ["tables", "gtn_lane.2", "--search"]
    assert main(command) == main(command) == 0
    assert len(trained) == 2
    table = TABLES["gtn_lane.2"]
    said = capsys.readouterr().out
    for made in table.conversions:
        assert said.count(f"converted lstr to {made.out}, from which rows start\n") == 1
        assert open_run(tmp_path / made.out).config.task == load_config(made.config).task
