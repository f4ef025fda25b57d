"""Pictures of camera images with projected lanes and boxes."""

from dataclasses import replace as replaced

import jax
import numpy as np
import pytest

from tests.fakes import fake_elements, fake_example, fake_prediction, fake_views
from tflane_jax.errors import UserError
from tflane_jax.geometry.cameras import project
from tflane_jax.plots.cameras import draw_boxes, draw_projected, save_camera_views
from tflane_jax.plots.figure import new_figure
from tflane_jax.scene import stack_examples

pytest.importorskip("matplotlib")
from matplotlib.image import imread

EXAMPLES = stack_examples([fake_example(seed, padding=np.nan).replace(cameras=fake_views(seed)) for seed in (0, 1)])
LANES = jax.tree.map(lambda *leaves: np.stack(leaves), fake_prediction(0), fake_prediction(1))
ELEMENTS = jax.tree.map(lambda *leaves: np.stack(leaves), fake_elements(0), fake_elements(1))


def test_two_rows_for_each_example_with_truth_or_predictions(tmp_path):
    truth = imread(save_camera_views(tmp_path / "truth.png", EXAMPLES))
    one = imread(save_camera_views(tmp_path / "one.png", jax.tree.map(lambda leaf: leaf[:1], EXAMPLES)))
    found = imread(save_camera_views(tmp_path / "found.png", EXAMPLES, LANES, ELEMENTS, titles=["a", "b"]))
    assert truth.shape[1:] == found.shape[1:]
    assert 0 < 2 * one.shape[0] - truth.shape[0] < 80  # both have one legend
    assert 0 < truth.shape[0] - found.shape[0] < 60  # of predictions, the legend has fewer entries
    assert (truth[: one.shape[0]] != found[: one.shape[0]]).any()


def test_drawn_lines_match_the_projection():
    """Every drawn piece ends on the projection of the line, and what lies behind the camera is left out."""
    views = fake_views()
    _, axes = new_figure()
    line = np.stack([np.linspace(-30.0, 30.0, 11), np.full(11, 1.0), np.zeros(11)], -1)
    draw_projected(axes[0, 0], views, 0, line[None])
    (collection,) = axes[0, 0].collections
    drawn = np.concatenate(collection.get_segments())
    dense = np.stack([np.linspace(-30.0, 30.0, 201), np.full(201, 1.0), np.zeros(201)], -1)
    pixels, depth, _ = project(dense, views.intrinsics[0].astype(float), views.camera_from_ego[0].astype(float))
    pixels = pixels[depth > 0.5]
    nearest = np.linalg.norm(drawn[:, None] - pixels, axis=-1).min(1)
    assert len(drawn) > 10
    assert nearest.max() < 1e-3


def test_only_chosen_boxes_are_drawn():
    _, axes = new_figure()
    box = np.array([[[1.0, 2.0], [4.0, 8.0]], [[5.0, 5.0], [6.0, 6.0]]])
    draw_boxes(axes[0, 0], box, np.array([1, 4]), np.array([True, False]))
    (patch,) = axes[0, 0].patches
    assert (patch.get_xy(), patch.get_width(), patch.get_height()) == ((1.0, 2.0), 3.0, 6.0)
    assert [text.get_text() for text in axes[0, 0].texts] == ["red"]


def test_mismatched_shapes_are_named(tmp_path):
    with pytest.raises(UserError, match=r"ExampleConfig\.cameras"):
        save_camera_views(tmp_path / "a.png", replaced(EXAMPLES, cameras=None))
    with pytest.raises(ValueError, match="'titles': 1"):
        save_camera_views(tmp_path / "a.png", EXAMPLES, titles=["one"])
