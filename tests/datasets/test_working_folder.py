"""Data in the working folder, named "." or "..": its name, and what lies beside it, are known all the same."""

import argparse
from pathlib import Path

import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tests.datasets.small_argoverse2 import write_log
from tflane_jax.commands.sources import chosen_source
from tflane_jax.config import RunConfig
from tflane_jax.datasets.argoverse2_log import find_logs, load_log
from tflane_jax.datasets.nuscenes_folder import find_tables
from tflane_jax.datasets.nuscenes_tables import read_tables
from tflane_jax.datasets.road_maps import find_maps
from tflane_jax.files.folders import named_folder


@pytest.mark.parametrize(("name", "inner"), [(".", "."), ("sub/..", "."), ("..", "sub")])
def test_tables_of_nuscenes_know_their_split_and_their_maps(tmp_path, monkeypatch, name, inner):
    """Regression: "." was no v1.0-mini, so that its scenes had the splits of the full data set, and lacked maps."""
    folder = write_nuscenes(tmp_path) / "v1.0-mini"
    (folder / "sub").mkdir()
    monkeypatch.chdir(folder / inner)
    found = read_tables(find_tables(Path(name)))
    assert found.mini
    assert found.map_path("singapore-onenorth").is_file()


def test_a_log_of_argoverse_2_has_its_id(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    folder = tmp_path / "val" / "log-a"
    write_log(folder)
    monkeypatch.chdir(folder)
    assert [load_log(one).name for one in find_logs(Path("."))] == ["log-a"]
    assert [one.name for one in find_maps(Path("."))] == ["log-a"]


def test_the_folder_of_a_split_is_that_split(tmp_path, monkeypatch):
    folder = tmp_path / "val"
    folder.mkdir()
    monkeypatch.chdir(folder)
    options = argparse.Namespace(
        data="argoverse2",
        root=Path("."),
        split="val",
        default_split="test",
        openlane=None,
        data_dict=None,
        config=None,
    )
    assert chosen_source(RunConfig(), options).root == folder


def test_other_names_stay_as_they_are():
    assert named_folder(Path("a/b")) == Path("a/b")
    assert named_folder(Path("b")) == Path("b")
