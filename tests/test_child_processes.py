"""Where processes that this program starts look for modules."""

import multiprocessing
import os

import pytest

from tflane_jax.child_processes import SAFE_PATH, environment_of_children


@pytest.mark.parametrize("safe", [False, True])
def test_a_child_runs_no_file_of_the_working_directory(tmp_path, monkeypatch, safe):
    """Regression: a file with the name of one of Python's modules ran in every worker."""
    (tmp_path / "struct.py").write_text("open('ran', 'w').close()\nfrom _struct import *\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with environment_of_children(SAFE_PATH if safe else {}):
        child = multiprocessing.get_context("spawn").Process(target=os.getpid)
        child.start()
    child.join()
    assert (tmp_path / "ran").exists() != safe
    assert "PYTHONSAFEPATH" not in os.environ
