"""Workers that build a dataset end with an error or a signal, not with their blocks."""

import multiprocessing
import os
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.fakes import FakeConfig, FakeDataset
from tflane_jax.datasets.parallel import BLOCK, fill, frame_leaves
from tflane_jax.errors import UserError

_SECONDS = 8.0


@dataclass(frozen=True)
class _Config(FakeConfig):
    folder: Path = Path()
    fails: bool = False


class _Slow(FakeDataset):
    """The second block takes seconds; while it runs, the first one fails or is done."""

    config: _Config

    def example(self, index: int):
        begun = self.config.folder / "begun"
        if index == BLOCK:
            begun.touch()
            time.sleep(_SECONDS)
            (self.config.folder / "ended").touch()
        if index == 1 and self.config.fails:
            while not begun.exists():
                time.sleep(0.01)
            raise UserError("broken")
        return super().example(index)


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("by", ["error", "Ctrl-C"])
def test_blocks_that_run_are_not_waited_for(tmp_path, by):
    dataset = _Slow(_Config(2 * BLOCK, folder=tmp_path, fails=by == "error"))
    (tmp_path / "arrays").mkdir()

    def interrupt():
        while not (tmp_path / "begun").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    if by == "Ctrl-C":
        threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(UserError if by == "error" else KeyboardInterrupt):
        fill(tmp_path / "arrays", dataset, frame_leaves(dataset, 0)[0], workers=2, progress=False)
    assert multiprocessing.active_children() == []
    assert not (tmp_path / "ended").exists()
