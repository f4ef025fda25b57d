"""Classes of the user: modules beside a configuration, classes inside one, and runs that are read back."""

import json
import multiprocessing
import os
import re
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import jax
import pytest

from tests.models.cases import BASELINE, make_example
from tests.shared import ROOT
from tflane_jax import own_modules
from tflane_jax.cli import main
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import from_json, subclasses, to_json
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.own_modules import take_imports
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

LOSS = """from __future__ import annotations
from dataclasses import dataclass
from tflane_jax.limits import PositiveOrZero
from tflane_jax.losses.toponet import TopoNetLossConfig


@dataclass(frozen=True)
class {name}(TopoNetLossConfig):
    smooth_weight: PositiveOrZero = 0.1

"""
CONFIG = """
from tflane_jax.config import RunConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask


def get_config():
    return RunConfig(LaneGraphTask(losses={name}(smooth_weight=0.5)))
"""


@pytest.fixture(autouse=True)
def apart(monkeypatch, tmp_path):
    """Let what a test imports be forgotten after it; it works in a folder of its own, which Python does not know."""
    before = set(sys.modules)
    for name in (own_modules.VARIABLE, own_modules._FILES):
        monkeypatch.setenv(name, "")
    folder = tmp_path / "folder"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    yield
    for name in set(sys.modules) - before:
        if not name.startswith("tflane_jax"):
            del sys.modules[name]


def own_loss(name: str, folder: Path = Path()) -> RunConfig:
    """Return the configuration of a file beside a module with an own loss."""
    folder.mkdir(exist_ok=True)
    (folder / f"module_{name}.py").write_text(LOSS.format(name=name))
    (folder / "conf.py").write_text(f"from module_{name} import {name}\n{CONFIG.format(name=name)}")
    return load_config(str(folder / "conf.py"))


def smooth_weight(config: RunConfig) -> float:
    losses: Any = config.task.losses
    return losses.smooth_weight


def test_imports_may_stand_anywhere():
    arguments = ["--import", "a", "train", "--import=b", "--optim.lr", "1", "--", "--import", "c"]
    assert take_imports(arguments) == (["a", "b"], ["train", "--optim.lr", "1", "--", "--import", "c"])
    assert take_imports(["train", "--import"]) == ([], ["train", "--import"])  # argparse says what is missing


def test_a_config_file_imports_modules_beside_it():
    config = own_loss("BesideLossConfig", Path("sub"))
    assert type(config.task.losses).__name__ == "BesideLossConfig"


def test_shipped_folders_are_not_searched_for_modules():
    before = list(sys.path)
    load_config("tf_lane/toponet_tfm")
    assert sys.path == before


def test_a_run_with_an_own_class_is_read_back_after_its_import(monkeypatch):
    Path("module_late.py").write_text(LOSS.format(name="LateLossConfig"))
    saved = to_json(RunConfig())
    saved["task"]["losses"] = {"class": "LateLossConfig", "smooth_weight": 0.5}
    with pytest.raises(UserError) as error:
        from_json(RunConfig, saved)
    assert str(error.value) == (
        "class LateLossConfig (setting task.losses) is not part of this version of tflane_jax: if it is "
        "yours, import its module (--import MODULE or TFLANE_IMPORT)"
    )
    monkeypatch.setenv("TFLANE_IMPORT", " module_late ,")
    config = from_json(RunConfig, saved)
    assert smooth_weight(config) == 0.5
    assert from_json(RunConfig, to_json(config)) == config


def test_the_imports_that_a_run_needs_are_told():
    assert own_modules.imports_of(RunConfig()) == ""
    assert own_modules.imports_of(own_loss("ToldLossConfig")) == " --import module_ToldLossConfig"
    assert own_modules.imports_of(own_loss("SubLossConfig", Path("sub"))) == " --import sub/module_SubLossConfig.py"
    spaced = own_modules.imports_of(own_loss("SpacedLossConfig", Path("my own")))
    assert spaced == " --import 'my own/module_SpacedLossConfig.py'"
    Path("one_file.py").write_text(LOSS.format(name="FileLossConfig") + CONFIG.format(name="FileLossConfig"))
    assert own_modules.imports_of(load_config("one_file.py")) == " --import one_file.py"


def test_a_class_of_another_part_is_no_unknown_one():
    saved = to_json(RunConfig())
    saved["task"]["losses"] = {"class": "OptimConfig"}
    with pytest.raises(UserError, match=r"^setting task\.losses should be a HostLossConfig, not"):
        from_json(RunConfig, saved)


@pytest.mark.parametrize("arguments", [["--import", "good", "cache", "list"], ["cache", "list", "--import", "good"]])
def test_commands_import_modules_of_the_working_directory(arguments, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    Path("good.py").write_text("print('imported')\n")
    Path("other.py").write_text("print('the other too')\n")
    assert main([*arguments, "--import", "other"]) == 0
    assert capsys.readouterr().out.startswith("imported\nthe other too\n")
    assert os.environ["TFLANE_IMPORT"] == "good,other"  # for the processes that a command starts


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("broken", "ZeroDivisionError: division by zero"),
        ("missing.py", "FileNotFoundError"),
    ],
)
def test_a_module_that_cannot_be_imported_is_one_error(name, message, capsys):
    Path("broken.py").write_text("1 / 0\n")
    assert main(["cache", "list", "--import", name]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"tflane: module {name} (--import or TFLANE_IMPORT) cannot be imported: {message}")
    assert said.count("\n") == 1


@pytest.mark.slow
def test_other_processes_know_the_classes_too(monkeypatch):
    """One of a module beside the configuration, and one of the configuration itself; also read from JSON."""
    Path("inside.py").write_text(LOSS.format(name="InsideLossConfig") + CONFIG.format(name="InsideLossConfig"))
    configs = [own_loss("WorkerLossConfig", Path("sub")), load_config("inside.py")]
    monkeypatch.setenv("TFLANE_IMPORT", "module_WorkerLossConfig,inside.py")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        for config in configs:
            assert pool.submit(to_json, config).result() == to_json(config)
            assert pool.submit(from_json, RunConfig, to_json(config)).result() == config


def test_a_class_inside_a_config_file_is_one_class():
    path = Path("inside.py")
    path.write_text(LOSS.format(name="OneLossConfig") + CONFIG.format(name="OneLossConfig"))
    config = load_config("inside.py")
    assert load_config("../folder/inside.py") == config
    changed = apply_overrides(config, ["--task.losses.smooth-weight", "0.25"])
    assert smooth_weight(changed) == 0.25
    with pytest.raises(UserError, match=r"smooth_weight is -1\.0: it must be"):
        apply_overrides(config, ["--task.losses.smooth-weight=-1.0"])
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    path.write_text(path.read_text().replace("0.5", "0.7"))  # of the same length, within the same second
    other = load_config("inside.py")
    assert smooth_weight(other) == 0.7
    assert from_json(RunConfig, to_json(other)) == other


def test_a_config_file_that_fails_is_not_kept():
    Path("failing.py").write_text("import not_there_yet\n\n\nfrom tflane_jax.config import RunConfig as get_config\n")
    with pytest.raises(UserError, match="line 1: ModuleNotFoundError"):
        load_config("failing.py")
    assert not any(name.startswith("tflane_file_failing") for name in sys.modules)
    Path("not_there_yet.py").touch()
    assert load_config("failing.py") == RunConfig()


def test_an_own_class_has_a_name_of_its_own(monkeypatch):
    @dataclass(frozen=True)
    class Base:
        open_base: ClassVar[bool] = True

    Base.__module__ = "tflane_jax.somewhere"
    monkeypatch.setitem(sys.modules, "own", ModuleType("own"))
    type("Failed", (Base,), {"__module__": "failed"})  # the import of its module has failed
    made = [dataclass(frozen=True)(type("Derived", (Base,), {"__module__": "own"})) for _ in range(2)]
    assert subclasses(Base) == {"Base": Base, "Derived": made[-1]}  # as after running a notebook's cell again
    own = type("Base", (Base,), {"__module__": "own"})
    with pytest.raises(UserError, match="class Base of own is called like one of tflane_jax: give it another name"):
        subclasses(Base)
    assert own.__mro__[1] is Base


def test_two_files_do_not_define_one_class(monkeypatch):
    """Regression: a run was read back with the class of the copy that was imported last."""
    for number in (1, 2):
        Path(f"variant{number}.py").write_text(LOSS.format(name="VariantLossConfig"))
    first, second = (own_modules.import_file(Path(f"variant{number}.py")) for number in (1, 2))
    with pytest.raises(UserError, match=r"class VariantLossConfig is defined in .*variant1\.py and in .*variant2\.py"):
        subclasses(first.VariantLossConfig.__mro__[2])
    assert own_modules.own_code(first.VariantLossConfig()) == own_modules.own_code(second.VariantLossConfig()) != ""
    del sys.modules[second.__name__]
    Path("variant1.py").write_text(f"{LOSS.format(name='VariantLossConfig')}# edited")
    edited = own_modules.import_file(Path("variant1.py"))
    assert subclasses(first.VariantLossConfig.__mro__[2])["VariantLossConfig"] is edited.VariantLossConfig
    assert own_modules.own_code(edited.VariantLossConfig()) != own_modules.own_code(first.VariantLossConfig())


READER = """from typing import TYPE_CHECKING
import numpy
{imported}
if TYPE_CHECKING:
    import json.tool


def read():
    import late{number}
"""


@pytest.mark.parametrize(
    "imported", ["from helper{0} import FACTOR", "import helper{0} as other", "if True:\n    import helper{0}"]
)
def test_modules_that_an_own_class_needs_are_part_of_its_code(imported, request):
    """Regression: after an edit of the reader that a configuration's module imports, kept scores counted as its own."""
    hashes, case = [], request.node.callspec.indices["imported"]
    for value in (1, 2):
        number = f"{case}_{value}"
        Path(f"late{number}.py").write_text("")
        Path(f"helper{number}.py").write_text(f"FACTOR = {value}")
        Path(f"reader{number}.py").write_text(READER.format(imported=imported.format(number), number=number))
        name = f"Needing{number.title()}LossConfig"
        Path(f"needing{number}.py").write_text(f"{LOSS.format(name=name)}\nimport reader{number}\n")
        module = own_modules.import_file(Path(f"needing{number}.py"))
        config = getattr(module, name)()
        needed = {module.__name__, f"reader{number}", f"helper{number}"}
        assert own_modules._own_modules(config) == needed
        content = own_modules.own_content(config)
        sys.modules[f"reader{number}"].read()  # what a function imports changes nothing
        assert own_modules._own_modules(config) == needed
        hashes.append((own_modules._code_of(f"helper{number}"), content))
    assert hashes[0][0] != hashes[1][0]
    assert hashes[0][1] != hashes[1][1]


def test_the_own_loss_of_the_page_adds_its_term(monkeypatch):
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    (code,) = [block for block in re.findall(r"^```python\n(.*?)^```", page, re.S | re.M) if "SmoothLoss" in block]
    Path("smooth.py").write_text(code)
    config = load_config("smooth.py")
    monkeypatch.setenv("TFLANE_IMPORT", "smooth.py")
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    assert isinstance(config.task, LaneGraphTask)
    task = replace(config.task, model=BASELINE)
    batch = stack_examples([make_example(0)])
    params = jax.eval_shape(task.init, jax.random.key(0), make_example(0))
    assert "smooth" in jax.eval_shape(task.loss, params, batch, jax.random.key(0))[1]


def test_a_command_that_names_nothing_of_the_users_imports_nothing_from_the_working_directory(monkeypatch):
    """Regression: libraries probe for optional packages, and a downloaded folder could hold files of their names."""
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder])
    assert main(["eval", "run"]) == 2
    assert os.getcwd() not in sys.path
    Path("helper.py").touch()
    Path("own.py").write_text("import helper\nfrom tflane_jax.config import RunConfig as get_config\n")
    assert load_config("own.py") == RunConfig()
    assert os.getcwd() in sys.path
