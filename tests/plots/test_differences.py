"""Outlined lanes, and the picture of what several models find."""

import numpy as np
import pytest

from tests.fakes import LANES, empty_example, fake_example, fake_prediction
from tests.plots.pictures import count_colours
from tflane_jax.plots import differences
from tflane_jax.plots.differences import Findings, band, draw_outlines, save_differences
from tflane_jax.plots.figure import new_figure
from tflane_jax.scene import stack_examples

pytest.importorskip("matplotlib")
from matplotlib.image import imread


def test_band_of_a_straight_and_of_a_standing_line():
    line = np.array([[0.0, 1.0], [2.0, 1.0], [4.0, 1.0]])
    np.testing.assert_allclose(band(line, 0.5), [[0, 0.5], [2, 0.5], [4, 0.5], [4, 1.5], [2, 1.5], [0, 1.5]])
    np.testing.assert_allclose(band(np.ones((2, 2)), 0.5), np.ones((4, 2)))


def test_band_of_a_bend_keeps_its_distance():
    angle = np.linspace(0.0, 2.0, 40)
    circle = 10.0 * np.stack([np.cos(angle), np.sin(angle)], -1)  # turns left
    right, left = np.split(np.linalg.norm(band(circle, 1.5), axis=-1), 2)
    np.testing.assert_allclose(right, 11.5, atol=1e-2)
    np.testing.assert_allclose(left, 8.5, atol=1e-2)


@pytest.mark.parametrize(
    ("outline", "alpha", "dashed"), [("edge", 0, False), ("filled", 0.3, False), ("dashed", 0, True)]
)
def test_outlines(outline, alpha, dashed):
    ax = new_figure()[1][0, 0]
    draw_outlines(ax, np.asarray(fake_example().lanes.points[:2]), outline)
    (collection,) = ax.collections
    assert len(collection.get_paths()) == 2
    assert collection.get_facecolor()[0, 3] == pytest.approx(alpha)
    assert (collection.get_linestyle()[0][1] is not None) == dashed


def test_no_outlines():
    draw_outlines(new_figure()[1][0, 0], np.zeros((0, 4, 3)))


def test_long_names_of_models_are_wrapped_above_their_panels(tmp_path, monkeypatch):
    """Regression: the last panel's title ran out of the picture."""
    titles = []
    monkeypatch.setattr(
        differences,
        "save_figure",
        lambda figure, path: titles.extend(ax.get_title(loc="left") or ax.get_title() for ax in figure.axes),
    )
    models = {"m": findings(FIRST), "a model with markers that are read from images": findings(BOTH)}
    save_differences(tmp_path / "a.png", EXAMPLES, models, BOTH, title="t", caption="c", titles=["a", "b"])
    long = [title for title in titles if "markers" in title and "finds" in title]
    assert len(long) == 2
    assert all(len(line) <= 52 for title in long for line in title.splitlines())
    assert " ".join(long[0].split()) == "a model with markers that are read from images: finds 2 of 2 outlined"


def findings(found, threshold=0.3):
    return Findings(stack_examples([fake_prediction(0), fake_prediction(1)]), threshold, found)


EXAMPLES = stack_examples([fake_example(0, padding=np.nan), empty_example()])
NONE = np.zeros((2, LANES), bool)
FIRST, BOTH = NONE.copy(), NONE.copy()
FIRST[0, 0] = BOTH[0, :2] = True


@pytest.mark.parametrize("count", [1, 3])
def test_one_row_for_each_example_and_one_column_for_each_model(tmp_path, count):
    models = {f"model {i}": findings(FIRST) for i in range(count)}
    path = save_differences(tmp_path / "a.png", EXAMPLES, models, BOTH, title="t", caption="c", titles=["a", "b"])
    assert imread(path).shape[1] == (2 + count) * 440
    assert count_colours(path) > 100


def test_outlines_tell_found_lanes_from_missed_ones(tmp_path, monkeypatch):
    drawn, shown = [], []
    monkeypatch.setattr(differences, "draw_outlines", lambda ax, lanes, kind="edge": drawn.append((kind, len(lanes))))
    monkeypatch.setattr(differences, "draw_found", lambda *_, threshold, **__: shown.append(threshold))
    models = {"one": findings(FIRST, 0.2), "none": findings(NONE, 0.4)}
    save_differences(tmp_path / "a.png", EXAMPLES, models, BOTH, title="t", titles=["a", "b"])
    first_row, second_row = drawn[:6], drawn[6:]
    assert first_row == [("edge", 2), ("edge", 2), ("filled", 1), ("dashed", 1), ("filled", 0), ("dashed", 2)]
    assert {number for _, number in second_row} == {0}
    assert shown == [0.2, 0.4] * 2
