"""The picture of claims: a line each, with interval, verdict, and what the paper reports."""

import json

import numpy as np
import pytest

from tests.shared import ROOT
from tflane_jax.plots import claims, style
from tflane_jax.plots.claims import save_claims

pytest.importorskip("matplotlib")
from matplotlib.image import imread

HEADINGS = {"t.1": ("t.1: first", ""), "t.2": ("t.2: second", ", interim")}


def claim(**changes):
    made = {"treatment": "A", "control": "B", "verdict": "shown", "measure": "all/DET_l", "difference": 0.0767}
    made |= {"low": 0.0581, "high": 0.0968, "p": 0.001, "paper": [{"difference": 7.7, "measure": "DET_l"}]}
    return made | changes


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Return the figure that `save_claims` would write."""
    figures = []
    monkeypatch.setattr(claims, "save_figure", lambda figure, path: figures.append(figure))

    def draw(*first, **others):
        save_claims(tmp_path / "a.png", {"t.1": first} | others, HEADINGS)
        return figures[-1].axes[0], [text.get_text() for text in figures[-1].legends[0].get_texts()]

    return draw


def test_each_claim_has_a_line_below_the_heading_of_its_table(drawn):
    ax, legend = drawn(claim(), claim(control="C", verdict="not shown"), **{"t.2": [claim(control="D")]})
    assert [label.get_text() for label in ax.get_yticklabels()] == ["", "A vs. B", "A vs. C", "", "A vs. D"]
    assert [text.get_text() for text in ax.texts] == ["t.1: first (all/DET_l)", "t.2: second (all/DET_l), interim"]
    assert legend == ["shown", "not shown", "the paper, on its own data"]


def test_points_and_intervals_are_the_numbers(drawn):
    ax, _ = drawn(claim())
    zero, interval, point, paper = ax.lines
    assert list(zero.get_xdata()) == [0, 0]
    assert list(interval.get_xdata()) == [100 * 0.0581, 100 * 0.0968]
    assert (list(point.get_xdata()), point.get_color()) == ([100 * 0.0767], style.SERIES[2])
    assert list(paper.get_xdata()) == [7.7]


def test_what_is_missing_is_not_drawn(drawn):
    """No interval; a paper's number in another measure; a claim without a number."""
    ax, legend = drawn(
        claim(low=None, high=None, paper=[{"difference": 2.0, "measure": "mAP"}]),
        claim(difference=None),
        **{"t.2": [claim(difference=None)]},
    )
    assert [text.get_text() for text in ax.texts] == ["t.1: first (all/DET_l)"]
    assert len(ax.lines) == 2
    assert legend == ["shown"]


def test_of_several_numbers_of_the_paper_the_one_in_the_measure_is_drawn(drawn):
    several = [{"difference": 0.19, "measure": "DET_l"}, {"difference": 1.17, "measure": "OLS"}]
    ax, _ = drawn(claim(paper=several))
    assert list(ax.lines[-1].get_xdata()) == [0.19]


def test_distances_are_drawn_in_metres(drawn):
    ax, _ = drawn(claim(measure="all/AE_dist", difference=-0.12, low=-0.2, high=-0.1, paper=[]))
    _, interval, point = ax.lines
    assert (list(interval.get_xdata()), list(point.get_xdata())) == ([-0.2, -0.1], [-0.12])


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
        save_claims(path, {name: summary["effects"] for name, summary in found.items()}, headings)
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
    claims = [claim(), claim(verdict="contradicted", difference=-0.01)]
    path = save_claims(tmp_path / "claims.png", {"t.1": claims}, HEADINGS)
    pixels = np.round(imread(path)[..., :3] * 255)
    for colour in (style.SERIES[2], style.SERIES[5]):
        assert (pixels == style.rgb(colour)).all(-1).sum() > 10
