"""What a sweep refuses before it evaluates anything, with a model that compiles in no time."""

import dataclasses
import shutil

import jax
import pytest

from tests.ablations.test_compare import CONFIG
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations.sweep import runs_below, sweep
from tflane_jax.errors import UserError
from tflane_jax.runs import save_weights
from tflane_jax.tasks.lane_graph import LaneGraphTask


def saved(config, folder):
    """Save an untrained model, and return its folder."""
    example = config.task.shapes(config.data)
    save_weights(config, config.task.init(jax.random.key(0), example), folder)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(CONFIG, tmp_path_factory.mktemp("runs") / "other")


def test_settings_that_cannot_be_swept_are_refused(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(LaneGraphTask, "evaluate", None)  # each mistake is told before the first evaluation
    other = {"other": folder}
    with pytest.raises(UserError, match="no metric all/wit, only all/"):
        sweep(other, "data.world.severity", ["0", "1"], tmp_path, metrics=["all/recall", "all/wit"])
    with pytest.raises(UserError, match="severity"):
        sweep(other, "data.world.severity", ["0", "heavy"], tmp_path)
    with pytest.raises(UserError, match=r"changes settings of the data and the evaluation .* --training\.batch_size"):
        sweep(other, "data.world.severity", ["0"], tmp_path, ["--training.batch_size", "3"])
    with pytest.raises(UserError, match=r"data\.example\.range"):  # numbers would come out all the same
        sweep(other, "data.world.severity", ["0"], tmp_path, ["--data.example.range.x", "-60", "60"])
    with pytest.raises(UserError, match="--values has 0 twice: once is enough"):
        sweep(other, "data.world.severity", ["0", "0", "1"], tmp_path)
    with pytest.raises(UserError, match="give a setting of the data"):
        sweep({"other": folder}, "optim.lr", ["1"], tmp_path)
    with pytest.raises(UserError, match="is no run folder, and holds none"):
        runs_below(tmp_path)
    with pytest.raises(UserError, match=r"runs.*other: unknown setting --data\.world\.severty"):
        sweep({"other": folder}, "data.world.severty", ["1"], tmp_path)
    with pytest.raises(UserError, match=r"severity.*True"):
        sweep(other, "data.world.severity", ["True"], tmp_path)


@pytest.mark.parametrize(
    ("setting", "overrides"),
    [
        ("data.world.severity", ["--data.world.severity", "0.9"]),
        ("data.world.severity", ["--data.world.severity=0.9"]),
        ("data.world.roads.short_roads", ["--data.world.roads.no-short-roads"]),
        ("data.world.traffic", ["--data.world.traffic.vehicles_per_metre", "0.1"]),
    ],
)
def test_a_swept_setting_is_not_given_besides(setting, overrides, folder, tmp_path):
    """Else every row of the table would be evaluated with the one value."""
    with pytest.raises(UserError, match=f"{overrides[0].partition('=')[0]} is what --setting {setting} sweeps"):
        sweep({"other": folder}, setting, ["0.1", "0.5"], tmp_path, overrides)


@pytest.mark.parametrize(("setting", "values"), [("data.train", ["2", "3"]), ("data.world.severity", ["0", "0.0"])])
def test_values_that_leave_the_test_as_it_is_are_refused(setting, values, folder, tmp_path):
    with pytest.raises(UserError, match=f"{setting} = {values[0]} and {values[1]} are the same test"):
        sweep({"other": folder}, setting, values, tmp_path)


def test_runs_that_are_no_seeds_of_one_model_are_not_averaged(tmp_path):
    data = dataclasses.replace(CONFIG.data, train=CONFIG.data.train + 1)
    saved(CONFIG, tmp_path / "a")
    saved(dataclasses.replace(CONFIG, data=data), tmp_path / "b")
    with pytest.raises(UserError, match=r"a and .*b are no seeds of one configuration \(data\.train"):
        runs_below(tmp_path)
    shutil.rmtree(tmp_path / "b")
    saved(CONFIG, tmp_path / "c")
    with pytest.raises(UserError, match="have the same seed"):
        runs_below(tmp_path)


def test_a_run_that_lost_its_configuration_still_counts(tmp_path):
    """Its checkpoints have it too; left out, it would be missing in the mean without a word."""
    (saved(CONFIG, tmp_path / "runs" / "seed_0") / "config.json").unlink()
    assert [run.name for run in runs_below(tmp_path / "runs")] == [str(tmp_path / "runs" / "seed_0")]


def test_models_with_different_test_data_are_refused(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(LaneGraphTask, "evaluate", None)
    config = dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, test=CONFIG.data.test + 1))
    saved(config, tmp_path / "more")
    models = {"other": folder, "more": tmp_path / "more"}
    with pytest.raises(
        UserError, match=r"runs of other and more have different test data \(data\.world\.severity = 0\)"
    ):
        sweep(models, "data.world.severity", ["0"], tmp_path / "out")
    with pytest.raises(TypeError, match="not callable"):  # the same test data: it goes on to evaluate
        sweep(models, "data.world.severity", ["0"], tmp_path / "out", ["--data.test", "2"])
