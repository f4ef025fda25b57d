"""Lines and boxes in a camera's image."""

import numpy as np
import pytest

from tests.fakes import fake_views
from tflane_jax.geometry.cameras import project
from tflane_jax.plots.figure import new_figure
from tflane_jax.plots.projection import draw_boxes, draw_projected

pytest.importorskip("matplotlib")


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
