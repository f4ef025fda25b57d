"""Configuration files: what they may hold and load, how they are named, and errors in them."""

import re
from pathlib import Path

import pytest

from tests.shared import ROOT
from tflane_jax.config import RunConfig, load_ablations, load_config, loaded_once
from tflane_jax.config_files import shipped_configs
from tflane_jax.errors import UserError

LOAD = "from tflane_jax.config import load_config\n"
STEPS = (
    "from tflane_jax.config import RunConfig, TrainingConfig\ndef get_config():\n"
    "    return RunConfig(training=TrainingConfig(steps="
)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x = 1", r"has no function get_config\(\)"),
        ("def get_config():\n    return 3", "gave a int, not a RunConfig"),
        ("def get_config():\n    y = 1\n    return y / 0", "line 3: ZeroDivisionError"),
        ("import no_such_module", "line 1: ModuleNotFoundError"),
        ("import sys\nsys.exit(3)", "line 2: SystemExit: 3"),
        ("import sys\ndef get_config():\n    sys.exit('no GPU')", "line 3: SystemExit: no GPU"),
        (
            f"{LOAD}def get_config():\n    return load_config(__file__)",
            r"py, line 3: UserError: config file \S*broken\.py loads itself$",
        ),
        (f"{STEPS}10**5000))", r"line 3: training\.steps is a value that cannot be shown"),
        ("def get_config(:", "line 1: SyntaxError"),
    ],
)
def test_invalid_config_files_are_named(tmp_path, content, message):
    path = tmp_path / "broken.py"
    path.write_text(content)
    with pytest.raises(UserError, match=message) as error:
        load_config(str(path))
    assert str(path) in str(error.value)


@pytest.mark.parametrize("folder", ["", "sub/"])
def test_the_line_of_an_error_is_named_for_relative_paths_too(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    Path(f"{folder}own.py").write_text("def get_config():\n    return 1 / 0\n")
    with pytest.raises(UserError, match=rf"config file {folder}own\.py, line 2: ZeroDivisionError"):
        load_config(f"{folder}own.py")


@pytest.mark.parametrize("ablation", ["", ":wrong"])
@pytest.mark.parametrize(
    ("setting", "allowed"),
    [("optim", "OptimConfig"), ("training", "TrainingConfig"), ("task", "LaneGraphTask or LaneShapeTask")],
)
def test_a_part_of_the_wrong_type_is_named_with_its_line(setting, allowed, ablation, tmp_path):
    path = tmp_path / "own.py"
    path.write_text(
        "from tflane_jax.config import RunConfig\n\n\ndef get_config():\n"
        f"    return RunConfig({setting}={{'lr': 1e-3}})\n\n\n"
        "def ablations():\n    return {'wrong': get_config(), 'number': 3}\n"
    )
    with pytest.raises(UserError, match=rf"own\.py, line 5: {setting} is {{'lr': 0\.001}}: it must be {allowed}"):
        load_config(f"{path}{ablation}")
    with pytest.raises(UserError, match=r"ablation number of config file .*own\.py is a int, not a RunConfig"):
        load_config(f"{path}:number")


@pytest.mark.parametrize(
    ("name", "ablation"), [("tf_lane/toponet_tfm", ""), ("tf_lane/toponet_tfm", ":abla1"), ("markers/host", "")]
)
def test_shipped_configurations_load_by_name_from_any_folder(name, ablation, tmp_path, monkeypatch):
    by_path = load_config(f"{ROOT}/configs/{name}.py{ablation}")
    monkeypatch.chdir(tmp_path)
    assert load_config(f"{name}{ablation}") == by_path


def test_configurations_that_pages_name_exist():
    """Reads commands and docstrings; names with braces and shell variables are skipped."""
    texts = [
        path.read_text("utf-8") for path in [ROOT / "README.md", *ROOT.glob("docs/*.md"), *shipped_configs().values()]
    ]
    systems = "|".join(sorted({name.partition("/")[0] for name in shipped_configs()}))
    pattern = rf"(?<![\w/.])(?:{systems})/[a-z0-9_]+(?::[a-z0-9_]+)?(?![\w/.])"
    names = {name for text in texts for name in re.findall(pattern, text)}
    assert len(names) > 20, "hardly anything found: has the pattern changed?"
    for name in sorted(names):
        load_config(name)


def test_a_file_takes_precedence_over_a_shipped_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text("from tflane_jax.config import RunConfig\n\nget_config = RunConfig\n")
    assert load_config("own.py") == RunConfig()
    with pytest.raises(UserError, match=r"config file own does not exist: did you mean own\.py\?"):
        load_config("own")


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("tf_lane/topnet_tfm", "did you mean tf_lane/toponet_tfm"),
        ("toponet_tfm", "did you mean .*tf_lane/toponet_tfm"),
        ("host", "did you mean markers/host"),
        ("configs/tf_lane/toponet_tfm.py:abla1", "the shipped configuration is called tf_lane/toponet_tfm"),
        ("xyz", "the package ships .*gtn_lane/lstr, .*tf_lane/toponet_tfm"),
        ("tf_lane/toponet_tfm:abla", "no ablation abla, only street, .*; did you mean abla"),
        ("tf_lane/toponet_tfm:xyz", "no ablation xyz, only street, .*abla8$"),
        ("gtn_lane/lstr:xyz", r"has no function ablations\(\)"),
    ],
)
def test_unknown_references_suggest_similar_names(reference, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message):
        load_config(reference)


BASE = """import os
from pathlib import Path
from tflane_jax.config import RunConfig
from tflane_jax.training.loop import TrainingConfig

def get_config():
    with Path("loaded").open("a") as file:
        file.write("x")
    return RunConfig(training=TrainingConfig(steps=int(os.environ["STEPS"])))
"""
BUILT_ON_IT = f"""{LOAD}
def ablations():
    return {{name: load_config("base.py") for name in ("one", "two", "three")}}
"""


def test_a_file_runs_once_for_all_that_build_on_it_and_anew_for_the_next(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("base.py").write_text(BASE)
    Path("rows.py").write_text(BUILT_ON_IT)
    monkeypatch.setenv("STEPS", "1000")
    with loaded_once():
        rows = [load_config(f"rows.py:{name}") for name in ("one", "two")]
        load_ablations("rows.py").clear()
        assert len(load_ablations("rows.py")) == 3
    assert (len(Path("loaded").read_text()), {row.training.steps for row in rows}) == (1, {1000})
    monkeypatch.setenv("STEPS", "2000")  # a setting of a notebook, say
    assert load_config("rows.py:one").training.steps == 2000
    assert len(Path("loaded").read_text()) == 2


def test_missing_config_files_are_errors(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        load_config(str(tmp_path / "nothing.py"))
    (tmp_path / "link").symlink_to(tmp_path / "nothing.py")
    for name, message in (
        (tmp_path, "is a folder"),
        (tmp_path / "link", "a link that leads nowhere"),
        ("", "is empty"),
    ):
        with pytest.raises(UserError, match=message):
            load_config(str(name))
    (tmp_path / "config.txt").touch()
    with pytest.raises(UserError, match="no Python file"):
        load_config(str(tmp_path / "config.txt"))
