"""Commands on data other than a configuration's own: what fits a model, names of results, options without effect."""

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.tiny_run import CONFIG, use_fakes
from tflane_jax.cli import build_parser, main
from tflane_jax.commands import submit
from tflane_jax.commands.sources import chosen_source, data_name, model_title
from tflane_jax.config import LogData, NuScenesData, RunConfig, WorldData, load_config
from tflane_jax.datasets.base import ExampleConfig, MarkerConfig, TrafficRateWarning
from tflane_jax.datasets.data_source import Choice
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.nuscenes_scenes import SceneFileConfig
from tflane_jax.datasets.sources import named_source
from tflane_jax.errors import UserError
from tflane_jax.runs import Run
from tflane_jax.world.cameras.ring import CameraRigConfig

PRESETS = {
    "city": WorldData.city,
    "street": WorldData.street,
    "hills": WorldData.hills,
    "real-like": WorldData.real_like,
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    (folder / "tiny.py").write_text(CONFIG)
    with pytest.MonkeyPatch.context() as patch:
        use_fakes(patch)
        chosen = ["--training.eval-every", "4", "--evaluation.pictures", "0"]
        assert main(["train", "--config", str(folder / "tiny.py"), "--out", str(folder / "run"), *chosen]) == 0
        yield folder / "run"


def test_other_worlds_do_not_replace_the_tables_of_the_own_one(trained, capsys):
    assert main(["eval", str(trained)]) == 0
    own = (trained / "evaluations" / "procedural-test-step4.md").read_text()
    for world in ("city", "real-like"):
        with pytest.warns(TrafficRateWarning, match="at 2 Hz in these data, and this model learned at 10 Hz"):
            assert main(["eval", str(trained), "--data", world]) == 0
        assert f"{trained}, {world}-test-step4: OpenLane-V2" in capsys.readouterr().out
        written = json.loads((trained / "evaluations" / f"{world}-test-step4.json").read_text())
        assert written["meta"]["source"]["scenes"] == 100
    assert (trained / "evaluations" / "procedural-test-step4.md").read_text() == own


def test_a_part_of_openlane_v2_is_chosen_by_its_split_file(tmp_path):
    """Regression: the message of missing frames named a setting that `eval` refused."""
    (tmp_path / "data_dict_subset_A.json").write_text("{}")
    given = {"data": "openlane-v2", "root": str(tmp_path), "openlane": None, "split": None, "default_split": "test"}
    options = argparse.Namespace(**given, data_dict="folders")
    source = chosen_source(RunConfig(), options)
    assert source.data_dict == "folders"
    assert data_name(source, options) == f"openlane-v2-A-test-folders-{tmp_path.name}"
    options = argparse.Namespace(**given | {"data": "city", "root": None}, data_dict="folders")
    with pytest.raises(UserError, match="--data-dict chooses the frames of OpenLane-V2"):
        chosen_source(RunConfig(), options)


def test_a_world_of_other_heights_is_refused(trained, capsys):
    """Regression: only a raster of another box was, so not heights, and no box for cameras."""
    assert main(["eval", str(trained), "--data", "hills"]) == 2
    said = capsys.readouterr().err
    assert "--data hills does not fit this model: " in said
    assert "z (-6.0, 6.0)" in said


@pytest.mark.parametrize("command", ["eval", "predict"])
def test_a_world_of_another_box_is_refused(trained, command, tmp_path, capsys):
    """The default model perceives +-50 m x +-25 m: in the smaller raster, it would see all lanes in the wrong place."""
    assert main([command, str(trained), "--data", "street", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        "tflane: --data street does not fit this model: the evidence raster covers x (-30.72, 30.72)"
    )
    assert "choose data like its own" in said
    assert "task.model.encoder.range" not in said
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_the_same_by_its_name_and_in_python(name):
    chosen = named_source(name).choose(Choice("val", True, RunConfig().data.source("val")))
    assert chosen == PRESETS[name](100, 100, 100).source("val")


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_has_the_priors_and_the_truth_that_the_model_reads(name):
    given = ExampleConfig(
        markers=MarkerConfig(), map_lines=MapLinesConfig(), crossings="sides", elements_of="segments", segment_points=12
    )
    own = PRESETS[name]().example
    configured = replace(WorldData(), example=given).source("test")
    chosen = named_source(name).choose(Choice("test", False, configured)).example
    for field in ("markers", "map_lines", "crossings", "elements_of", "segment_points"):
        assert getattr(chosen, field) == getattr(given, field)
    for field in ("range", "sensor", "lanes", "history", "history_hz", "tracks"):
        assert getattr(chosen, field) == getattr(own, field)
    cameras = replace(given, sensor=None, cameras=CameraRigConfig())
    configured = replace(WorldData(), example=cameras).source("test")
    chosen = named_source(name).choose(Choice("test", False, configured)).example
    assert (chosen.sensor, chosen.cameras) == (None, CameraRigConfig())


@pytest.mark.parametrize(
    ("source", "given", "name"),
    [
        (WorldData().source("test"), {}, "procedural-test"),
        (WorldData().source("val"), {"split": "val"}, "procedural-val"),
        (WorldData.street().source("test"), {"data": "street"}, "street-test"),
        (WorldData.city().source("val"), {"data": "city", "split": "val"}, "city-val"),
        (LogData(Path("a"), Path("a"), Path("a")).source("test"), {"root": "logs/monday"}, "argoverse2-monday"),
        (LogData(Path("a"), Path("a"), Path("sensor/val")).source("test"), {"root": "sensor/val"}, "argoverse2-val"),
        (SceneFileConfig(Path("n")), {"data": "nuscenes-scenes", "root": "n/"}, "nuscenes-scenes-n"),
        (SceneFileConfig(Path("n")), {"root": "n", "split": "val"}, "nuscenes-scenes-val-n"),
        (SceneFileConfig(Path("n")), {"split": "val"}, "nuscenes-scenes-val"),
    ],
)
def test_other_worlds_folders_and_splits_have_other_names(source, given, name):
    options = {"data": None, "root": None, "split": None, "default_split": "test", "data_dict": None} | given
    assert data_name(source, argparse.Namespace(**options)) == name


@pytest.mark.parametrize(
    ("folder", "config", "title"),
    [
        ("runs/tfm", "tf_lane/toponet_tfm", "tfm, step 3"),
        (".", "tf_lane/toponet_tfm", "tfm, step 3"),
        ("runs/runs/b1d907781b71ba6b", "tf_lane/toponet_tfm", "TopoNet + traffic flow, step 3"),
        ("runs/runs/b1d907781b71ba6b", "gtn_lane/gtn", "Lstr + GtnEncoder, step 3"),
    ],
)
def test_pictures_of_a_run_in_a_store_name_its_model(folder, config, title, tmp_path, monkeypatch):
    (tmp_path / "tfm").mkdir()
    monkeypatch.chdir(tmp_path / "tfm")
    assert model_title(Run(folder, load_config(config), 3, ())) == title


def test_a_submission_that_the_server_may_refuse_is_told(monkeypatch, tmp_path, capsys):
    path = tmp_path / "submission.pkl"
    path.write_bytes(b"0" * 3_000_000)
    submit._tell_size(path)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(submit, "_LARGEST", 2e6)
    submit._tell_size(path)
    assert f"warning: {path} has 3 MB: OpenLane-V2's server was reported to refuse more" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--country", "--most-lanes"])
def test_what_only_one_server_takes_is_refused_elsewhere(option, monkeypatch, tmp_path):
    config = RunConfig(data=NuScenesData(tmp_path / "nowhere"))
    monkeypatch.setattr(submit, "opened", lambda options: (SimpleNamespace(config=config), []))
    options = build_parser().parse_args(["submit", "run", "--out", str(tmp_path / "out.json"), option, "7"])
    with pytest.raises(UserError, match=f"{option} is for OpenLane-V2's server"):
        submit.run(options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("eval RUN --openlane x", "--openlane chooses the frames of --data argoverse2 with --root"),
        ("predict RUN --data city --openlane x", "--openlane chooses the frames of --data argoverse2"),
        ("data show --openlane x --count 1", "--openlane chooses the frames of --data argoverse2"),
        ("data stats --beside city --openlane x --count 1", "--openlane chooses the frames of --data argoverse2"),
        ("eval --config gtn_lane/lstr --weights x --checkpoint 7", "--checkpoint 7 is of a run"),
        ("predict --config gtn_lane/lstr --weights x --checkpoint best", "--checkpoint best is of a run"),
        ("eval RUN --config gtn_lane/lstr", "RUN is a run, which has its own configuration: leave --config out"),
        ("summary runs/first", "runs/first is neither a setting nor the value of one: settings are given as, say, --o"),
        ("data maps . --scene -1", "--scene is the number of a scene, 0 or more, not -1"),
        ("summary --no-compile --kind a100", "--kind does nothing without --plan: add it"),
        ("summary --no-compile --utilisation 0.5", "--utilisation does nothing without --plan"),
        ("summary --no-compile --plan 2 --depth 3", "--depth does nothing with --plan: leave --depth or --plan out"),
        ("summary --no-compile --plan 2 --no-training", "--no-training does nothing with --plan"),
        ("summary --no-compile --depth 0", "--depth 0: at least one level of names"),
        ("convert --config gtn_lane/lstr --weights x --out RUN", "RUN already holds a run: choose another folder with"),
        ("tables gtn_lane.9 gtn_lane.9", "gtn_lane.9 is named twice"),
        ("markers run --store s --images i --poses p --threshold 7", "--threshold 7: it must be a score from 0 to 1"),
    ],
)
def test_options_without_effect_are_refused(arguments, message, trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments.replace("RUN", str(trained)).split()) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"tflane: {message.replace('RUN', str(trained))}")
    assert said.count("\n") == 1
    assert os.listdir(tmp_path) == []
