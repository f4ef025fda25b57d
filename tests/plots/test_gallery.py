"""Galleries of examples and models, and saving of pictures."""

import sys

import numpy as np
import pytest

from tests.fakes import empty_example, fake_example, fake_prediction
from tests.plots.pictures import count_colours
from tflane_jax.errors import UserError
from tflane_jax.plots.figure import hide_unused, new_figure, save_figure
from tflane_jax.plots.gallery import label_edges, save_contact_sheet, save_examples
from tflane_jax.scene import stack_examples

pytest.importorskip("matplotlib")
from matplotlib.image import imread

EXAMPLES = stack_examples([fake_example(0, padding=np.nan), empty_example()])
PREDICTIONS = stack_examples([fake_prediction(0), fake_prediction(1)])


def sheet(path, count):
    return save_contact_sheet(path, [fake_example(n) for n in range(count)], [f"{n}" for n in range(count)])


def test_one_row_for_each_example_and_one_column_for_each_model(tmp_path):
    alone = save_examples(tmp_path / "new" / "alone.png", EXAMPLES)
    both = save_examples(
        tmp_path / "both.png", EXAMPLES, {"baseline": PREDICTIONS, "+TFM": PREDICTIONS}, titles=["a", "b"]
    )
    assert count_colours(alone) > 100
    assert imread(both).shape[1] == 2 * imread(alone).shape[1]
    assert imread(both).shape[0] == imread(alone).shape[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["both.png", "new"]


def test_sizes_that_do_not_fit_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"2 examples, but .*'baseline': 1"):
        save_examples(tmp_path / "a.png", EXAMPLES, {"baseline": stack_examples([fake_prediction()])})
    with pytest.raises(ValueError, match="'titles': 1"):
        save_examples(tmp_path / "a.png", EXAMPLES, titles=["only one"])


@pytest.mark.slow
def test_many_models_take_further_lines(tmp_path):
    one_line, two_lines = (
        imread(save_examples(tmp_path / f"{count}.png", EXAMPLES, {f"{n}": PREDICTIONS for n in range(count)})).shape
        for count in (4, 9)
    )
    assert two_lines[1] == one_line[1]  # 11 panels in lines of six
    assert two_lines[0] > 1.7 * one_line[0]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_contact_sheet_has_one_example_or_pairs_in_a_row(tmp_path, count):
    shape = imread(sheet(tmp_path / "sheet.png", count)).shape
    pair = imread(sheet(tmp_path / "pair.png", 2)).shape
    assert count_colours(tmp_path / "sheet.png") > 100
    assert (shape[1] == pair[1]) == (count > 1)
    assert (shape[0] > pair[0]) == (count == 3)


def test_titles_and_legend_of_a_single_row_are_not_cut_off(tmp_path):
    one = stack_examples([fake_example(0)]), {"model": stack_examples([fake_prediction(0)])}
    for picture in (
        sheet(tmp_path / "one.png", 1),
        sheet(tmp_path / "two.png", 2),
        save_examples(tmp_path / "model.png", *one),
    ):
        pixels = imread(picture)[..., :3]
        assert pixels[0].min() == pixels[-1].min() == 1.0, picture.name


def test_the_lowest_panel_of_each_column_has_labels():
    """Of three examples in two columns, the second had none: the panel below it is blank."""
    _, axes = new_figure(2, 4)
    hide_unused(axes, 6)
    label_edges(axes)
    assert [bool(ax.get_xlabel()) for ax in axes.flat] == [False, False, True, True, True, True, False, False]
    ticks = [ax.xaxis.get_tick_params()["labelbottom"] for ax in axes.flat[:6]]
    assert ticks == [False, False, True, True, True, True]


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match=r"pictures need matplotlib: run `pip install -e '\.\[plot\]'`"):
        new_figure()


def test_a_failed_save_keeps_the_old_picture(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    figure, _ = new_figure()
    monkeypatch.setattr(figure, "savefig", lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(UserError, match=r"a\.png: disk full"):
        save_figure(figure, path)
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1
