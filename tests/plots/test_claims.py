"""The picture of claims: a line each, with interval, verdict, and what the paper reports."""

import json

import numpy as np
import pytest

from tests.shared import ROOT
from tflane_jax.ablations.verdicts import verdicts
from tflane_jax.plots import claims, style
from tflane_jax.plots.claims import save_claims

pytest.importorskip("matplotlib")
from matplotlib.image import imread

HEADINGS = {"t.1": ("t.1: first", ""), "t.2": ("t.2: second", ", interim")}


def row(**changes):
    made = {"table": "t.1", "treatment": "A", "control": "B", "verdict": "shown", "difference": "+7.67 points"}
    made |= {"over scenes": "+5.81 to +9.68", "in": "all/DET_l", "p": "0.001", "the paper": "+7.7 DET_l"}
    return made | changes


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Return the figure that `save_claims` would write."""
    figures = []
    monkeypatch.setattr(claims, "save_figure", lambda figure, path: figures.append(figure))

    def draw(rows):
        save_claims(tmp_path / "a.png", rows, HEADINGS)
        return figures[-1].axes[0], [text.get_text() for text in figures[-1].legends[0].get_texts()]

    return draw


def test_each_claim_has_a_line_below_the_heading_of_its_table(drawn):
    ax, legend = drawn([row(), row(control="C", verdict="not shown"), row(table="t.2", control="D")])
    assert [label.get_text() for label in ax.get_yticklabels()] == ["", "A vs. B", "A vs. C", "", "A vs. D"]
    assert [text.get_text() for text in ax.texts] == ["t.1: first (all/DET_l)", "t.2: second (all/DET_l), interim"]
    assert legend == ["shown", "not shown", "the paper, on its own data"]


def test_points_and_intervals_are_the_numbers(drawn):
    ax, _ = drawn([row()])
    zero, interval, point, paper = ax.lines
    assert list(zero.get_xdata()) == [0, 0]
    assert list(interval.get_xdata()) == [5.81, 9.68]
    assert (list(point.get_xdata()), point.get_color()) == ([7.67], style.SERIES[2])
    assert list(paper.get_xdata()) == [7.7]


def test_what_is_missing_is_not_drawn(drawn):
    """No interval; a paper's number in another measure; a claim without a number."""
    ax, legend = drawn([row(**{"over scenes": None, "the paper": "+2.0 mAP"}), row(difference=None)])
    assert len(ax.lines) == 2
    assert legend == ["shown"]


def test_of_several_numbers_of_the_paper_the_one_in_the_measure_is_drawn(drawn):
    ax, _ = drawn([row(**{"the paper": "+0.19 DET_l, +1.17 OLS"})])
    assert list(ax.lines[-1].get_xdata()) == [0.19]


def test_long_headings_keep_their_measure_and_end_in_the_picture():
    """Regression: two of them ran over the picture's edge."""
    path = ROOT / "docs" / "results"
    found = {name.stem: json.loads(name.read_text()) for name in path.glob("tf_lane*.json")}
    headings = {
        name: (f"{name}: {summary['title']}", ", interim: 1 to 2 of 5 seeds") for name, summary in found.items()
    }
    figures = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(claims, "save_figure", lambda figure, path: figures.append(figure))
        save_claims(path, verdicts(found), headings)
    (figure,) = figures
    figure.canvas.draw()
    (ax,) = figure.axes
    right = ax.get_window_extent().x1
    assert all(text.get_window_extent().x1 < right for text in ax.texts)
    assert all(
        text.get_text().endswith(("recall), interim: 1 to 2 of 5 seeds", "mAP), interim: 1 to 2 of 5 seeds"))
        for text in ax.texts
    )


def test_the_picture_is_written(tmp_path):
    path = save_claims(
        tmp_path / "claims.png", [row(), row(verdict="contradicted", difference="-1.00 points")], HEADINGS
    )
    pixels = np.round(imread(path)[..., :3] * 255)
    for colour in (style.SERIES[2], style.SERIES[5]):
        assert (pixels == style.rgb(colour)).all(-1).sum() > 10
