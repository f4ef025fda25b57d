"""Comparisons that take no time: a tiny configuration, scores that follow from the parameters, no pictures."""

import jax
import numpy as np
import pytest

from tests.tiny_run import CONFIG
from tflane_jax.evaluation.results import Evaluation
from tflane_jax.tasks.lane_graph import LaneGraphTask


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Return the file of a tiny configuration."""
    path = tmp_path_factory.mktemp("configs") / "tiny.py"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def cheap():
    """Score models by their parameters, so that no two runs have the same scores; draw nothing."""

    def evaluate(task, params, data, config):
        size = float(sum(np.abs(leaf).sum() for leaf in jax.tree.leaves(params)))
        return Evaluation("a protocol", {"all": {"DET_l": 1 / (1 + size), "recall": np.exp(-size)}})

    def draw(self, models, source, data, path):
        path.touch()
        return path

    def draw_curves(path, records, names):
        assert records
        assert names
        path.touch()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LaneGraphTask, "evaluate", evaluate)
        patch.setattr(LaneGraphTask, "draw_comparison", draw)
        patch.setattr("tflane_jax.runs._drawing", lambda *_: None)
        patch.setattr("tflane_jax.ablations.table_run.save_comparison_curves", draw_curves)
        yield
