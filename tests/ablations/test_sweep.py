"""Sweeps: trained models evaluated while a setting of the test data changes."""

import dataclasses
import json
import re
from typing import Any

import jax
import pytest

from tests.ablations.test_compare import CONFIG
from tests.models.cases import BASELINE
from tests.parameters import random_params
from tflane_jax.ablations.sweep import _given, _tell_unfinished, _tested, sweep
from tflane_jax.cli import main
from tflane_jax.errors import UserError
from tflane_jax.runs import Run, save_weights
from tflane_jax.tasks.lane_graph import LaneGraphTask


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two untrained models, the first with two seeds."""
    root = tmp_path_factory.mktemp("runs")
    other = dataclasses.replace(BASELINE, decoder=dataclasses.replace(BASELINE.decoder, queries=5))
    example = jax.tree.map(jax.numpy.zeros_like, CONFIG.task.shapes(CONFIG.data))
    for path, model, seed in (("one/seed_0", BASELINE, 0), ("one/seed_1", BASELINE, 1), ("other", other, 0)):
        config = dataclasses.replace(CONFIG, task=LaneGraphTask(model))
        save_weights(config, random_params(config.task.init, example, spread=0.2 + 0.1 * seed), root / path)
        for file in (root / path).rglob("*.json"):  # weights have seed 0
            file.write_text(re.sub(r'("seeds": \[\s*)0', rf"\g<1>{seed}", file.read_text()))
    return root


@pytest.mark.slow
def test_every_run_is_evaluated_at_every_value(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    command = ["sweep", f"one={folder / 'one'}", str(folder / "other"), "--setting", "data.world.severity"]
    assert main([*command, "--values", "0", "1", "--out", str(tmp_path / "out")]) == 0
    assert "other" in capsys.readouterr().out
    content = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert [(row["data.world.severity"], row["model"]) for row in content["rows"]] == [
        ("0", "one"),
        ("0", "other"),
        ("1", "one"),
        ("1", "other"),
    ]
    assert [len(seeds) for seeds in content["meta"]["scores"]["one"]] == [2, 2]
    assert (tmp_path / "out" / "sweep.png").stat().st_size > 5_000
    one = {"one": folder / "one" / "seed_0"}
    again = sweep(one, "data.world.severity", ["0"], tmp_path / "again", metrics=["all/recall"])
    assert again.read_text().splitlines()[2].split("|")[1:-1] == [" data.world.severity ", " model ", " all/recall "]
    with pytest.raises(UserError, match="none is best: ask for `last`"):  # runs of no steps were never evaluated
        sweep(one, "data.world.severity", ["0"], tmp_path / "again", which="best")
    first = json.loads(again.with_suffix(".json").read_text())["meta"]["scores"]["one"][0][0]
    assert first == content["meta"]["scores"]["one"][0][0]


def test_a_flag_is_swept_by_true_and_false():
    """A flag takes no value on the command line, and a sweep needs values."""
    setting, cameras = "data.example.cameras.markers", ("--data.example.cameras", "default")
    run = Run("run", CONFIG, CONFIG.training.steps, ())
    for value in (True, False):
        tested: Any = _tested(run, *cameras, *_given(CONFIG, setting, str(value)))
        assert tested.data.example.cameras.markers is value
    assert _given(CONFIG, "data.world.severity", "0.5") == ("--data.world.severity", "0.5")


def test_runs_that_are_not_finished_are_named(capsys):
    """Regression: a seed in the middle of its training entered the mean without a word."""
    steps = CONFIG.training.steps
    runs = [Run(f"run {step}", CONFIG, step, ()) for step in (0, steps - 1, steps)]
    assert _tell_unfinished(runs) == 1
    assert capsys.readouterr().err == f"run {steps - 1} made {steps - 1} of {steps} updates so far\n"
