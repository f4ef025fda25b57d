"""Runs as a whole, on fake examples: runs of older versions, and settings that are checked before training."""

import json
from dataclasses import replace

import jax.numpy as jnp
import pytest
from flax.errors import ScopeParamShapeError

from tests.test_migrations import renamed_back
from tests.tiny_run import CONFIG as TINY
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import to_json
from tflane_jax.datasets.sources import source_of
from tflane_jax.errors import UserError
from tflane_jax.evaluation.lane_groups import LANE_GROUPS
from tflane_jax.models.toponet import paper_config
from tflane_jax.runs import (
    current_form,
    evaluate_run,
    open_run,
    resumable_config,
    save_weights,
    train_run,
    write_weights,
)
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.adaptive import AdaptiveConfig
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.restarts import RestartsConfig
from tflane_jax.training.resumption import carried, latest


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("configs") / "tiny.py"
    path.write_text(TINY)
    config = load_config(f"{path}:baseline")
    return replace(config, evaluation=replace(config.evaluation, pictures=0))


def test_parameters_of_another_model_are_not_saved(config, tmp_path, monkeypatch):
    monkeypatch.setattr(LaneGraphTask, "init", lambda task, key, example: {"scale": jnp.ones(3)})
    for params in ({"scale": jnp.ones(4)}, {}, {"scale": jnp.ones(3), "more": jnp.ones(1)}):
        with pytest.raises(UserError, match=r"not those of this configuration's model: (scale|more)"):
            save_weights(config, params, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    save_weights(config, {"scale": jnp.ones(3)}, str(tmp_path / "run"))
    with pytest.raises(UserError, match=r"run already holds a run: choose another folder, or delete that one$"):
        save_weights(config, {"scale": jnp.ones(3)}, tmp_path / "run")


def test_weights_that_no_training_wrote_are_not_resumed(config, tmp_path):
    """Regression: their checkpoint was called damaged, with the advice to delete it."""
    write_weights(config, {"scale": jnp.ones(3)}, tmp_path / "own")
    checkpoints = Checkpoints(tmp_path / "own" / "checkpoints")
    saved = latest(checkpoints)
    assert saved is not None
    with pytest.raises(UserError, match=r"none to resume: start one from them, --training.init-from \S*own, in"):
        carried(checkpoints, saved, [])
    assert not open_run(tmp_path / "own").chosen  # by no score


def test_a_start_from_another_model_is_told_before_data_are_read(config, tmp_path, monkeypatch):
    """Regression: it was told once the data were built, which may take an hour."""
    write_weights(config, {"shift": {"kernel": jnp.zeros((1, 4))}}, tmp_path / "origin")
    monkeypatch.setattr(LaneGraphTask, "load", None)
    tuned = replace(config, training=replace(config.training, init_from=str(tmp_path / "origin")))
    with pytest.raises(UserError, match=r"origin holds another model \(.* there, .* here\)"):
        train_run(tuned, tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("reference", "kind", "remedy"),
    [
        ("gtn_lane/gtn", "LstrConfig", ": name a run of TopoNetConfig"),
        (
            "tf_lane/lanesegnet",
            "LaneSegNetConfig",
            r": name a run of TopoNetConfig; training.init_partly takes over the 30 of 1,000 parameters \(3 %\) that "
            "both have, and the others start at random",
        ),
    ],
)
def test_a_run_of_another_class_of_models_is_named_as_such(config, reference, kind, remedy, tmp_path, monkeypatch):
    """Regression: the advice was init_partly, with which almost all would have started at random."""
    write_weights(load_config(reference), {"scale": jnp.ones(30)}, tmp_path / "origin")
    new = {"more": jnp.ones(970), "scale": jnp.ones(30)}
    monkeypatch.setattr(LaneGraphTask, "init", lambda task, key, example: new)
    monkeypatch.setattr(LaneGraphTask, "load", None)
    tuned = replace(config, training=replace(config.training, init_from=str(tmp_path / "origin")))
    with pytest.raises(
        UserError, match=rf"origin is a run of {kind}, not of TopoNetConfig \(more is only here\){remedy}$"
    ):
        train_run(tuned, tmp_path / "run", progress=False)


def test_a_run_that_is_overwritten_is_none_to_start_from(config, tmp_path):
    """Regression: it was deleted first, and no checkpoint was left if the training ended before its own first one."""
    folder, link = tmp_path / "run_0", tmp_path / "link_0"
    write_weights(config, {"scale": jnp.ones(3)}, folder)
    link.symlink_to(folder)
    for origin in (folder, link, tmp_path / "run_{seed}"):
        tuned = replace(config, training=replace(config.training, init_from=str(origin)))
        with pytest.raises(UserError, match=r"init_from is .*run_0, which --overwrite deletes: choose another --out"):
            train_run(tuned, folder, start="overwrite", progress=False)
    assert (folder / "checkpoints" / "step_00000000").is_dir()


def aged(content):
    """Return a configuration (JSON) as an older version wrote it: another name, and without a newer setting."""
    old = renamed_back(content, {"OptimConfig": {"optimizer": "matrices"}})
    del old["training"]["init_partly"]
    return old


@pytest.mark.slow
def test_folders_may_be_named_by_text(config, tmp_path):
    train_run(config, f"{tmp_path}/run", progress=False)
    assert open_run(f"{tmp_path}/run").step == open_run(tmp_path / "run").step


def test_a_run_is_drawn_at_every_evaluation_or_at_its_end(config, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("tflane_jax.runs.save_curves", lambda path, records: drawn.append(records[-1]["step"]))
    for when in ("evaluations", "end"):
        train_run(config, tmp_path / when, progress=False, drawn=when)
    assert drawn == [2, 4, 4]


def test_a_run_of_an_older_version_opens_and_resumes(config, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "run"
    train_run(config, folder, progress=False)
    for path in (folder / "config.json", *(folder / "checkpoints").glob("*/manifest.json")):
        content = json.loads(path.read_text())
        new = aged(content) if path.name == "config.json" else content | {"config": aged(content["config"])}
        path.write_text(json.dumps(new))
    assert open_run(folder, "last").config == config
    assert resumable_config(folder) == config
    capsys.readouterr()
    assert train_run(config, folder, start="resume", progress=False).step == 4
    assert capsys.readouterr().err.splitlines() == ["setting training.init_partly is new: default false"]
    assert json.loads((folder / "config.json").read_text()) == to_json(config)
    monkeypatch.setattr(LaneGraphTask, "load", None)  # told before the data are read
    other = replace(config, optim=replace(config.optim, lr=1.0))
    with pytest.raises(UserError, match=r"another configuration \(optim\.lr: 0\.01 there, 1\.0 here\)"):
        train_run(other, folder, start="resume", progress=False)


def test_a_run_is_not_resumed_after_its_files_were_edited(config, tmp_path, monkeypatch):
    def edited(content):
        given = replace(source_of(config.data.source("train")), content=lambda source: f"{content} {source.split}")
        monkeypatch.setattr("tflane_jax.runs.source_of", lambda source: given)

    edited("old")
    train_run(config, tmp_path / "run", progress=False)
    assert train_run(config, tmp_path / "run", start="resume", progress=False).step == 4
    edited("new")
    with pytest.raises(UserError, match="the files of its training data have changed since"):
        train_run(config, tmp_path / "run", start="resume", progress=False)


def test_a_configuration_that_was_edited_to_another_model_is_named(config, tmp_path, monkeypatch):
    """Beside the manifest nothing shows it in a run of this version; in an older one, config.json does."""
    width = lambda task: 3 if task.model.decoder.queries == config.task.model.decoder.queries else 5  # noqa: E731
    init = lambda task, key, example: {"shift": {"kernel": jnp.zeros((1, width(task)))}}  # noqa: E731
    monkeypatch.setattr(LaneGraphTask, "init", init)
    folder = tmp_path / "run"
    write_weights(config, init(config.task, None, None), folder)
    (path,) = (folder / "checkpoints").glob("*/manifest.json")
    content = json.loads(path.read_text())
    content["config"]["data"]["val"] += 1
    path.write_text(json.dumps(content))
    assert open_run(folder).config.data.val == config.data.val + 1  # the same model

    content["config"]["task"]["model"]["decoder"]["queries"] += 1
    message = r"step_00000000: shift/kernel is float32\[1, 3\], and float32\[1, 5\] in the model"
    for progress in (content["progress"], {}):
        path.write_text(json.dumps(content | {"progress": progress}))
        with pytest.raises(UserError, match=message):
            open_run(folder)

    (folder / "config.json").write_text(json.dumps(content["config"]))
    run = open_run(folder)  # of an older version, with both files edited

    def evaluate(*arguments):
        raise ScopeParamShapeError("kernel", "/shift", (1, 5), (1, 3))

    monkeypatch.setattr(LaneGraphTask, "evaluate", evaluate)
    with pytest.raises(UserError, match=r"shift/kernel is float32\[1, 3\], .* undo that \(config\.txt"):
        evaluate_run(run, config.data.source("test"), progress=False)


def test_changes_of_a_runs_configuration_that_have_no_effect_are_told(config, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(LaneGraphTask, "init", lambda task, key, example: {"scale": jnp.ones(3)})
    folder = tmp_path / "run"
    write_weights(config, {"scale": jnp.ones(3)}, folder)
    open_run(folder)
    saved = to_json(config)
    here = saved | {"training": saved["training"] | {"shard_state": not saved["training"]["shard_state"]}}
    (folder / "config.json").write_text(json.dumps(here))
    open_run(folder)  # a resumed run may change where its state is held
    (folder / "config.json").write_text("{")
    open_run(folder)
    assert capsys.readouterr().err == ""
    (folder / "config.json").write_text(json.dumps(saved | {"optim": saved["optim"] | {"lr": 0.5}}))
    assert open_run(folder).config == config
    said = capsys.readouterr().err
    assert "config.json was changed (optim.lr: 0.5 there, " in said
    assert "the configuration of the checkpoints counts" in said


def test_the_current_form_of_a_configuration_is_itself(config):
    assert current_form(to_json(config)) == (to_json(config), [])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"training": {"best_metric": "all/DET_1"}},
            r"training\.best_metric is 'all/DET_1': .*choose one of .*all/DET_l,",
        ),
        ({"training": {"best_metric": "all/OLS"}}, r"training\.best_metric is 'all/OLS'"),
        (
            {"optim": {"restarts": RestartsConfig(adaptive=AdaptiveConfig(metric="loss"))}},
            r"optim\.restarts\.adaptive\.metric is 'loss'",
        ),
        (
            {"optim": {"restarts": RestartsConfig(adaptive=AdaptiveConfig(metric="all/DET_l"))}},
            r'optim\.restarts\.adaptive\.mode is \'min\': it must be "max" for all/DET_l',
        ),
    ],
)
def test_scores_are_checked_by_name_before_anything_is_done(config, tmp_path, changes, message, monkeypatch):
    monkeypatch.setattr(type(config.task), "load", None)  # no data are looked at
    parts = {part: replace(getattr(config, part), **settings) for part, settings in changes.items()}
    with pytest.raises(UserError, match=message):
        train_run(replace(config, **parts), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_scores_that_an_evaluation_gives_are_known_before(config, tmp_path):
    recorded = train_run(config, tmp_path / "run", progress=False).metrics
    examples = config.task.load(config.data.source("val"), progress=False)
    scores = config.task.evaluate(open_run(tmp_path / "run").params[0], examples, config.evaluation).scores().keys()
    # The examples lack some groups of lanes, of which nothing is recorded.
    assert {name for name in scores if name.startswith(("all/", "clear/"))} < recorded.keys() < scores
    first = config.task.score_names(config.data, replace(config.evaluation, versions=("v1.0", "v2.1")))
    assert {"all/TOP_ll", "all/TOP_ll_v2.1"} <= first  # v1.0 gives none without lanes
    # The fake model predicts traffic elements, the configuration's does not.
    of_lanes = {name for name in scores if not name.startswith(("all/DET_t", "all/TOP_lt", "all/OLS"))}
    assert of_lanes == config.task.score_names(config.data, config.evaluation) < scores
    images = RunConfig(LaneShapeTask())
    assert "all/Accuracy" in images.task.score_names(images.data, images.evaluation)
    paper = RunConfig(LaneGraphTask(paper_config()))
    more = {name for name in scores if name not in of_lanes}
    # A model with cameras does not see the raster by which lanes are grouped.
    grouped = {name for name in of_lanes if name.startswith(LANE_GROUPS)}
    assert grouped
    assert paper.task.score_names(paper.data, paper.evaluation) == (of_lanes | more) - grouped


def test_parameters_that_are_not_finite_are_not_saved(tmp_path):
    params = {"scale": jnp.ones(3), "shift": {"kernel": jnp.array([1.0, jnp.nan])}}
    with pytest.raises(UserError, match="parameter shift/kernel holds a number that is not finite"):
        write_weights(RunConfig(), params, tmp_path / "run")
    assert not (tmp_path / "run").exists()
