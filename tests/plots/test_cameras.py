"""Pictures of camera images with projected lanes and boxes."""

from dataclasses import replace as replaced

import jax
import numpy as np
import pytest

from tests.fakes import fake_elements, fake_example, fake_prediction, fake_views
from tflane_jax.errors import UserError
from tflane_jax.plots.cameras import save_camera_views
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


def test_mismatched_shapes_are_named(tmp_path):
    with pytest.raises(UserError, match=r"ExampleConfig\.cameras"):
        save_camera_views(tmp_path / "a.png", replaced(EXAMPLES, cameras=None))
    with pytest.raises(ValueError, match="'titles': 1"):
        save_camera_views(tmp_path / "a.png", EXAMPLES, titles=["one"])
