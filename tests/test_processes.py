"""Several processes train one model: the numbers of one, one writer, agreed stops, resumes by another number."""

import json
import os
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

from tests.shared import ROOT
from tests.slow import with_slow
from tests.tiny_run import CONFIG as TINY
from tests.training.many_processes import CONFIG, draw, score
from tests.training.stub_run import run
from tests.training.test_loop import arrays, timeless
from tflane_jax import processes
from tflane_jax.errors import UserError
from tflane_jax.training.checkpoint import Checkpoints


def free_port():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def ended(commands):
    """Run Python side by side with each of `commands`; return exit code, output and errors of each."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    began = [subprocess.Popen([sys.executable, *command], cwd=ROOT, **pipes) for command in commands]
    try:
        said = [each.communicate(timeout=200) for each in began]
        return [(each.returncode, *texts) for each, texts in zip(began, said, strict=True)]
    finally:
        for each in began:
            each.kill()


def begun(folder, starts):
    """Return the command of a process for each of `starts`."""
    common = ["-m", "tests.training.many_processes", str(folder), str(free_port()), str(len(starts))]
    return [[*common, str(i), start] for i, start in enumerate(starts)]


def together(folder, starts):
    """Run a process for each of `starts`; return what each of them said last."""
    found = ended(begun(folder, starts))
    for code, _, errors in found:
        assert code == 0, errors
    return [json.loads(out.splitlines()[-1]) for _, out, _ in found]


JOINED = """
import sys
import jax
from jax.experimental import multihost_utils
from tflane_jax import processes
from tflane_jax.training.runtime import configure_jax
configure_jax()
asked = []
jax.monitoring.register_event_listener(lambda event, **_: asked.append(event))
processes.join(f"localhost:{sys.argv[1]}", 2, int(sys.argv[2]))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
multihost_utils.process_allgather(jax.jit(lambda x: x * 3 + 1)(2.0))
print([event for event in asked if event.endswith(("/cache_hits", "/cache_misses"))])
"""


@pytest.mark.slow
def test_joined_processes_read_and_keep_no_programs(tmp_path, monkeypatch):
    for name in [name for name in os.environ if name.startswith("JAX_COMPILATION") or "ENABLE_COMPILATION" in name]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path))
    port = str(free_port())
    for code, out, errors in ended([["-c", JOINED, port, str(i)] for i in range(2)]):
        assert (code, out.splitlines()[-1:]) == (0, ["[]"]), errors
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


UNEVEN = """
import os, sys
port, index = sys.argv[1], int(sys.argv[2])
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={2 - index}"
from tflane_jax import processes
from tflane_jax.errors import UserError
try:
    processes.join(f"localhost:{port}", 2, index)
except UserError as error:
    print(error)
"""


@pytest.mark.slow
def test_processes_with_different_numbers_of_devices_are_refused():
    """Regression: each printed a traceback of numpy, which could not arrange three devices in rows of two."""
    port = str(free_port())
    for code, out, errors in ended([["-c", UNEVEN, port, str(i)] for i in range(2)]):
        assert code == 0, errors
        assert out.startswith("the processes have different numbers of devices: process 0 has 2, process 1 has 1; give")


def test_the_processes_with_another_number_of_devices_are_named():
    with pytest.raises(UserError, match="process 0 has 1, process 2 has 2, process 3 has 0; give all as many"):
        processes._check_devices([0, 1, 2, 2], 4)
    processes._check_devices([1, 0, 0, 1], 2)


@pytest.fixture(scope="module", params=with_slow([2, 4], quick=[2]))
def trained(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("processes") / "run"
    return folder, together(folder, ["new"] * request.param)


def test_training_gives_the_numbers_of_one_process(trained, tmp_path):
    folder, said = trained
    assert [(each["step"], each["processes"]) for each in said] == [(30, len(said))] * len(said)
    assert len({each["metrics"]["score"] for each in said}) == 1
    run(tmp_path / "run", config=CONFIG, evaluate=score, draw=draw)
    one, many = timeless(tmp_path / "run"), timeless(folder)
    assert [record["step"] for record in many] == [record["step"] for record in one]
    for expected, found in zip(one, many, strict=True):
        for name, value in expected.items():
            if name != "split":
                np.testing.assert_allclose(found[name], value, rtol=1e-6, err_msg=name)
    assert (folder / "picture.txt").read_text().split()[0] == "30"


@pytest.mark.slow
@pytest.mark.parametrize("starts", [("shared", "unpictured"), ("unpictured", "shared")])
def test_processes_need_not_all_be_able_to_draw(tmp_path, starts):
    """Regression: a host without matplotlib did not gather the state that the others gathered for a picture."""
    folder = tmp_path / "run"
    assert [each["step"] for each in together(folder, starts)] == [30, 30]
    assert (folder / "picture.txt").exists() == (starts[0] == "shared")


@pytest.mark.slow
def test_a_folder_in_use_is_refused_by_all(trained):
    folder, before = trained[0], arrays(trained[0])
    said = together(folder, ["new", "new"])
    assert all("already holds a run" in each["error"] for each in said)
    assert arrays(folder) == before


@pytest.mark.slow
def test_all_stop_when_one_is_told_to_and_one_alone_goes_on(trained, tmp_path):
    folder = tmp_path / "run"
    said = together(folder, ["new", "stopped"])
    assert [(each["step"], each["stopped_by"]) for each in said] == [(10, signal.SIGTERM)] * 2
    (alone,) = together(folder, ["resume"])
    assert alone["step"] == 30
    expected, found = timeless(trained[0]), timeless(folder)
    assert len(found) == len(expected)
    np.testing.assert_allclose(found[-1]["score"], expected[-1]["score"], rtol=1e-6)


@pytest.mark.slow
def test_two_resume_what_two_began_bit_for_bit(trained, tmp_path):
    if len(trained[1]) != 2:
        pytest.skip("bit-identical with the same number of processes only")
    folder = tmp_path / "run"
    assert [each["step"] for each in together(folder, ["new", "stopped"])] == [10, 10]
    assert [each["step"] for each in together(folder, ["resume", "resume"])] == [30, 30]
    assert arrays(folder) == arrays(trained[0])
    assert timeless(folder) == timeless(trained[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "code"), [("killed", -signal.SIGKILL), ("unreadable:15", 2)], ids=["killed", "unreadable"]
)
def test_one_that_ends_alone_ends_the_others_and_one_goes_on(trained, tmp_path, fault, code):
    folder = tmp_path / "run"
    (first, *_), (second, _, errors) = ended(begun(folder, ["new", fault]))
    assert second == code
    assert first != 0
    if code == 2:
        assert errors.splitlines()[-1] == "tflane: cannot read image.jpg"
    (alone,) = together(folder, ["resume"])
    assert alone["step"] == 30
    np.testing.assert_allclose(timeless(folder)[-1]["score"], timeless(trained[0])[-1]["score"], rtol=1e-6)


@pytest.mark.slow
def test_what_one_cannot_read_before_the_first_step_ends_all_with_the_same_message(tmp_path):
    said = together(tmp_path / "run", ["new", "unreadable:0"])
    assert [each["error"] for each in said] == ["process 1: cannot read image.jpg", "cannot read image.jpg"]


@pytest.mark.slow
def test_all_processes_have_the_same_examples(tmp_path):
    """Regression: each drew its part of a batch from a permutation of its own."""
    said = together(tmp_path / "run", ["new", "fewer"])
    why = "it has 19 training examples, the first process 20: give all processes the same data"
    assert [each["error"] for each in said] == [f"process 1: {why}", why]
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.slow
def test_one_that_is_stopped_alone_ends_the_others(tmp_path):
    """Regression: they waited for it, and it for them, for five minutes; later JAX took the signal and did nothing."""
    (first, *_), (second, *_) = ended(begun(tmp_path / "run", ["new", "early"]))
    assert second == 128 + signal.SIGTERM
    assert first != 0


@pytest.mark.slow
def test_the_command_line_trains_on_two_processes(tmp_path):
    (tmp_path / "tiny.py").write_text(TINY)
    folder, joined = tmp_path / "run", ["--coordinator", f"localhost:{free_port()}", "--processes", "2", "--process"]
    train = ["-m", "tests.slow_start", "nothing", "train", "--config", str(tmp_path / "tiny.py:baseline"), "--out"]
    (code, out, errors), (other, nothing, quiet) = ended([[*train, str(folder), *joined, str(i)] for i in range(2)])
    assert (code, other) == (0, 0), errors
    assert "2 processes, 2 devices (cpu)" in errors
    assert "evaluation.batch_size" not in errors  # 2, which both share
    assert ("loading fake" in errors, "loading fake" in quiet) == (True, False)
    assert f"{folder}: 4 steps" in out
    assert "steps" not in nothing
    assert Checkpoints(folder / "checkpoints").steps() == [2, 4]
    joined[1] = f"localhost:{free_port()}"
    for code, _, errors in ended([[*train, str(folder), *joined, str(i)] for i in range(2)]):
        assert code == 2
        assert f"{folder} already holds a run" in errors.splitlines()[-1]
    joined[1], rates = f"localhost:{free_port()}", (["--optim.lr", "0.01"], ["--optim.lr", "0.02"])
    commands = [[*train, str(tmp_path / "other"), *joined, str(i), *rate] for i, rate in enumerate(rates)]
    for code, _, errors in ended(commands):
        assert code == 2
        assert "its settings are not those of the first process (optim.lr: 0.01 there, 0.02 here)" in errors
    assert not (tmp_path / "other").exists()


@pytest.mark.slow
def test_processes_that_start_in_different_ways_are_refused(tmp_path):
    """Regression: one gathered while the other broadcast, and both waited for ever."""
    (tmp_path / "tiny.py").write_text(TINY)
    train = ["-m", "tests.slow_start", "nothing", "train", "--out", str(tmp_path / "run"), "--coordinator"]
    train += [f"localhost:{free_port()}", "--processes", "2", "--process"]
    starts = ["--config", str(tmp_path / "tiny.py:baseline")], ["--resume"]
    for code, _, errors in ended([[*train, str(i), *start] for i, start in enumerate(starts)]):
        assert code == 2
        assert "process 0 has --config, process 1 has --resume: give all processes the same command" in errors
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_state_that_processes_share_gives_the_same_numbers(trained, tmp_path):
    folder = tmp_path / "run"
    assert [each["step"] for each in together(folder, ["shared", "shared"])] == [30, 30]
    whole, shared = timeless(trained[0]), timeless(folder)
    assert len(whole) == len(shared)
    for expected, found in zip(whole, shared, strict=True):
        for name, value in expected.items():
            if name != "split":
                np.testing.assert_allclose(found[name], value, rtol=1e-6, err_msg=name)
    assert (folder / "picture.txt").read_text().split()[0] == "30"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("localhost:1", None, None), "belong together"),
        ((None, 2, 0), "belong together"),
        (("localhost:1", 2, 2), "--process 2 is none of 2"),
    ],
)
def test_flags_that_make_no_sense_are_refused(given, said):
    with pytest.raises(UserError, match=said):
        processes.join(*given)


def test_outside_of_a_cluster_the_options_are_named(monkeypatch):
    def initialize(*_, **__):
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr("jax.distributed.initialize", initialize)
    with pytest.raises(UserError, match=r"no cluster's job was found .*: give each process --coordinator HOST:PORT"):
        processes.join(None, None, None)


def test_a_process_on_its_own_is_the_first():
    assert (processes.process_count(), processes.is_first()) == (1, True)
    assert processes.from_first(lambda: {"a": [1, None]}) == {"a": [1, None]}
    assert processes.all_texts("é") == ["é"]
    assert processes.stop_signal(15, 3) == 15
    assert processes.stop_signal(None, 3) is None
