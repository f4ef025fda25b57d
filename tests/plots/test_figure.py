"""Figures as a notebook shows them."""

import io

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.plots import add_legend, new_figure, style
from tflane_jax.plots.bev import draw_evidence, prepare
from tflane_jax.plots.figure import columns_for, save_figure

pytest.importorskip("matplotlib")
from matplotlib.image import imread


def test_a_notebook_shows_the_colours_of_the_legend():
    """Beside evidence with thousands of colours, which would take nearly all of the 256."""
    figure, axes = new_figure(1, 2, panel=(5.2, 2.9), footer=0.6)
    for ax in axes.flat:
        prepare(ax)
        draw_evidence(ax, (np.random.default_rng(0).random((60, 120, 4)) * 120).astype(np.uint8))
    add_legend(figure)
    shown = np.round(imread(io.BytesIO(figure._repr_png_()))[..., :3] * 255).astype(int)
    for user, colour in style.ROAD_USER.items():
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(shown - rgb).max(-1) <= 1).any(), user


def test_a_notebook_shows_lines_in_their_colours():
    figure, axes = new_figure(panel=(6.0, 3.0))
    for start in range(3):
        axes[0, 0].plot(np.random.default_rng(start).random(9), label=str(start))
    axes[0, 0].legend()
    shown = np.round(imread(io.BytesIO(figure._repr_png_()))[..., :3] * 255).astype(int)
    for colour in style.SERIES[:3]:
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (shown == rgb).all(-1).sum() > 50, colour
    assert (shown[0, 0] == 255).all()


def test_names_with_dollar_signs_and_rare_letters_are_no_formulas(tmp_path):
    """Regression: a photo called a$1_$2.png ended `tflane predict`, a row of that name `tflane compare`."""
    figure, axes = new_figure()
    axes[0, 0].plot([1, 1e5], label=r"($\foo$) 车道")
    axes[0, 0].set_yscale("log")
    axes[0, 0].set_title("a$1_$2.png")
    axes[0, 0].legend()
    assert save_figure(figure, tmp_path / "names.png").stat().st_size > 1000
    assert axes[0, 0].get_yticklabels()[1].get_parse_math()  # powers of ten


def test_curves_of_a_notebook_have_the_colours_of_the_library():
    (ax,) = new_figure()[1].flat
    lines = [ax.plot([0, 1])[0].get_color() for _ in range(2)]
    assert lines == list(style.SERIES[:2])


@pytest.mark.parametrize(("panels", "columns"), [(1, 1), (2, 2), (3, 3), (4, 2), (5, 3), (6, 3), (11, 3)])
def test_no_panel_stands_alone_where_two_rows_can_be_filled(panels, columns):
    assert columns_for(panels) == columns


def test_a_picture_that_is_too_large_is_told(tmp_path):
    """`tflane data show --count 500` ended in matplotlib's traceback."""
    figure, _ = new_figure(300, 1, panel=(2.0, 3.0))
    with pytest.raises(UserError, match=r"pixels is too large; ask for fewer panels"):
        save_figure(figure, tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []
