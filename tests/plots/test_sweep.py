"""Scores of several models over a setting."""

import numpy as np
import pytest

from tflane_jax.plots.names import score_title
from tflane_jax.plots.sweep import save_sweep

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure

SCORES = {"gated": [[{"r": 0.5}, {"r": 0.7}], [{"r": 0.4}, {"r": 0.4}]], "hard": [[{"r": 0.3}], [{"r": 0.2}]]}


def test_scores_are_named_in_words():
    assert score_title("all/DET_l") == "DET_l"
    assert score_title("gap/recall") == "recall, gap after a board"
    assert score_title("lines hidden+traffic/recall") == "recall, hidden lines driven along"
    assert score_title("some group/r") == "some group/r"
    assert score_title("r") == "r"


@pytest.mark.parametrize("values", [("0", "0.25"), ("rain", "fog")])
def test_bands_and_seeds_are_explained(tmp_path, monkeypatch, values):
    saved, savefig = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (saved.append(self), savefig(self, *a, **k)))
    path = save_sweep(tmp_path / "sweep.png", SCORES, "data.world.severity", values, ["r"], meaning="how hard")
    assert path.stat().st_size > 2000
    (ax,) = saved[0].axes
    assert (ax.get_title(loc="left"), ax.get_xlabel()) == ("r, percent", "data.world.severity\nhow hard")
    np.testing.assert_allclose([line.get_ydata() for line in ax.lines], [[60, 40], [30, 20]])
    (legend,) = saved[0].legends
    assert [text.get_text() for text in legend.get_texts()] == ["gated (2 seeds)", "hard (1 seed)"]
    assert "one standard deviation" in legend.get_title().get_text()


def test_values_are_joined_in_order_and_distances_are_metres(tmp_path, monkeypatch):
    saved, savefig = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (saved.append(self), savefig(self, *a, **k)))
    scores = {"model": [[{"all/AE_dist": value}] for value in (0.8, 1.2, 0.9)]}
    save_sweep(tmp_path / "sweep.png", scores, "data.world.severity", ("0", "1", "0.5"), ["all/AE_dist"])
    (ax,) = saved[0].axes
    assert ax.get_title(loc="left") == "AE_dist, m"
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [[0, 0.8], [0.5, 0.9], [1, 1.2]])
