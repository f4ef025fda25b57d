"""Several processes train one model: the numbers of one, one writer, agreed stops, resumes by another number."""

import json
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

from tests.shared import ROOT
from tests.slow import with_slow
from tests.training.many_processes import CONFIG, draw, score
from tests.training.stub_run import run
from tests.training.test_loop import arrays, timeless
from tflane_jax import processes
from tflane_jax.errors import UserError


def together(folder, starts):
    """Run a process for each of `starts`; return what each of them said last."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "tests.training.many_processes", str(folder), str(port), str(len(starts))]
    began = [
        subprocess.Popen(
            [*command, str(i), start],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i, start in enumerate(starts)
    ]
    ended = [(each, *each.communicate(timeout=100)) for each in began]
    for each, _, errors in ended:
        assert each.returncode == 0, errors
    return [json.loads(out.splitlines()[-1]) for _, out, _ in ended]


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


def test_a_process_on_its_own_is_the_first():
    assert (processes.count(), processes.is_first()) == (1, True)
    assert processes.from_first(lambda: {"a": [1, None]}) == {"a": [1, None]}
    assert processes.stop_signal(15, 3) == 15
    assert processes.stop_signal(None, 3) is None
