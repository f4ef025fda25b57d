"""The cache of generated examples: identity, damage, failed and simultaneous builds."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.fakes import BrokenDataset, CrowdedDataset, DeadlyDataset, FakeConfig, FakeDataset, UnevenDataset
from tests.shared import ROOT
from tests.slow import with_slow
from tflane_jax.datasets import cache, parallel
from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.cache import CachedDataset, cache_root, cached, fingerprint
from tflane_jax.datasets.cache_entries import cache_entries, delete_entry
from tflane_jax.errors import UserError


def build(tmp_path: Path, dataset=None, **options) -> CachedDataset:
    options = {"workers": 1, "progress": False, "root": tmp_path} | options
    return cached(FakeDataset(FakeConfig()) if dataset is None else dataset, **options)


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def entries(root: Path) -> list[str]:
    return sorted(p.name for p in root.iterdir() if p.is_dir())


def test_examples_and_infos_come_back_bit_for_bit(tmp_path):
    dataset = FakeDataset(FakeConfig(size=5))
    read = build(tmp_path, dataset)
    assert (len(read), read.name) == (5, "fake")
    for index in range(5):
        assert_same(read.example(index), dataset.example(index))
        read.example(index).validate()
        got, expected = read.info(index), dataset.info(index)
        assert (got.source, got.scene, got.timestamp_ns) == (
            expected.source,
            expected.scene,
            expected.timestamp_ns,
        )
        assert got.global_from_ego.dtype == np.float64
        np.testing.assert_array_equal(got.global_from_ego, expected.global_from_ego)


def test_second_call_reads_what_the_first_built(tmp_path, monkeypatch):
    first = build(tmp_path)
    monkeypatch.setattr(cache, "_build", lambda *_: pytest.fail("built twice"))
    assert build(tmp_path).folder == first.folder


def test_workers_do_not_change_a_byte(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "BLOCK", 2)
    dataset = FakeDataset(FakeConfig(size=7))
    alone = build(tmp_path / "alone", dataset).folder
    shared = build(tmp_path / "shared", dataset, workers=2).folder
    assert alone.name == shared.name
    files = sorted(p.name for p in alone.iterdir())
    assert files == sorted(p.name for p in shared.iterdir())
    for name in files:
        assert (alone / name).read_bytes() == (shared / name).read_bytes(), name


def test_configuration_and_code_are_part_of_the_name(tmp_path, monkeypatch):
    one = FakeDataset(FakeConfig(seed=0))
    assert fingerprint(one) == fingerprint(FakeDataset(FakeConfig(seed=0)))
    assert fingerprint(one) != fingerprint(FakeDataset(FakeConfig(seed=1)))
    assert fingerprint(one) != fingerprint(BrokenDataset(FakeConfig(seed=0)))
    folder = build(tmp_path, one).folder
    monkeypatch.setattr(cache, "source_digest", lambda: "another world")
    assert build(tmp_path, one).folder != folder


@pytest.mark.parametrize("damage", ["truncated", "missing", "index", "empty"])
def test_a_damaged_entry_is_rebuilt(tmp_path, damage):
    entry = build(tmp_path)
    expected, bev = entry.example(1), entry.folder / "bev.npy"
    if damage == "truncated":
        os.truncate(bev, bev.stat().st_size - 1)
    elif damage == "missing":
        bev.unlink()
    elif damage == "index":
        (entry.folder / "index.json").write_text('{"name": "fa')
    else:
        shutil.rmtree(entry.folder)
        entry.folder.mkdir()
    with pytest.raises(cache.DamagedEntry, match="fake-"):
        CachedDataset(entry.folder)
    assert_same(build(tmp_path).example(1), expected)


def test_altered_content_is_noticed_when_it_is_loaded(tmp_path):
    entry = build(tmp_path)
    path = entry.folder / "bev.npy"
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    CachedDataset(entry.folder).arrays(("lanes",))
    with pytest.raises(UserError, match=r"bev\.npy is corrupt: delete"):
        CachedDataset(entry.folder).arrays()


@pytest.mark.slow
def test_warnings_of_workers_are_those_of_the_build(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(parallel, "BLOCK", 2)
    with pytest.warns(TruncationWarning, match="more lanes than room"):
        build(tmp_path, CrowdedDataset(FakeConfig(size=6)), workers=2)
    assert "more lanes" not in capfd.readouterr().err  # nothing was shown by the workers themselves


@pytest.mark.parametrize("workers", with_slow([1, 2], quick=[1]))
def test_a_failed_build_leaves_nothing(tmp_path, monkeypatch, workers):
    monkeypatch.setattr(parallel, "BLOCK", 1)
    with pytest.raises(RuntimeError, match=r"broken\n\(raised by example 2 of fake\)"):
        build(tmp_path, BrokenDataset(FakeConfig(size=4)), workers=workers)
    assert entries(tmp_path) == []


def test_a_worker_that_dies_is_explained(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "BLOCK", 1)
    with pytest.raises(UserError, match=r"worker process .* died"):
        build(tmp_path, DeadlyDataset(FakeConfig(size=4)), workers=2)
    assert entries(tmp_path) == []


def test_examples_of_different_shapes_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"bev is .* in example 1 and .* in example 0"):
        build(tmp_path, UnevenDataset(FakeConfig()))


@pytest.mark.parametrize(("number", "said"), [(errno.ENOSPC, "No space left"), (errno.EFBIG, "File too large")])
def test_a_full_disk_is_one_message(tmp_path, monkeypatch, number, said):
    def full(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(cache, "fill", full)
    with pytest.raises(UserError, match=rf"cannot keep the dataset in .*: {said}.*TFLANE_CACHE"):
        build(tmp_path)
    assert entries(tmp_path) == []


def test_a_file_system_without_locks_is_told_and_used(tmp_path, monkeypatch, capsys):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    build(tmp_path)
    assert "this file system has no locks" in capsys.readouterr().err
    (entry,) = cache_entries(tmp_path)
    assert not entry.building
    delete_entry(entry)


def test_without_locks_two_builders_of_an_entry_leave_each_other_alone(tmp_path, monkeypatch):
    """Regression: the second deleted what the first had built so far."""

    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    def during_which_another_builds(*arguments, **options):
        monkeypatch.setattr(cache, "fill", fill)
        others.append(build(tmp_path))
        return fill(*arguments, **options)

    others, fill = [], cache.fill
    monkeypatch.setattr("fcntl.flock", no_locks)
    monkeypatch.setattr(cache, "fill", during_which_another_builds)
    own = build(tmp_path)
    assert_same(own.example(1), others[0].example(1))
    assert len(entries(tmp_path)) == 1


def test_a_lock_that_was_deleted_with_its_entry_is_taken_anew(tmp_path, monkeypatch):
    import fcntl

    taken, entry, real = [], tmp_path / "entry", fcntl.flock

    def deleted_meanwhile(lock, how):
        taken.append(lock)
        if len(taken) == 1:
            (tmp_path / "entry.lock").unlink()
        real(lock, how)

    monkeypatch.setattr("fcntl.flock", deleted_meanwhile)
    with cache._only_builder(entry):
        assert len(taken) == 2
        assert (tmp_path / "entry.lock").is_file()


def test_too_large_a_dataset_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(cache.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 9, 1))
    monkeypatch.setattr(cache, "fill", lambda *_, **__: pytest.fail("started"))
    with pytest.raises(UserError, match=r"fake needs .* GB; free space"):
        build(tmp_path)


def test_a_folder_that_cannot_be_written_is_one_message(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="TFLANE_CACHE"):
        build(tmp_path, root=tmp_path / "file" / "cache")


def test_an_empty_dataset_is_refused(tmp_path):
    with pytest.raises(UserError, match="no examples"):
        build(tmp_path, FakeDataset(FakeConfig(size=0)))


def test_root_is_taken_from_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path))
    assert cache_root() == tmp_path
    monkeypatch.delenv("TFLANE_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_root() == tmp_path / ".cache" / "tflane_jax"


SCRIPT = """
import signal, sys, time
from pathlib import Path
from tests.fakes import FakeConfig, FakeDataset
from tflane_jax.datasets import cache, parallel

class Slow(FakeDataset):
    def example(self, index):
        with open(Path(sys.argv[1], "made"), "a") as made:
            made.write(f"{index}\\n")
        time.sleep(float(sys.argv[2]))
        return super().example(index)

if __name__ == "__main__":
    # A shell that runs the tests in the background has its children ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print(cache.cached(Slow(FakeConfig(size=6)), root=Path(sys.argv[1]), workers=1, progress=False).folder)
"""


def start(tmp_path: Path, pause: float) -> subprocess.Popen:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(script), str(tmp_path), str(pause)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_builders_at_the_same_time_build_once(tmp_path):
    builders = [start(tmp_path, 0.3) for _ in range(2)]
    outputs = [builder.communicate(timeout=60) for builder in builders]
    assert [builder.returncode for builder in builders] == [0, 0], outputs
    assert outputs[0][0] == outputs[1][0] != ""
    assert len(entries(tmp_path)) == 1
    # Example 0 is made once more, as the template of all.
    assert sorted((tmp_path / "made").read_text().split()) == ["0", "0", "1", "2", "3", "4", "5"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL])
def test_a_killed_build_leaves_no_entry_and_its_remains_are_cleared(tmp_path, kind):
    builder = start(tmp_path, 1.0)
    for _ in range(600):
        if (tmp_path / "made").exists():
            break
        time.sleep(0.05)
    builder.send_signal(kind)
    builder.communicate(timeout=60)
    assert builder.returncode != 0
    assert all(".building-" in name for name in entries(tmp_path))
    assert kind == signal.SIGKILL or entries(tmp_path) == []
    again = start(tmp_path, 0.0)
    again.communicate(timeout=60)
    assert again.returncode == 0
    assert len(entries(tmp_path)) == 1
    index = json.loads((tmp_path / entries(tmp_path)[0] / "index.json").read_text())
    assert len(index["scenes"]) == 6
