"""Warnings of the command line, and what the system refuses it."""

import contextlib
import errno
import importlib.metadata
import multiprocessing
import os
import re
import shlex
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import jax
import numpy as np
import pytest

from tflane_jax import errors
from tflane_jax.child_processes import spared_interrupts
from tflane_jax.cli import OneLineWarnings, main
from tflane_jax.commands.train import score_table
from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.errors import not_installed


def test_warnings_are_one_line_each_and_told_once(capsys):
    others = []
    show = OneLineWarnings(lambda message, category, *place: others.append(str(message)))
    for text in ("more lanes", "more lanes", "more tracks"):
        show(TruncationWarning(text), TruncationWarning, "file.py", 7)
    show(UserWarning("of another package"), UserWarning, "file.py", 7)
    assert capsys.readouterr().err == "tflane: warning: more lanes\ntflane: warning: more tracks\n"
    assert others == ["of another package"]


def test_a_folder_that_may_not_be_read_is_one_line(monkeypatch, capsys):
    def forbidden(*_):
        raise PermissionError(errno.EACCES, "Permission denied", "/private/runs")

    monkeypatch.setattr("tflane_jax.commands.cache.show", forbidden)
    assert main(["cache", "list"]) == 2
    said = capsys.readouterr().err
    assert said == "tflane: /private/runs: Permission denied: give yourself the right, or choose another path\n"


def test_an_array_that_does_not_fit_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr("tflane_jax.commands.cache.show", lambda _: np.zeros(2**55))
    assert main(["cache", "list"]) == 2
    assert re.fullmatch("tflane: memory is full: Unable to allocate 256. PiB .*\n", capsys.readouterr().err)


@pytest.mark.skipif(os.name != "posix", reason="signal masks")
def test_processes_started_so_see_no_interrupt_and_this_one_does():
    """Ctrl-C reaches the whole process group, also children that still import their modules."""
    # A shell starts what runs in the background with the signal ignored, and children inherit that too.
    code = "import os, signal; signal.signal(2, signal.SIG_DFL); os.kill(os.getpid(), 2); print('goes on')"
    wait = [sys.executable, "-c", code]
    with spared_interrupts():
        spared = subprocess.run(wait, capture_output=True, text=True, check=False)
        with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
            masks = [pool.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()) for _ in range(2)]
    assert (spared.returncode, spared.stdout) == (0, "goes on\n")
    assert all(signal.SIGINT in mask.result() for mask in masks)
    assert subprocess.run(wait, capture_output=True, check=False).returncode != 0
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_output_is_one_line():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "tflane_jax.cli", "cache", "list"]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    said = "tflane: cannot print: No space left on device; make room or print elsewhere\n"
    assert (ended.returncode, ended.stderr) == (2, said)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_an_error_that_cannot_be_told_keeps_its_exit_code():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "tflane_jax.cli", "cache", "list", ""]
        ended = subprocess.run(command, stdout=subprocess.PIPE, stderr=full, check=False)
    assert (ended.returncode, ended.stdout) == (2, b"")


def test_characters_that_the_output_lacks_are_escaped(tmp_path):
    environment = os.environ | {"TFLANE_CACHE": str(tmp_path / "ü"), "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "tflane_jax.cli", "cache", "list"]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith(f"{tmp_path}/\\xfc: ")


@pytest.mark.skipif(os.name != "posix", reason="a shell that closes streams")
def test_a_closed_output_is_no_error():
    command = f"{shlex.quote(sys.executable)} -m tflane_jax.cli cache list"
    ended = subprocess.run(f"{command} >&-", shell=True, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_stop_while_own_modules_are_imported_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("TFLANE_IMPORT", "")
    (tmp_path / "slow.py").write_text("raise KeyboardInterrupt")
    assert main(["cache", "list", "--import", str(tmp_path / "slow.py")]) == 130
    assert capsys.readouterr().err == "tflane: stopped\n"


@pytest.mark.parametrize("command", ["data show --count 1", "tables tf_lane.1 --finished"])
def test_a_working_directory_that_is_gone_is_one_line(command, tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert main(command.split()) == 2
    assert "the working directory is not there any more; change to another" in capsys.readouterr().err


def test_options_are_not_abbreviated(capsys):
    """`--imp MODULE` was taken and imported nothing."""
    with pytest.raises(SystemExit, match="2"):
        main(["cache", "list", "--imp", "no_such_module"])
    assert "--imp" in capsys.readouterr().err
    assert main(["train", "--over", "--config", "tf_lane/toponet"]) == 2
    assert "unknown setting --over" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("compare tf_lane/toponet gtn_lane/lstr --seeds 1 4294967296", "--seeds 4294967296: a seed is a whole number"),
        (
            "compare tf_lane/toponet --training.seeds 7 8",
            "--training.seeds is of `tflane train`: give compare its seeds",
        ),
        ("export RUN --out model.json", "--out model.json: a file beside the program has this name"),
        ("score tusimple pr\udce9d.json truth.json", "cannot read 'pr\\udce9d.json': the name is not UTF-8"),
        (
            "summary --no-compile --config tf_lane/toponet_tfm:street --data.example.history 10",
            "the model reads 20 past frames (task.model.priors.traffic_flow.prior.frames), and examples hold 10",
        ),
        ("summary --no-compile --config tf_lane/toponet --data FrontViewData", "this configuration's data are"),
        (
            "score tusimple pr\udcc3\udcbc.json truth.json",
            "cannot read 'pr\\udcc3\\udcbc.json': this process reads names in the encoding of its locale, utf-8, and "
            "the name is UTF-8; set PYTHONUTF8=1",
        ),
        (
            "markers curves --out f\udcc3\udcbcr",
            "cannot write 'f\\udcc3\\udcbcr': this process reads names in the encoding of its locale",
        ),
        ("cache list --import ends.py", "module ends.py (--import or TFLANE_IMPORT) cannot be imported: SystemExit: 3"),
    ],
)
def test_other_mistakes_are_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("TFLANE_IMPORT", "TFLANE_FILES"):
        monkeypatch.setenv(name, "")
    (tmp_path / "ends.py").write_text("import sys\n\nsys.exit(3)\n")
    assert main(arguments.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"tflane: {message}")
    assert said.count("\n") == 1


@pytest.mark.parametrize("full", [True, False])
def test_a_device_whose_memory_is_full_is_one_line(full, monkeypatch, capsys):
    text = "RESOURCE_EXHAUSTED: Out of memory" if full else "INTERNAL: no such program"

    def fail(*_):
        raise jax.errors.JaxRuntimeError(text)

    monkeypatch.setattr("tflane_jax.commands.cache.show", fail)
    with contextlib.nullcontext() if full else pytest.raises(RuntimeError, match="INTERNAL"):
        assert main(["cache", "list"]) == 2
        assert capsys.readouterr().err.startswith("tflane: the memory of the device is full: a smaller training.")


@pytest.mark.parametrize(
    "command",
    [
        "predict no_run",
        "markers run --store no_store --poses no_poses --images no_images",
        "markers detect no_photo --intrinsics 1 1 1 1",
        "markers render --log 0",
    ],
)
def test_where_results_go_is_checked_before_anything_is_read(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert main([*command.split(), "--out", "file/out"]) == 2
    said = capsys.readouterr().err
    assert said == f"tflane: cannot write file/out: {tmp_path}/file is no folder; choose another path\n"


def test_a_package_that_is_missing_is_named_with_its_remedy(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setitem(sys.modules, "cv2", None)
    command = "train --config gtn_lane/gtn --data.train 1 --data.val 1 --training.batch-size 1"
    assert main([*command.split(), "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.endswith(
        "\ntflane: cv2 is not installed: run `pip install -e '.[images]'` in the checkout of tflane_jax\n"
    )
    assert "Traceback" not in said
    assert not (tmp_path / "run").exists()


def test_without_a_checkout_the_packages_of_an_extra_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(errors, "_CHECKOUT", tmp_path / "pyproject.toml")
    needed = ["Jax<1", 'pyarrow>=17; extra == "data"', "shapely>=2; extra == 'data'", 'matplotlib; extra == "plot"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: needed)
    assert errors.install("data") == "run `pip install 'pyarrow>=17' 'shapely>=2'`"
    monkeypatch.undo()
    assert "pip install -e '.[data]'" in errors.install("data")


def test_a_package_of_ones_own_that_is_missing_keeps_its_traceback():
    assert not_installed(ModuleNotFoundError("No module named 'mine'", name="mine")) is None
    assert "[plot]" in str(not_installed(ModuleNotFoundError("", name="matplotlib.axes")))


def test_the_scores_of_a_training_are_a_table_with_a_row_for_each_group_of_lanes():
    scores = {"all/DET_l": 0.25, "all/recall": 0.5, "all/recall@1.0": 0.1, "clear/recall": 0.75, "loss": 3.0}
    lines = score_table(scores, "last evaluation").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert lines[0] == "last evaluation"
    assert cells[0] == ["of", "DET_l", "recall", "loss"]
    assert cells[2:] == [["all", "0.250", "0.500", "3.000"], ["clear", "-", "0.750", "-"]]
