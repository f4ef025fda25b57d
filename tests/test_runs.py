"""Runs as a whole, on fake examples: runs of older versions, and settings that are checked before training."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from flax.errors import ScopeParamShapeError

from tests.datasets.openlane_scenes import DriveConfig, DriveDataset
from tests.datasets.test_nuscenes_scenes import content
from tests.test_cli import CONFIG as TINY
from tests.test_cli import fakes  # noqa: F401 (a fixture that is used by itself)
from tests.test_migrations import renamed_back
from tflane_jax.config import RealMapData, RecordedData, RunConfig, WorldData, load_config
from tflane_jax.config_io import to_json
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
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
    training_nearness,
)
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.adaptive import AdaptiveConfig
from tflane_jax.training.restarts import RestartsConfig


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("configs") / "tiny.py"
    path.write_text(TINY)
    config = load_config(f"{path}:baseline")
    return replace(config, evaluation=replace(config.evaluation, pictures=0))


def aged(content):
    """Return a configuration (JSON) as an older version wrote it: another name, and without a newer setting."""
    old = renamed_back(content, {"OptimConfig": {"optimizer": "matrices"}})
    del old["training"]["init_partly"]
    return old


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


def test_a_configuration_that_was_edited_to_another_model_is_named(config, tmp_path, monkeypatch):
    """Beside the manifest nothing shows it in a run of this version; in an older one, config.json does."""
    width = lambda task: 3 if task.model.decoder.queries == config.task.model.decoder.queries else 5  # noqa: E731
    init = lambda task, key, example: {"shift": {"kernel": jnp.zeros((1, width(task)))}}  # noqa: E731
    monkeypatch.setattr(LaneGraphTask, "init", init)
    folder = tmp_path / "run"
    save_weights(config, init(config.task, None, None), folder)
    (path,) = (folder / "checkpoints").glob("*/manifest.json")
    content = json.loads(path.read_text())
    content["config"]["data"]["val"] += 1
    path.write_text(json.dumps(content))
    assert open_run(folder).config.data.val == config.data.val + 1  # the same model

    content["config"]["task"]["model"]["decoder"]["queries"] += 1
    message = r"step_00000000: shift/kernel is float32\[1, 3\] in the checkpoint and float32\[1, 5\] in the model"
    for progress in (content["progress"], {}):
        path.write_text(json.dumps(content | {"progress": progress}))
        with pytest.raises(UserError, match=message):
            open_run(folder)

    (folder / "config.json").write_text(json.dumps(content["config"]))
    run = open_run(folder)  # of an older version, with both files edited

    def evaluate(*arguments):
        raise ScopeParamShapeError("kernel", "/shift", (1, 5), (1, 3))

    monkeypatch.setattr(LaneGraphTask, "evaluate", evaluate)
    with pytest.raises(UserError, match=r"shift/kernel is float32\[1, 3\] .* undo that \(config\.txt"):
        evaluate_run(run, config.data.source("test"), progress=False)


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
    ],
)
def test_scores_are_checked_by_name_before_anything_is_done(config, tmp_path, changes, message, monkeypatch):
    monkeypatch.setattr(type(config.task), "load", None)  # no data are looked at
    parts = {part: replace(getattr(config, part), **settings) for part, settings in changes.items()}
    with pytest.raises(UserError, match=message):
        train_run(replace(config, **parts), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_scores_that_an_evaluation_gives_are_known_before(config, tmp_path):
    result = train_run(config, tmp_path / "run", progress=False)
    # The fake model predicts traffic elements, the configuration's does not.
    of_lanes = {name for name in result.metrics if not name.startswith(("all/DET_t", "all/TOP_lt", "all/OLS"))}
    assert of_lanes == config.task.score_names(config.data, config.evaluation) < result.metrics.keys()
    images = RunConfig(LaneShapeTask())
    assert "all/Accuracy" in images.task.score_names(images.data, images.evaluation)
    paper = RunConfig(LaneGraphTask(paper_config()))
    more = {name for name in result.metrics if name not in of_lanes}
    # A model with cameras does not see the raster by which lanes are grouped.
    grouped = {name for name in of_lanes if name.startswith(LANE_GROUPS)}
    assert grouped
    assert paper.task.score_names(paper.data, paper.evaluation) == (of_lanes | more) - grouped


def test_test_frames_are_compared_with_the_places_of_the_training_split(tmp_path):
    np.savez(tmp_path / "scene-0061.npz", **content())
    np.savez(tmp_path / "scene-0099.npz", **content())
    recorded, maps = RecordedData(tmp_path, test=("scene-0099",)), RealMapData(tmp_path, test_logs=("scene-0099",))
    test = recorded.source("test")
    for data in (recorded, maps):
        found = training_nearness(RunConfig(data=data), test)
        assert found is not None
        np.testing.assert_allclose(found.distances, 0.0)  # both files hold the same drive
    assert training_nearness(RunConfig(data=WorldData()), test) is None
    assert training_nearness(RunConfig(data=replace(maps, generated=1.0)), test) is None
    assert training_nearness(RunConfig(data=recorded), WorldData().source("test")) is None


def test_the_training_split_may_lie_in_another_folder(tmp_path):
    """Of a model that learned elsewhere, or whose configuration names another place: `--training-root`."""
    pytest.importorskip("cv2")
    scenes = DriveDataset(DriveConfig(scenes=1))
    root = export_openlane_v2({"train": scenes, "val": scenes}, tmp_path / "data", progress=False)
    source = OpenLaneV2Config(root, "val", "B", image=None)
    found = training_nearness(RunConfig(data=WorldData()), source, root)
    assert found is not None
    assert found.groups == ["near training"] * 3
    assert found.sentence() == (
        "3 of 3 frames are within 5 m of a training frame; the nearest is 0.0 m away. "
        "Files do not name the city of 3 of them, which may be another with equal coordinates"
    )
    with pytest.raises(UserError, match=r"there is no folder .*elsewhere"):
        training_nearness(RunConfig(data=WorldData()), source, tmp_path / "elsewhere")
    with pytest.raises(UserError, match="has no training split in a folder: leave out --training-root"):
        training_nearness(RunConfig(), WorldData().source("test"), root)


def test_the_source_logs_tell_the_city_of_training_frames(tmp_path):
    """Both scenes drive at the same coordinates. The log of a training frame may be missing: its city is not known."""
    pytest.importorskip("cv2")
    one, two = (DriveDataset(DriveConfig(scenes, cameras=7)) for scenes in (1, 2))
    root = export_openlane_v2({"train": one, "val": two}, tmp_path / "data", progress=False)
    turned = export_openlane_v2({"train": two, "val": one}, tmp_path / "turned", progress=False)
    for folder, city in (("both/scene 0", "PIT"), ("both/scene 1", "MIA"), ("first/scene 0", "PIT")):
        (tmp_path / folder / "map").mkdir(parents=True)
        (tmp_path / folder / "map" / f"log_map_archive_x____{city}_city_1.json").touch()
        (tmp_path / folder / ANNOTATIONS).touch()
    source = OpenLaneV2Config(root, "val", "A", image=None, tracks=tmp_path / "both")
    found = training_nearness(RunConfig(data=WorldData()), source, root)
    assert found is not None
    assert found.groups == ["near training"] * 3 + ["far from training"] * 3
    assert found.sentence() == "3 of 6 frames are within 5 m of a training frame; the nearest is 0.0 m away"
    source = replace(source, root=turned, tracks=tmp_path / "first")
    found = training_nearness(RunConfig(data=WorldData()), source, turned)
    assert found is not None
    assert found.groups == ["near training"] * 3
