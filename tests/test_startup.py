"""What is shown before the first step, and compiling that a signal ends."""

import io
import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

from tests.shared import ROOT
from tests.tiny_run import CONFIG, fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.cli import main
from tflane_jax.startup import in_another_thread, ready, showing, stage
from tflane_jax.tasks.lane_graph import LaneGraphTask


def work():
    with stage("reading"):
        pass
    with stage("tracing"):
        pass
    ready()


def test_stages_are_lines_with_the_time_since_the_beginning(capsys):
    with showing(True), showing(True):
        work()
    *lines, last = capsys.readouterr().err.splitlines()
    assert [re.sub(r"\d+\.\d", "N", line) for line in lines] == ["[  N s] reading", "[  N s] tracing"]
    assert re.fullmatch(r"ready after \d+\.\d s \(reading \d+\.\d s, tracing \d+\.\d s\)", last)


def test_on_a_terminal_one_line_is_updated(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr("tflane_jax.startup._REFRESH_SECONDS", 0.01)
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    with showing(True):
        with stage("compiling"):
            time.sleep(0.1)
        shown = terminal.getvalue()
        work()
    assert shown.count("\rcompiling (00:00)") > 2
    assert "\n" not in shown
    assert terminal.getvalue().count("\n") == 1  # of the summary


def test_a_function_gets_the_names_and_nothing_is_shown_without_a_block(capsys):
    told = []
    with showing(told.append), showing(False):
        work()
    work()
    with showing(False):
        work()
    assert told == ["reading", "", "tracing", ""]
    assert capsys.readouterr().err == ""


def test_another_thread_gives_its_result_or_its_error():
    assert in_another_thread(lambda: threading.current_thread() is threading.main_thread()) is False
    with pytest.raises(ZeroDivisionError):
        in_another_thread(lambda: 1 // 0)


@pytest.mark.usefixtures("interruptible")
def test_a_signal_ends_the_wait_and_not_the_work():
    release, ended = threading.Event(), threading.Event()

    def compile_it():
        os.kill(os.getpid(), signal.SIGINT)
        release.wait(50)
        ended.set()

    with pytest.raises(KeyboardInterrupt):
        in_another_thread(compile_it)
    assert not ended.is_set()
    release.set()
    assert ended.wait(50)


@pytest.mark.parametrize(("left", "code"), [(True, 130), (False, 7)])
def test_a_command_does_not_wait_for_a_thread_that_compiles(left, code):
    program = (
        "import os, signal, sys, threading, time\n"
        "from tflane_jax import startup\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def work():\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        f"    time.sleep({600 if left else 0.1})\n"
        "try:\n"
        "    startup.in_another_thread(work)\n"
        "except KeyboardInterrupt:\n"
        "    print('said')\n"
        f"time.sleep({0 if left else 0.5})\n"
        "startup.leave(130)\n"
        "sys.exit(7)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert (ended.returncode, ended.stdout) == (code, "said\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("where", "says"), [("init", "before the run began: give the same"), ("loss", "--resume --out")]
)
@pytest.mark.usefixtures("interruptible")
def test_a_signal_before_the_first_step_ends_the_command(tmp_path, capsys, monkeypatch, number, where, says):
    whole, went_on = getattr(LaneGraphTask, where), []

    def interrupting(*arguments):
        os.kill(os.getpid(), number)
        for _ in range(1000):
            time.sleep(0.01)
        went_on.append(where)
        return whole(*arguments)

    monkeypatch.setattr(LaneGraphTask, where, interrupting)
    (tmp_path / "tiny.py").write_text(CONFIG)
    folder = tmp_path / "stopped"
    # Another number of steps, so that the step is not compiled yet.
    command = ["train", "--config", str(tmp_path / "tiny.py:baseline"), "--out", str(folder), "--training.steps", "7"]
    assert main(command) == 128 + number
    assert not went_on
    assert f"stopped by {number.name}" in (said := capsys.readouterr().err)
    assert says in said
    assert (folder / "config.json").exists() == (where == "loss")
    assert not (folder / "checkpoints").exists()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_whose_error_python_ignores_ends_the_command_all_the_same(capsys, monkeypatch, number):
    class Callback:  # like that of JAX, which the garbage collector calls
        def __del__(self):
            signal.raise_signal(number)

    def command(options):
        del options
        Callback()
        for _ in range(1000):
            time.sleep(0.01)

    monkeypatch.setattr("tflane_jax.commands.cache.show", command)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a process in the background ignores it
    try:
        assert main(["cache", "list"]) == 128 + number
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "tflane: stopped\n"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("where", ["tracing", "compiling"])
def test_a_process_that_traces_or_compiles_ends_at_once_and_resumes(tmp_path, where, number):
    (tmp_path / "tiny.py").write_text(CONFIG)
    command = [sys.executable, "-m", "tests.slow_start"]
    settings = ["--config", str(tmp_path / "tiny.py:baseline"), "--out", str(tmp_path / "run")]
    options = {"cwd": ROOT, "text": True, "env": os.environ | {"TFLANE_CACHE": str(tmp_path / "cache")}}
    with subprocess.Popen([*command, where, "train", *settings], stderr=subprocess.PIPE, **options) as started:
        assert started.stderr is not None
        for line in started.stderr:
            if f"{where} the update step" in line:
                break
        time.sleep(2)
        assert started.poll() is None
        asked = time.perf_counter()
        started.send_signal(number)
        said = started.stderr.read()
        assert started.wait(60) == 128 + number
    assert time.perf_counter() - asked < 10
    assert said.count("\n") == 1
    assert f"stopped by {number.name}; go on with: tflane train --resume --out {tmp_path / 'run'}" in said
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {"config.json", "config.txt", "provenance.json", "run.lock"}
    resume = [*command, "nothing", "train", "--resume", "--out", str(tmp_path / "run")]
    assert subprocess.run(resume, capture_output=True, timeout=200, check=False, **options).returncode == 0
