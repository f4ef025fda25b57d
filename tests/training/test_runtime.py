"""Freed memory is kept for the next step, and compiled programs for the next process."""

import os
import platform
import subprocess
import sys

import jax
import pytest

from tests.shared import ROOT
from tflane_jax.errors import UserError
from tflane_jax.memory import huge_pages_for_children
from tflane_jax.training import runtime

PROGRAM = """
import sys
import jax
from tflane_jax.training.runtime import configure_jax
configure_jax()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
print(jax.jit(lambda x: x * 3 + 1)(2.0), events.count("/jax/compilation_cache/cache_hits"))
"""


def start(folder, **environment):
    others = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=others | {"TFLANE_CACHE": str(folder)} | environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    result, hits = done.stdout.split()
    assert result == "7.0"
    return int(hits)


@pytest.mark.slow
def test_the_second_process_finds_the_programs_of_the_first(tmp_path):
    assert start(tmp_path / "cache") == 0
    assert start(tmp_path / "cache") > 0
    assert list((tmp_path / "cache" / "programs").glob("jit*"))


@pytest.mark.slow
def test_a_program_that_another_job_has_half_written_is_compiled_anew(tmp_path):
    start(tmp_path / "cache")
    for file in (tmp_path / "cache" / "programs").glob("jit*"):
        file.write_bytes(file.read_bytes()[:100])
    assert start(tmp_path / "cache") == 0
    assert start(tmp_path / "cache") > 0  # it was replaced


def test_the_environment_chooses_the_folder_and_none(tmp_path):
    start(tmp_path / "cache", JAX_COMPILATION_CACHE_DIR=str(tmp_path / "other"))
    assert list((tmp_path / "other").glob("jit*"))
    assert not (tmp_path / "cache").exists()
    start(tmp_path / "cache", JAX_ENABLE_COMPILATION_CACHE="false")
    assert not list((tmp_path / "cache").rglob("jit*"))


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "file").touch()
    assert start(tmp_path / "file" / "cache") == 0


@pytest.mark.parametrize(("limit", "kept"), [(100, {"b", "c"}), (39, {"c"}), (0, set())])
def test_the_oldest_programs_are_dropped(tmp_path, monkeypatch, limit, kept):
    monkeypatch.setattr(runtime, "_PROGRAMS", limit)
    monkeypatch.setattr(runtime.jax.config, "update", lambda name, value: None)
    for age, (name, size) in enumerate([("c", 39), ("b", 40), ("a", 41)]):
        (tmp_path / name).write_bytes(b"0" * size)
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    runtime._keep_programs(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == kept


STEPS = """
import resource
import sys
import jax
import jax.numpy as jnp

faults = []
def steps(*_, **__):
    step = jax.jit(lambda x: (x[:, None] * x[None, :]) @ jnp.stack([x, x + 1], 1))  # 100 MB between the products
    for _ in range(9):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        step(jnp.ones(5000)).block_until_ready()
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    raise KeyboardInterrupt  # there is nothing to train

start, folder = sys.argv[1:]
try:
    if start == "plain":
        steps()
    elif start == "configured":
        from tflane_jax.training import runtime
        runtime.configure_jax(keep_programs=False)
        steps()
    elif start == "train":
        from tflane_jax import cli
        from tflane_jax.commands import train
        train.train_run = steps
        cli.main(["train", "--config", "gtn_lane/gtn", "--out", folder])
    else:
        import multiprocessing
        from pathlib import Path
        from tflane_jax.ablations import jobs, workers
        from tflane_jax.config import load_config
        workers.train_run = steps
        workers._check_setting = lambda job: None  # making a setting would start JAX before the worker configures it
        here, there = multiprocessing.Pipe()
        here.send(jobs.Job(load_config("gtn_lane/gtn"), Path(folder), threads={}))
        workers._train_jobs(there, [], {})
except (KeyboardInterrupt, SystemExit):
    pass
print("faults", sorted(faults)[len(faults) // 2])
"""


_OTHERS = ("configured", "train")


def faults(start, folder):
    command = [sys.executable, "-c", STEPS, start, str(folder / "run")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-1])


def test_64_bit_mode_is_refused():
    """Half of a model's arrays would have another type than its parameters."""
    with jax.enable_x64(True), pytest.raises(UserError, match=r"JAX_ENABLE_X64.*unset"):
        runtime.configure_jax(keep_programs=False)


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")
@pytest.mark.parametrize("start", ["worker", *(pytest.param(name, marks=pytest.mark.slow) for name in _OTHERS)])
def test_memory_of_one_step_is_used_by_the_next(tmp_path, start):
    # Without the settings, 25,600 pages of 4 KiB or 50 of 2 MiB are mapped anew each time. With them the heap may grow
    # once more, at any step, where a small block lies in the gap; so the median of the steps is compared.
    assert faults(start, tmp_path) < faults("plain", tmp_path) / 4


HEAPS = """
import ctypes
from tflane_jax.errors import UserError
from tflane_jax.memory import keep_freed_memory
from tflane_jax.startup import in_another_thread

keep_freed_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
here, there = libc.malloc(10_000), in_another_thread(lambda: libc.malloc(10_000))
heap = next(line.split()[0] for line in open("/proc/self/maps") if line.rstrip().endswith("[heap]"))
first, last = (int(end, 16) for end in heap.split("-"))
print(first <= here < last, first <= there < last)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")
def test_compiling_leaves_no_gaps_in_the_heap_of_the_steps():
    said = subprocess.run([sys.executable, "-c", HEAPS], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert said.split() == ["True", "False"]


LARGE = """
import resource
import numpy as np
from tflane_jax.errors import UserError
from tflane_jax.memory import keep_freed_memory

def step():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [np.empty(600 * 2**20, np.uint8) for _ in range(2)]
    for block in blocks:
        block[::4096] = 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

keep_freed_memory()
print(step(), step())
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")
def test_memory_of_a_large_step_is_used_by_the_next():
    """More than a GiB of it, as in an update of LSTR at its full size."""
    said = subprocess.run([sys.executable, "-c", LARGE], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    first, second = map(int, said.split())
    assert second < first / 10


KEPT = """
from tflane_jax.errors import UserError
from tflane_jax.memory import give_back_freed_memory, keep_freed_memory

def resident():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS"))

keep_freed_memory()
blocks = [bytearray(2**24) for _ in range(12)]
last = bytearray(2**20)
full = resident()
del blocks
kept = resident()
give_back_freed_memory()
print(full - kept, full - resident())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")
def test_memory_of_a_training_is_given_back():
    """192 MiB below a block that is still used: kept until they are given back."""
    said = subprocess.run([sys.executable, "-c", KEPT], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    kept, given = map(int, said.split())
    assert kept < 2**14
    assert given > 180 * 2**10


def test_children_ask_for_huge_pages(monkeypatch):
    shown = [sys.executable, "-c", "import os; print(os.environ['GLIBC_TUNABLES'])"]
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.check=1")
    with huge_pages_for_children(), huge_pages_for_children():
        said = subprocess.run(shown, capture_output=True, text=True, check=True).stdout
    assert said.strip() == "glibc.malloc.check=1:glibc.malloc.hugetlb=1"
    assert os.environ["GLIBC_TUNABLES"] == "glibc.malloc.check=1"
    monkeypatch.delenv("GLIBC_TUNABLES")
    with huge_pages_for_children():
        assert os.environ["GLIBC_TUNABLES"] == "glibc.malloc.hugetlb=1"
    assert "GLIBC_TUNABLES" not in os.environ
