"""Pictures of the lines of a vector map, from above and in the cameras."""

import numpy as np
import pytest

from tests.fakes import fake_example, fake_views
from tests.plots.pictures import count_colours
from tflane_jax.plots import Findings, save_camera_views, save_differences, save_examples, style
from tflane_jax.plots.bev import draw_found, draw_scene
from tflane_jax.plots.cameras import draw_camera
from tflane_jax.plots.figure import new_figure
from tflane_jax.plots.map_lines import chosen_lines, draw_map_lines
from tflane_jax.scene import LineClass, LinePrediction, MapLines, stack_examples

collections = pytest.importorskip("matplotlib.collections")
colors = pytest.importorskip("matplotlib.colors")


def labelled(padding=0.0):
    """Return an example with one line of each class ahead of the vehicle, and padding."""
    lines = MapLines.empty(6, 5)
    lines.points[:] = padding
    for row, y in enumerate((0.0, 2.0, 4.0, -3.0)):
        lines.points[row] = np.linspace((3.0, y, 0.0), (20.0, y, 0.0), 5)
    lines.points[1] = [[5, 2, 0], [8, 2, 0], [8, 5, 0], [5, 5, 0], [5, 2, 0]]
    lines.category[:4], lines.valid[:4] = list(LineClass), True
    return fake_example().replace(map_lines=lines, cameras=fake_views())


def prediction(heights="with"):
    lines = labelled().map_lines
    logits = np.where(np.eye(6, 4) > 0, 2.0, -4.0)
    logits[2, 3] = 1.0  # a boundary that may be a centerline
    return LinePrediction(lines.points if heights == "with" else lines.points[..., :2], logits)


def drawn(ax):
    """Return how many lines or shapes the axes have by colour."""
    counts = {}
    for item in ax.collections:
        is_lines = isinstance(item, collections.LineCollection)
        colour = item.get_color() if is_lines else item.get_edgecolor()
        for one in np.atleast_2d(colour)[: len(item.get_paths())]:
            name = colors.to_hex(one)
            counts[name] = counts.get(name, 0) + (1 if len(colour) > 1 or not is_lines else len(item.get_paths()))
    return counts


@pytest.mark.parametrize("padding", [0.0, np.nan])
def test_every_class_has_its_colour_and_padding_is_not_drawn(padding):
    ax = new_figure()[1][0, 0]
    draw_map_lines(ax, labelled(padding).map_lines)
    found = drawn(ax)
    assert set(found) >= set(style.MAP_LINE.values())
    assert all(found[colour] == 1 for kind, colour in style.MAP_LINE.items() if kind != LineClass.CENTERLINE)
    assert len(set(style.MAP_LINE.values())) == 4


def test_a_query_is_drawn_in_each_class_that_it_is_sure_of():
    for heights in ("with", "without"):
        points, category, scores = chosen_lines(prediction(heights), 0.6)
        assert category.tolist() == [0, 1, 2, 3, 3]
        assert points.shape == (5, 5, 3)
        assert scores.min() > 0.6
    assert len(chosen_lines(prediction(), 0.95)[0]) == 0


def test_scenes_and_predictions_show_lines_over_their_truth():
    truth, found, without = (new_figure()[1][0, 0] for _ in range(3))
    draw_scene(truth, labelled(), layers=("map_lines",))
    assert set(style.MAP_LINE.values()) <= set(drawn(truth))
    draw_found(found, labelled(), prediction())
    assert drawn(found)[colors.to_hex("white")] >= 4
    draw_scene(without, labelled().replace(map_lines=None), layers=("map_lines",))
    assert not set(style.MAP_LINE.values()) & set(drawn(without))


def test_cameras_show_predictions_by_class_over_a_thin_truth():
    truth, found = (new_figure()[1][0, 0] for _ in range(2))
    draw_camera(truth, labelled(), 0)
    assert set(style.MAP_LINE.values()) <= set(drawn(truth))
    draw_camera(found, labelled(), 0, prediction("without"))
    assert {*style.MAP_LINE.values(), colors.to_hex("white")} <= set(drawn(found))


def test_pages_are_written(tmp_path):
    examples = stack_examples([labelled(), labelled()])
    lines = stack_examples([prediction(), prediction()])
    page = save_examples(tmp_path / "a.png", examples, {"model": lines})
    cameras = save_camera_views(tmp_path / "b.png", examples, lines)
    outlined = np.zeros((2, 6), bool)
    outlined[:, 0] = True
    findings = {"model": Findings(lines, 0.5, outlined)}
    differences = save_differences(tmp_path / "c.png", examples, findings, outlined, title="t", titles=["a", "b"])
    for path in (page, cameras, differences):
        assert count_colours(path) > 100
