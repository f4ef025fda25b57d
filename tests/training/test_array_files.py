"""Arrays on disk."""

import os

import numpy as np
import pytest

from tflane_jax.training import array_files


def test_arrays_that_this_machine_cannot_hold_are_refused(tmp_path, monkeypatch):
    """Regression: allocating them ended the process, without a message."""
    array_files.save_arrays(tmp_path / "state", {"a/b": np.zeros((3, 1000)), "c": np.zeros((), np.int8)})
    assert array_files.load_arrays(tmp_path / "state")["a/b"].shape == (3, 1000)
    sizes, real = {"SC_PAGE_SIZE": 4000, "SC_PHYS_PAGES": 7}, os.sysconf
    monkeypatch.setattr(os, "sysconf", lambda name: sizes.get(name) or real(name))
    assert array_files.load_arrays(tmp_path / "state")["c"] == 0
    sizes["SC_PHYS_PAGES"] = 6
    with pytest.raises(ValueError, match=r"its arrays claim .* GiB, this machine has"):
        array_files.load_arrays(tmp_path / "state")
