"""A wheel contains every module and configuration; configurations load by name from any folder."""

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.shared import ROOT
from tflane_jax.config_files import shipped_configs

_LOAD_ALL = """
import tflane_jax
from tflane_jax.config import load_config
from tflane_jax.config_files import shipped_configs
for name in shipped_configs():
    load_config(name)
    print(name)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Return a folder with the modules that setup.py names, laid out as in a wheel."""
    setuptools = pytest.importorskip("setuptools")
    given = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr(setuptools, "setup", lambda **arguments: given.update(arguments))
        runpy.run_path("setup.py")
    site = tmp_path_factory.mktemp("site")
    for package in given["packages"]:
        target = site / package.replace(".", "/")
        target.mkdir(parents=True, exist_ok=True)
        for path in _source(package, given["package_dir"]).glob("*.py"):
            shutil.copy(path, target)
        for name in given["package_data"].get(package, ()):
            shutil.copy(ROOT / package / name, target)
    return site


def _source(package: str, package_dir: dict[str, str]) -> Path:
    for prefix, folder in package_dir.items():
        if package == prefix or package.startswith(f"{prefix}."):
            return ROOT / folder / package.removeprefix(prefix).lstrip(".").replace(".", "/")
    return ROOT / package.replace(".", "/")


def test_every_module_is_packed(installed):
    modules = {path.relative_to(ROOT / "tflane_jax") for path in (ROOT / "tflane_jax").rglob("*.py")}
    modules |= {Path("configs") / path.relative_to(ROOT / "configs") for path in (ROOT / "configs").rglob("*.py")}
    assert {path.relative_to(installed / "tflane_jax") for path in installed.rglob("*.py")} == modules


def test_packed_configurations_load_by_name(installed, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(installed)}
    command = [sys.executable, "-c", _LOAD_ALL]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == list(shipped_configs())


def test_type_checkers_are_told_of_the_annotations(installed):
    assert (installed / "tflane_jax" / "py.typed").is_file()
