"""TuSimple's label files: what a score is of, and images that they may not name."""

import json

import numpy as np
import pytest

from tflane_jax.datasets.lane_rows import lane_lines
from tflane_jax.datasets.tusimple import SOURCE, TuSimpleConfig, TuSimpleDataset
from tflane_jax.errors import UserError
from tflane_jax.files.tusimple import NO_POINT, ROWS, RowLanes


def test_scores_are_of_the_labels_that_were_there(tmp_path):
    def content(split="all"):
        return SOURCE.content(TuSimpleConfig(str(tmp_path), split))

    for name in ("label_data_0313.json", "label_data_0531.json"):
        (tmp_path / name).write_text(f"{name}\n")
    whole, val = content(), content("val")
    assert content() == whole != val
    (tmp_path / "label_data_0313.json").write_text("edited\n")
    assert content() != whole
    assert content("val") == val
    edited = content()
    (tmp_path / "label_data_9999.json").write_text("")
    assert content() != edited


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/secret.jpg"])
def test_images_outside_of_the_folder_are_not_read(tmp_path, name):
    record = {"raw_file": name, "lanes": [[100, -2]], "h_samples": [700, 710]}
    (tmp_path / "label_data_0313.json").write_text(json.dumps(record))
    with pytest.raises(UserError, match=r"0313\.json: raw_file: .*secret\.jpg' is not within the folder"):
        TuSimpleDataset(TuSimpleConfig(str(tmp_path)))


def test_lines_are_sorted_by_their_first_points_and_reach_the_border():
    """One from 600 pixels down to the left border, where x is 0, and one from 500 pixels to the right."""
    left, right = np.linspace(660.0, 0.0, len(ROWS)), np.linspace(500.0, 900.0, len(ROWS))
    left[:5] = NO_POINT
    lines = lane_lines(RowLanes(np.stack([left, right]), ROWS), height=720, width=1280, capacity=2)
    np.testing.assert_allclose(lines.points[:, -1, 0] * 1280, [900.0, 0.0], atol=1e-3)
    assert lines.point_valid[:, -1].all()
