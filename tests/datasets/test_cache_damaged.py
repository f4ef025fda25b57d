"""Caches: damaged entries, wrong folders, scripts without a guard; listing and clearing."""

import contextlib
import errno
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fakes import FakeConfig, FakeDataset
from tests.shared import ROOT
from tests.test_damaged_files import CONTENTS, damage
from tflane_jax.cli import main
from tflane_jax.datasets import cache
from tflane_jax.datasets.cache_entries import cache_entries, delete_entry
from tflane_jax.errors import UserError


@pytest.fixture(scope="module", autouse=True)
def digest():
    """Nothing here depends on the code of the world, whose digest takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "source_digest", lambda: "")
        yield


@pytest.fixture(scope="module")
def entry(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("cache")
    return cache.cached(FakeDataset(FakeConfig()), root=root, workers=1, progress=False).folder


@pytest.mark.parametrize("content", CONTENTS)
def test_a_damaged_cache_entry_is_found(tmp_path, entry, content):
    folder = Path(shutil.copytree(entry, tmp_path / "entry"))
    assert len(cache.CachedDataset(folder)) > 0
    damage(folder / "index.json", CONTENTS[content])
    with pytest.raises(cache.DamagedEntry):  # `cached` then builds it again
        cache.CachedDataset(folder)


@pytest.mark.parametrize(
    "change",
    [
        lambda index: index.update(scenes=index["scenes"][1:]),
        lambda index: index.update(scenes="abc"),
        lambda index: index.update(name=None),
        lambda index: index.update(leaves=list(index["leaves"])),
        lambda index: index["leaves"].pop("info.timestamp_ns"),
        lambda index: index["leaves"]["bev"].pop("crc32"),
        lambda index: index["leaves"]["bev"].update(bytes="many"),
    ],
)
def test_a_wrong_index_of_a_cache_entry_is_found(tmp_path, entry, change):
    folder = Path(shutil.copytree(entry, tmp_path / "entry"))
    index = json.loads((folder / "index.json").read_text())
    change(index)
    (folder / "index.json").write_text(json.dumps(index))
    with pytest.raises(cache.DamagedEntry):
        cache.CachedDataset(folder)


def test_a_file_in_place_of_a_cache_entry_is_replaced(tmp_path, entry):
    (tmp_path / entry.name).touch()
    read = cache.cached(FakeDataset(FakeConfig()), root=tmp_path, workers=1, progress=False)
    assert len(read) == len(FakeDataset(FakeConfig()))


def test_a_worker_that_imports_an_unguarded_script_ends_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit, match="outside `if __name__"):
        cache.cached(FakeDataset(FakeConfig()), root=tmp_path, progress=False)


UNGUARDED = """
from tests.fakes import FakeConfig, FakeDataset
from tflane_jax.datasets.cache import cached

cached(FakeDataset(FakeConfig(size=60)), workers=2, progress=False)
"""


@pytest.mark.slow
def test_a_script_without_a_guard_gets_a_message(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    environment = os.environ | {"TFLANE_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
    found = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, env=environment)
    assert found.returncode != 0
    assert "outside `if __name__" in found.stderr
    assert "UserError: a worker process that builds the dataset died" in found.stderr


def test_the_cache_is_listed_and_cleared(tmp_path, entry, capsys, monkeypatch):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path))
    assert main(["cache", "list"]) == 0
    assert "nothing is kept" in capsys.readouterr().out
    other = tmp_path / "other-0123456789abcdef"
    for folder in (tmp_path / entry.name, other):
        shutil.copytree(entry, folder)
    for name in ("weights", "programs", "mine"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text("x")
    os.utime(other / "index.json", (0, 0))
    assert main(["cache", "list"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in (entry.name, other.name, "weights", "programs"))
    assert "mine" not in listed
    assert main(["cache", "clear", other.name[:-1]]) == 2
    assert f"did you mean {other.name}?" in capsys.readouterr().err
    assert main(["cache", "clear", "--older", "1"]) == 0  # all were just written
    assert capsys.readouterr().out == "nothing to delete\n"
    assert main(["cache", "clear", other.name, other.name]) == 0
    assert not other.exists()
    assert main(["cache", "clear", "--all"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "weights"]


def test_an_entry_that_is_being_built_is_not_deleted(tmp_path, entry):
    fcntl = pytest.importorskip("fcntl")
    folder = Path(shutil.copytree(entry, tmp_path / entry.name))
    (one,) = cache_entries(tmp_path)
    with open(folder.with_name(f"{folder.name}.lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(UserError, match="being built"):
            delete_entry(one)
    assert folder.exists()


def test_a_build_under_way_is_told_from_the_remains_of_one_and_kept(tmp_path, entry, capsys, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path))
    building, stopped = (tmp_path / f"{name}-0123456789abcdef.building-x" for name in ("now", "then"))
    rebuilt = Path(shutil.copytree(entry, tmp_path / "damaged-0123456789abcdef"))
    for folder in (building, stopped):
        folder.mkdir()
        (folder / "bev.npy").write_text("x")
    with contextlib.ExitStack() as stack:
        for name in ("now", "damaged"):
            lock = stack.enter_context(open(tmp_path / f"{name}-0123456789abcdef.lock", "w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(["cache", "list"]) == 0
        listed = {row.split("|")[1].strip(): row for row in capsys.readouterr().out.splitlines() if "|" in row}
        assert "being built" in listed[building.name]
        assert "being built" in listed[rebuilt.name]
        assert "left by a stopped build" in listed[stopped.name]
        assert main(["cache", "clear", "--all"]) == 0
        assert f"kept {building}" in capsys.readouterr().out
        assert main(["cache", "clear", building.name]) == 2
        assert "wait for it" in capsys.readouterr().err
    assert building.exists()
    assert rebuilt.exists()
    assert not stopped.exists()


def test_a_build_that_ends_while_the_cache_is_listed_is_no_fault(tmp_path, monkeypatch):
    folder = tmp_path / "ended-0123456789abcdef.building-x"
    folder.mkdir()
    (folder / "bev.npy").write_text("x")
    listing = Path.rglob

    def ended(self, pattern):
        files = list(listing(self, pattern))
        shutil.rmtree(self)
        return files

    monkeypatch.setattr(Path, "rglob", ended)
    assert cache_entries(tmp_path) == []


@pytest.mark.parametrize("named", ["~no_such_user_here/cache", "{file}", "{file}/below", "/proc/nothing"])
def test_a_wrong_cache_folder_is_named(tmp_path, named, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TFLANE_CACHE", named.format(file=tmp_path / "file"))
    with pytest.raises(UserError, match="TFLANE_CACHE"):
        cache.cached(FakeDataset(FakeConfig()), workers=1, progress=False)


def test_a_read_only_home_without_a_folder_for_caches_is_named(tmp_path, monkeypatch):
    """Regression: a folder above the cache could not be made, which ended in a traceback."""

    def read_only(self, *arguments, **options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(tmp_path / "home"))

    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "home" / ".cache" / "tflane"))
    monkeypatch.setattr(Path, "mkdir", read_only)
    with pytest.raises(UserError, match=r"home/\.cache.*: Read-only file system; set TFLANE_CACHE to a folder"):
        cache.cached(FakeDataset(FakeConfig()), workers=1, progress=False)
