"""The list of data sources: a new dataset costs one file and one entry, and no source ignores --split."""

import json
import shutil
import subprocess
import sys
from dataclasses import MISSING, fields, replace
from pathlib import Path

import pytest

from tests.datasets import toy_source
from tests.shared import ROOT
from tflane_jax.cli import build_parser, main
from tflane_jax.commands.sources import chosen_source
from tflane_jax.config import (
    FrontViewData,
    LogData,
    NuScenesData,
    OpenLaneV2Data,
    RunConfig,
    SceneFileData,
    TuSimpleData,
    WorldData,
    load_config,
)
from tflane_jax.config_io import from_json, to_json
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets import sources
from tflane_jax.datasets.argoverse2 import Argoverse2Config
from tflane_jax.datasets.base import SPLITS, ExampleConfig
from tflane_jax.datasets.data_source import loading_of, split_config
from tflane_jax.datasets.front_views import FrontViewConfig
from tflane_jax.datasets.nuscenes import NuScenesConfig
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.datasets.real_maps import RealMapData
from tflane_jax.datasets.recorded_logs import RecordedConfig, RecordedData
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.tusimple import TuSimpleConfig
from tflane_jax.datasets.view_images import TOPONET_SUBSET_B
from tflane_jax.errors import UserError
from tflane_jax.limits import SettingError, check_settings
from tflane_jax.scene import Example, RoadImage
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.world.cameras.ring import CameraRigConfig

IMAGES = RunConfig(LaneShapeTask(), FrontViewData())


def chosen(*arguments, config=None):
    options = build_parser().parse_args(["eval", "run", *map(str, arguments)])
    return chosen_source(config or RunConfig(), options)


@pytest.fixture
def logs(tmp_path):
    """A folder of two splits with a log each; the annotations are not read here."""
    for split in ("train", "val"):
        (tmp_path / "sensor" / split / f"{split}-log").mkdir(parents=True)
        (tmp_path / "sensor" / split / f"{split}-log" / "annotations.feather").touch()
    return tmp_path


@pytest.mark.slow
def test_a_new_dataset_is_one_file_and_one_entry(tmp_path):
    text = Path(sources.__file__).read_text(encoding="utf-8")
    entry = "    tusimple.SOURCE,\n"
    assert text.count(entry) == 1
    listed = tmp_path / "sources.py"
    listed.write_text("from tests.datasets import toy_source\n" + text.split("from __future__ import annotations\n")[1])
    listed.write_text(listed.read_text().replace(entry, entry + "    toy_source.SOURCE,\n"))
    work = tmp_path / "work"
    work.mkdir()
    command = [sys.executable, "-m", "tests.datasets.toy_session", str(listed), str(work)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_source_has_its_own_name_and_one_config():
    assert len({source.name for source in sources.SOURCES}) == len(sources.SOURCES)
    for source in sources.SOURCES:
        assert sources.named_source(source.name) is source
        same = {one.config: one.data for one in sources.SOURCES if one.data is source.data}
        assert same == {source.config: source.data}
    with pytest.raises(UserError, match="no data source toys, only procedural, "):
        sources.named_source("toys")
    with pytest.raises(TypeError, match=r"config of no data source: add its source by datasets\.sources\.add_source"):
        sources.open_dataset(RunConfig())


@pytest.mark.parametrize(
    ("data", "kind", "names"),
    [
        (WorldData(), Example, ["procedural-train", "procedural-val", "procedural-test"]),
        (LogData(Path("a/train"), Path("b"), Path("c")), Example, ["argoverse2-train", "argoverse2", "argoverse2"]),
        (OpenLaneV2Data(Path("o")), Example, ["openlane-v2-A-train", "openlane-v2-A-val", "openlane-v2-A-val"]),
        (NuScenesData(Path("n")), Example, ["nuscenes-train", "nuscenes-val", "nuscenes-val"]),
        (SceneFileData(Path("n"), ("a",), ("b",), ("c",)), Example, ["nuscenes-scenes"] * 3),
        (FrontViewData(), RoadImage, ["front-views-train", "front-views-val", "front-views-test"]),
        (TuSimpleData(Path("t")), RoadImage, ["tusimple-train", "tusimple-val", "tusimple-test"]),
    ],
)
def test_data_of_a_run_lead_to_their_source(data, kind, names):
    splits = [data.source(split) for split in SPLITS]
    assert [sources.source_name(config) for config in splits] == names
    for config in splits:
        source = sources.source_of(config)
        assert (source.data, source.config, source.example) == (type(data), type(config), kind)


@pytest.mark.parametrize(
    ("data", "of_training"),
    [
        (LogData(Path("a"), Path("b"), Path("c"), keyframes="annotations", image=TOPONET_SUBSET_B), {}),
        (OpenLaneV2Data(Path("o"), subset="B", tracks=Path("t"), map_changes="drop"), {"map_changes": "keep"}),
        (NuScenesData(Path("n"), frame="lidar", image=TOPONET_SUBSET_B, depth_cell=8), {"depth_cell": None}),
        (SceneFileData(Path("n"), ("a",), ("b",), ("c",), ExampleConfig(lanes=7)), {}),
    ],
)
def test_settings_of_a_run_reach_every_split(data, of_training):
    """`of_training`: settings of the training split, with what they are for the others."""
    for split in SPLITS:
        config = data.source(split)
        shared = {f.name for f in fields(data)} & {f.name for f in fields(config)}
        expected = {name: getattr(data, name) for name in shared} | (of_training if split != "train" else {})
        assert {name: getattr(config, name) for name in shared} == expected
        own = {f.name: getattr(config, f.name) for f in fields(config) if f.name not in shared}
        assert list(own.values()) == [getattr(data, split)]


def test_a_setting_that_the_data_lack_has_to_be_given():
    with pytest.raises(AttributeError, match="split"):
        split_config(NuScenesConfig, NuScenesData(Path("n")))


@pytest.mark.parametrize("source", sources.SOURCES, ids=lambda source: source.name)
def test_every_dataset_has_the_setting_of_loading(source):
    """It reaches the config of each split, and no cached example depends on it."""
    loading, paths = StreamingConfig(where="disk", threads=1), ("root", "train", "val", "test")
    required = [f.name for f in fields(source.data) if f.default is MISSING and f.default_factory is MISSING]
    data = source.data(**{name: Path("x") for name in required if name in paths}, loading=loading)
    for split in SPLITS:
        config = data.source(split)
        assert loading_of(config) == loading
        if source.build is not None:
            assert repr(config) == repr(replace(config, loading=StreamingConfig()))
    assert loading_of(object()) == StreamingConfig()


def test_root_does_not_override_the_split(tmp_path, logs):
    """Regression: --root took all of TuSimple's training files, and all of Argoverse 2's logs, for every split."""
    for split in SPLITS:
        expected = TuSimpleConfig(str(tmp_path), split)
        assert chosen("--data", "tusimple", "--root", tmp_path, "--split", split, config=IMAGES) == expected
    # A configuration that reads the training files as its test split does so in its own folder only.
    everything = RunConfig(LaneShapeTask(), TuSimpleData(Path("own"), train="all", val="all", test="all"))
    assert chosen("--split", "test", config=everything) == TuSimpleConfig("own", "all")
    assert chosen("--root", tmp_path, "--split", "test", config=everything) == TuSimpleConfig(str(tmp_path), "test")
    assert chosen("--root", tmp_path, config=everything) == TuSimpleConfig(str(tmp_path), "test")

    for split in ("train", "val"):
        source = chosen("--data", "argoverse2", "--root", logs, "--split", split)
        assert source == Argoverse2Config(logs / "sensor" / split)
        assert chosen("--data", "argoverse2", "--root", logs / "sensor", "--split", split) == source

    source = chosen("--data", "openlane-v2", "--root", tmp_path, "--split", "train")
    assert source == OpenLaneV2Config(tmp_path, "train", example=WorldData().example)

    for split in SPLITS:
        source = chosen("--data", "nuscenes", "--root", tmp_path, "--split", split)
        assert source == NuScenesConfig(tmp_path, split, example=WorldData().example)


def test_nuscenes_without_a_split_is_the_annotated_one(tmp_path):
    """The default of eval is test, and the official test split has no truth; a run's own settings stay."""
    assert chosen("--data", "nuscenes", "--root", tmp_path).split == "val"
    run = RunConfig(data=NuScenesData(tmp_path / "old", version="v1.0-mini", frame="lidar", image=TOPONET_SUBSET_B))
    found = chosen("--data", "nuscenes", "--root", tmp_path, config=run)
    assert found == replace(run.data.source("test"), root=tmp_path)
    # A model with cameras gets the real ones in place of rendered ones.
    rendered = replace(WorldData().example, cameras=CameraRigConfig())
    found = chosen("--data", "nuscenes", "--root", tmp_path, config=RunConfig(data=WorldData(example=rendered)))
    assert (found.image, found.example.cameras) == (TOPONET_SUBSET_B, None)


@pytest.mark.parametrize("split", SPLITS)
def test_the_split_is_used_for_generated_data(split):
    scenes = {"train": 2000, "val": 100, "test": 200}[split]
    assert chosen("--split", split) == ProceduralConfig(split, scenes=scenes)
    assert chosen("--data", "world-cameras", "--split", split).split == split
    logs = RunConfig(data=LogData(Path("a"), Path("b"), Path("c")))
    assert chosen("--data", "procedural", "--split", split, config=logs) == ProceduralConfig(split, scenes=100)
    photos = RunConfig(LaneShapeTask(), TuSimpleData(Path("t")))
    assert chosen("--data", "front-views", "--split", split, config=photos) == FrontViewConfig(split, images=100)


def test_a_split_that_logs_do_not_have_is_refused(logs):
    for arguments in (["--split", "test"], []):  # the default of eval is test
        with pytest.raises(UserError, match="has no split test, only train, val: choose one with --split"):
            chosen("--data", "argoverse2", "--root", logs, *arguments)
    # A folder of logs has no splits: the default takes them all, a split that was asked for is an error.
    folder = logs / "sensor" / "val"
    for where in (folder, folder / "val-log"):
        assert chosen("--data", "argoverse2", "--root", where) == Argoverse2Config(where)
        with pytest.raises(UserError, match="is not divided into splits, so --split train cannot"):
            chosen("--data", "argoverse2", "--root", where, "--split", "train")
    assert chosen("--data", "argoverse2", "--root", folder, "--split", "val") == Argoverse2Config(folder)
    shutil.rmtree(logs / "sensor" / "train")
    with pytest.raises(UserError, match=r"has no split test, only val: add --split val$"):
        chosen("--data", "argoverse2", "--root", logs)


def test_recorded_logs_have_the_splits_that_the_runs_own_data_name(tmp_path):
    """Regression: --split val took all logs, training logs among them."""
    recorded = ["--data", "recorded", "--root", tmp_path]
    maps = RunConfig(data=RealMapData(val_logs=("a",), test_logs=("b", "c")))
    for split, logs, without in (("val", ("a",), ()), ("test", ("b", "c"), ()), ("train", (), ("a", "b", "c"))):
        found = chosen(*recorded, "--split", split, config=maps)
        assert (found.root, found.logs, found.without) == (tmp_path, logs, without)
    own = RunConfig(data=RecordedData(val=("a",), test=("b",)))
    assert [chosen(*recorded, "--split", split, config=own).logs for split in SPLITS] == [(), ("a",), ("b",)]
    # The default of eval, test, takes all of them; so does a folder with the name of the split.
    assert chosen(*recorded) == RecordedConfig(tmp_path, example=WorldData().example)
    assert chosen("--data", "recorded", "--root", tmp_path / "val", "--split", "val").logs == ()
    unnamed = RunConfig(data=RealMapData(val_logs=("a",)))
    for config, split in ((None, "val"), (RunConfig(data=RealMapData()), "train"), (unnamed, "test")):
        with pytest.raises(UserError, match=f"nothing tells which .* split {split}: leave --split out to take all"):
            chosen(*recorded, "--split", split, config=config)


@pytest.mark.parametrize(
    ("arguments", "config", "message"),
    [
        (["--data", "procedural", "--root", "x"], None, "--data procedural takes no --root"),
        (["--data", "argoverse2"], None, "needs --root PATH, a log or a folder of logs"),
        (["--root", "x"], None, "add --data argoverse2 or --data openlane-v2 or --data nuscenes"),
        (["--root", "x"], IMAGES, "--root is the folder of real data: add --data tusimple$"),
        (
            ["--data", "tusimple", "--root", "x"],
            None,
            "no lane graphs: this model takes procedural, .* or recorded",
        ),
        (["--data", "procedural"], IMAGES, "are no images: this model takes front-views or tusimple"),
        ([], replace(IMAGES, data=WorldData()), r"data are lane graphs .*, but its task takes images"),
        ([], replace(RunConfig(), data=FrontViewData()), r"data are images .*, but its task takes lane graphs"),
    ],
)
def test_unsuitable_data_sources_are_refused(arguments, config, message):
    with pytest.raises(UserError, match=message):
        chosen(*arguments, config=config)


def test_help_lists_the_sources_and_a_wrong_name_is_an_error(capsys):
    logs = "argoverse2,openlane-v2,nuscenes,nuscenes-scenes"
    for arguments, names in (
        (
            ["eval", "--help"],
            f"{{procedural,world-cameras,city,street,hills,real-like,{logs},real-maps,recorded,front-views,tusimple}}",
        ),
        (["data", "check", "--help"], f"{{{logs},real-maps,tusimple}}"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 0
        assert names in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        main(["eval", "run", "--data", "toy"])
    assert ended.value.code == 2
    assert (
        "'toy' is none of procedural, world-cameras, city, street, hills, real-like, argoverse2"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("name", ["tusimple", "nuscenes-scenes"])
def test_a_file_of_another_kind_is_no_dataset(name, tmp_path, capsys):
    (tmp_path / "a.py").touch()
    assert main(["data", "check", "--format", name, str(tmp_path / "a.py")]) == 2
    out, said = capsys.readouterr()
    assert out == ""
    assert f"{tmp_path / 'a.py'} is no " in said


def test_tusimples_folder_is_checked(tmp_path, capsys):
    pytest.importorskip("cv2")
    record = {"raw_file": "clips/a.jpg", "lanes": [[100, -2]], "h_samples": [700, 710]}
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "a.jpg").touch()
    for name in ("label_data_0313.json", "label_data_0531.json"):
        (tmp_path / name).write_text(json.dumps(record) + "\n")
    assert main(["data", "check", "--format", "tusimple", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "split train: there is no label_data_0601.json" in text
    assert "split test: there is no test_label.json" in text
    assert main(["data", "check", "--format", "tusimple", str(tmp_path / "clips")]) == 2
    assert f"{tmp_path} does, name that folder" in capsys.readouterr().err
    shutil.copy(tmp_path / "label_data_0313.json", tmp_path / "label_data_0601.json")
    (tmp_path / "label_data_0601.json").write_text(json.dumps(record | {"raw_file": "clips/b.jpg"}) + "\n")
    shutil.copy(tmp_path / "clips" / "a.jpg", tmp_path / "clips" / "b.jpg")
    shutil.copy(tmp_path / "label_data_0531.json", tmp_path / "test_label.json")
    assert main(["data", "check", "--format", "tusimple", str(tmp_path)]) == 0
    assert "| train |      2 |           2 |" in capsys.readouterr().out


@pytest.mark.usefixtures("own_sources")
def test_a_dataset_is_added_from_outside(tmp_path):
    """After a configuration was checked, so that its types are known already."""
    own = RunConfig(data=toy_source.ToyData(tmp_path))
    with pytest.raises(SettingError, match=r"data is ToyData.*: it must be WorldData or"):
        check_settings(own)
    path = tmp_path / "own.py"
    path.write_text(
        "from pathlib import Path\nfrom tests.datasets.toy_source import ToyData\n"
        "from tflane_jax.config import RunConfig\n\n\n"
        "def get_config():\n    return RunConfig(data=ToyData(Path('x')))\n"
    )
    with pytest.raises(UserError, match=r"own\.py, line 7: data is .*an own dataset is added by datasets\.sources"):
        load_config(str(path))
    with pytest.raises(UserError, match=r"no data source toy, .*; an own one is added by datasets\.sources"):
        sources.named_source("toy")
    for _ in range(2):  # as a notebook's cell that runs again
        sources.add_source(toy_source.SOURCE)
    assert sources.source_names()[-1] == "toy"
    assert sources.source_names().count("toy") == 1
    check_settings(own)
    assert load_config(str(path)).data == toy_source.ToyData(Path("x"))
    assert from_json(RunConfig, json.loads(json.dumps(to_json(own)))) == own
    assert apply_overrides(own, ["--data.root", "elsewhere"]).data == toy_source.ToyData(Path("elsewhere"))
    (tmp_path / "test.txt").write_text("3")
    assert len(sources.open_dataset(own.data.source("test"))) == 3
    assert main(["data", "check", "--format", "toy", str(tmp_path)]) == 2  # there are no other splits
    with pytest.raises(ValueError, match=r"tflane_jax has a data source tusimple \(TuSimpleData\): choose other names"):
        sources.add_source(replace(toy_source.SOURCE, name="tusimple"))


@pytest.mark.usefixtures("own_sources")
def test_a_source_without_a_check_of_its_folder_is_refused(tmp_path, capsys):
    sources.add_source(replace(toy_source.SOURCE, check=None))
    assert main(["data", "check", "--format", "toy", str(tmp_path)]) == 2
    assert "tflane: --format toy has no check of a folder: choose one of argoverse2, " in capsys.readouterr().err
