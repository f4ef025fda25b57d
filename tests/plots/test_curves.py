"""Curves of recorded numbers over steps and seeds."""

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.plots.curves import curves, save_curves

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure

RECORDS = [
    {"step": 10, "split": "train", "loss": 9.0, "loss/points": 4.0, "learning_rate": 1e-4, "seconds": 3.0},
    {"step": 20, "split": "train", "loss": 0.1, "loss/points": float("nan"), "learning_rate": 2e-4, "seconds": 6.0},
    {"step": 20, "split": "val", "all/DET_l": [0.1, 0.3], "occluded/DET_l": [0.0, 0.2]},
]


def test_values_are_sorted_by_split_name_step_and_seed():
    series = curves(reversed(RECORDS))
    assert set(series) == {
        ("train", "loss"),
        ("train", "loss/points"),
        ("train", "learning_rate"),
        ("val", "all/DET_l"),
        ("val", "occluded/DET_l"),
    }
    np.testing.assert_array_equal(series["train", "loss"][0], [10, 20])
    np.testing.assert_array_equal(series["train", "loss"][1], [[9.0], [0.1]])
    np.testing.assert_array_equal(series["val", "all/DET_l"][1], [[0.1, 0.3]])


def test_a_panel_holds_a_group_and_a_band_holds_the_seeds(tmp_path, monkeypatch):
    figures = []
    savefig = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), savefig(self, *a, **k)))
    records = [*RECORDS, {"step": 30, "split": "val", "all/DET_l": [0.4, 0.6], "occluded/DET_l": [0.1, 0.3]}]
    assert save_curves(tmp_path / "curves.png", records).stat().st_size > 2000
    drawn = [ax for ax in figures[0].axes if ax.axison]
    assert [ax.get_title(loc="left") for ax in drawn] == [
        "train: loss",
        "train: learning_rate",
        "val: all",
        "val: occluded",
    ]
    assert [line.get_label() for line in drawn[0].lines] == ["loss", "points"]
    assert drawn[0].get_yscale() == "log"
    np.testing.assert_allclose(drawn[2].lines[0].get_ydata(), [0.2, 0.5])
    heights = drawn[2].collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (0.1, 0.6)


@pytest.mark.parametrize("records", [RECORDS[:1], [{"step": 1, "a": float("nan")}]])
def test_a_single_record_is_drawn(tmp_path, records):
    assert save_curves(tmp_path / "curves.png", records).stat().st_size > 2000


@pytest.mark.parametrize("records", [[], [{"step": 1, "split": "train"}]])
def test_no_numbers_is_an_error(tmp_path, records):
    with pytest.raises(UserError, match="no curves to draw"):
        save_curves(tmp_path / "curves.png", records)
