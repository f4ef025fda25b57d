"""TuSimple's label files: what a score is of, and images that they may not name."""

import json

import pytest

from tflane_jax.datasets.tusimple import SOURCE, TuSimpleConfig, TuSimpleDataset
from tflane_jax.errors import UserError


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
