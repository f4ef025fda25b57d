"""Curves of recorded numbers over steps and seeds."""

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.plots.curves import bands, curves, save_comparison_curves, save_curves

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


@pytest.fixture
def figures(monkeypatch):
    """The figures that were saved."""
    saved, savefig = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (saved.append(self), savefig(self, *a, **k)))
    return saved


def test_a_panel_holds_a_group_and_a_band_holds_the_seeds(tmp_path, figures):
    records = [*RECORDS, {"step": 30, "split": "val", "all/DET_l": [0.4, 0.6], "occluded/DET_l": [0.1, 0.3]}]
    assert save_curves(tmp_path / "curves.png", records).stat().st_size > 2000
    drawn = [ax for ax in figures[0].axes if ax.axison]
    assert [ax.get_title(loc="left") for ax in drawn] == [
        "train: loss",
        "val: all",
        "val: occluded",
        "train: learning_rate",
    ]
    assert [line.get_label() for line in drawn[0].lines] == ["loss", "points"]
    assert drawn[0].get_yscale() == "log"
    np.testing.assert_allclose(drawn[1].lines[0].get_ydata(), [0.2, 0.5])
    heights = drawn[1].collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (0.1, 0.6)
    assert figures[0].get_supxlabel() == "line: mean over 2 seeds; band: from the least to the greatest"


def test_legends_lie_beside_the_curves(tmp_path, figures):
    names = [f"loss/{name}" for name in "abcdefghi"]
    save_curves(tmp_path / "curves.png", [{"step": 1, "split": "train"} | dict.fromkeys(names, 1.0)])
    (ax,) = figures[0].axes
    assert ax.get_legend().get_window_extent().x0 >= ax.get_window_extent().x1
    assert len(ax.get_legend().get_texts()) == 9


def test_errors_and_losses_do_not_squeeze_the_scores(tmp_path, figures):
    record = {"all/AP_ls": 0.1, "all/AE_dist": 1.2, "all/AE_type": 0.4, "all/loss": 30.0, "clear/AP_ls": 0.2}
    save_curves(tmp_path / "curves.png", [{"step": 1, "split": "val"} | record])
    panels = {ax.get_title(loc="left"): [str(line.get_label()) for line in ax.lines] for ax in figures[0].axes}
    assert panels == {
        "val: all": ["AP_ls"],
        "val: all, errors (lower is better)": ["AE_dist", "AE_type"],
        "val: all, loss": ["loss"],
        "val: clear": ["AP_ls"],
    }


def test_a_score_has_one_colour_in_all_panels_and_zero_is_at_the_bottom(tmp_path, figures):
    record = {"all/AP": 0.1, "all/recall": 0.5, "clear/recall": 0.6, "hidden/recall": 0.0}
    save_curves(tmp_path / "curves.png", [{"step": step, "split": "val"} | record for step in (1, 2)])
    recall = [line.get_color() for ax in figures[0].axes for line in ax.lines if line.get_label() == "recall"]
    assert len(recall) == 3
    assert len(set(recall)) == 1
    (hidden,) = [ax for ax in figures[0].axes if ax.get_title(loc="left") == "val: hidden"]
    assert hidden.get_ylim() == (0.0, 1.0)


def test_scores_have_a_linear_axis_and_those_of_single_thresholds_are_left_out(tmp_path, figures):
    low, high = ({"all/recall": v, "all/recall@1.0": v} for v in (0.001, 0.5))
    save_curves(tmp_path / "curves.png", [{"step": 1, "split": "val"} | low, {"step": 2, "split": "val"} | high])
    (ax,) = figures[0].axes
    assert ax.get_yscale() == "linear"
    assert [line.get_label() for line in ax.lines] == ["recall"]
    assert all(tick == round(tick) for tick in ax.get_xticks())


def test_a_model_has_one_colour_in_all_panels(tmp_path, figures):
    lanes, segments = ([[{"step": 1, "split": "val"} | scores]] for scores in ({"a": 1.0, "b": 0.001}, {"b": 0.5}))
    save_comparison_curves(tmp_path / "curves.png", {"segments": segments, "lanes": lanes}, ["a", "b"])
    first, second = figures[0].axes
    assert second.get_title(loc="left") == "validation: b, percent"
    np.testing.assert_allclose(second.lines[1].get_ydata(), [0.1, 0.1])
    colours = {line.get_label(): line.get_color() for line in second.lines}
    assert len(set(colours.values())) == 2
    assert first.lines[0].get_color() == colours["lanes"]
    (legend,) = figures[0].legends
    assert legend.get_title().get_text() == "bar: mean; points: runs"
    texts = [text.get_text() for text in legend.get_texts()]
    assert sorted(texts) == ["lanes (1 run)", "segments (1 run)"]
    shown = dict(zip([text.partition(" (")[0] for text in texts], legend.get_lines(), strict=True))
    assert {name: line.get_color() for name, line in shown.items()} == colours
    assert legend.get_window_extent().y1 <= second.get_window_extent().y0


def test_a_seed_that_becomes_infinite_leaves_the_others_in_the_panel(tmp_path, figures):
    values = [[1.0, 2.0], [1.5, 2.0], [1.0, np.inf], [3.0, np.nan], [np.inf, np.nan]]
    records = [{"step": step, "split": "train", "loss": value} for step, value in enumerate(values)]
    save_curves(tmp_path / "curves.png", records)
    (ax,) = figures[0].axes
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), [1.5, 1.75, np.nan, np.nan, np.nan])
    heights = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (1.0, 3.0)
    assert 3.0 < ax.get_ylim()[1] < 4.0


@pytest.mark.parametrize(
    ("values", "marked"),
    [([1.0], [True]), ([np.nan, 1.0, np.inf], [False, True, False]), ([1.0, 2.0, np.nan, 1.0], [False] * 3 + [True])],
)
def test_a_step_without_neighbours_has_a_marker(tmp_path, figures, values, marked):
    save_curves(tmp_path / "curves.png", [{"step": step, "loss": value} for step, value in enumerate(values)])
    (line,) = figures[0].axes[0].lines
    assert (line.get_marker(), line.get_markevery()) == ("o", marked)


def test_long_titles_stay_within_their_panels(tmp_path, figures):
    names = ["hidden-traffic/recall", "hidden-neighbours/recall", "all/AP"]
    save_comparison_curves(
        tmp_path / "a.png", {"a": [[{"split": "val", "step": 5} | dict.fromkeys(names, 0.5)]]}, names
    )
    first, second, third = figures[0].axes
    for ax, end in ((first, second.get_window_extent().x0), (second, third.get_window_extent().x0)):
        assert ax._left_title.get_window_extent().x1 < end


@pytest.mark.parametrize("steps", [(5,), (5, 9)])
def test_models_that_were_validated_once_are_points_and_not_curves(tmp_path, figures, steps):
    def run(value):
        return [{"split": "val", "step": step, "all/recall": value} for step in steps]

    save_comparison_curves(tmp_path / "curves.png", {"a": [run(0.2), run(0.4)], "b": [run(0.5)]}, ["all/recall"])
    (ax,), (legend,) = figures[0].axes, figures[0].legends
    once = len(steps) == 1
    assert ax.get_xlabel() == ("after 5 steps" if once else "step")
    assert legend.get_title().get_text() == ("bar: mean; points: runs" if once else bands("runs"))
    np.testing.assert_allclose([line.get_ydata()[0] for line in ax.lines], [30.0, 50.0])
    if once:
        points = [collection.get_offsets().tolist() for collection in ax.collections]
        np.testing.assert_allclose(points[0] + points[1], [[0, 20], [0, 40], [1, 50]])


def test_more_models_than_colours_are_told_apart_by_their_lines(tmp_path, figures):
    records = {f"model {i}": [[{"split": "val", "step": 5, "all/recall": 0.5}]] for i in range(11)}
    save_comparison_curves(tmp_path / "curves.png", records, ["all/recall"])
    lines = figures[0].axes[0].lines
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 11


@pytest.mark.parametrize("records", [RECORDS[:1], [{"step": 1, "a": float("nan")}]])
def test_a_single_record_is_drawn(tmp_path, records):
    assert save_curves(tmp_path / "curves.png", records).stat().st_size > 2000


@pytest.mark.parametrize("records", [[], [{"step": 1, "split": "train"}]])
def test_no_numbers_is_an_error(tmp_path, records):
    with pytest.raises(UserError, match="no curves to draw"):
        save_curves(tmp_path / "curves.png", records)
