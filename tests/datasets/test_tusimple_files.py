"""Label files and images of TuSimple in folders of several layouts, and the check of a folder."""

import shutil

import jax
import numpy as np
import pytest

from tests.datasets.small_tusimple import dataset_of, write_tusimple
from tflane_jax.datasets.tusimple import check_tusimple
from tflane_jax.errors import UserError


@pytest.fixture
def root(tmp_path):
    return write_tusimple(tmp_path)


def test_splits_name_their_files(root):
    assert [len(dataset_of(root, split=split)) for split in ("train", "val", "all")] == [2, 2, 4]
    train = dataset_of(root, split="train")
    assert train.name == "tusimple-train"
    assert train.summary() == "tusimple-train: 2 frames of label_data_0313.json; not found: label_data_0601.json"
    assert train.absent_files == ("label_data_0601.json",)
    with pytest.raises(UserError, match=r"lacks the label file test_label.json of split test \(it has label_data_0313"):
        dataset_of(root, split="test")
    shutil.copy(root / "label_data_0531.json", root / "test_label.json")
    test = dataset_of(root, split="test")
    assert (len(test), test.summary()) == (2, "tusimple-test: 2 frames of test_label.json")
    assert len(dataset_of(root, split="all")) == 4  # never the test set
    own = dataset_of(root, label_files=("label_data_0531.json",))
    assert (own.name, own.raw_file(0)) == ("tusimple-custom", "clips/1/0/20.jpg")
    with pytest.raises(UserError, match=r"lacks the label file mine.json of `label_files` .*or correct `label_files`$"):
        dataset_of(root, label_files=("label_data_0531.json", "mine.json"))


def test_a_missing_split_names_the_options_that_take_another(root):
    """Not `label_files`, which no option of the command line sets."""
    with pytest.raises(UserError) as error:
        dataset_of(root, split="test")
    said = str(error.value)
    assert "add it from TuSimple's archive, or choose --split train or val, or set --data.train, --data.val or" in said
    assert (
        "train = label_data_0313.json and label_data_0601.json, val = label_data_0531.json, test = test_label" in said
    )
    assert said.endswith("all = any label_data_*.json)")
    assert "`label_files`" not in said
    for name in ("label_data_0313.json", "label_data_0531.json"):
        (root / name).rename(root / name.replace("0", "9"))
    with pytest.raises(
        UserError, match=r"label_data_0313.json, label_data_0601.json .*: add them .* or set --data.train"
    ):
        dataset_of(root, split="train")


@pytest.mark.parametrize("below", ["", "clips", "clips/0/1"])
def test_another_level_of_the_folder_is_told(root, below):
    if not below:
        (root / "tusimple").mkdir()
        moved(root, "tusimple/own", "clips", "label_data_0313.json", "label_data_0531.json")
    meant = root if below else root / "tusimple" / "own"
    named = root / below if below else root / "tusimple"
    said = rf"{named} holds no label file of TuSimple .*: {meant} does, name that folder$"
    with pytest.raises(UserError, match=said):
        dataset_of(named)
    with pytest.raises(UserError, match=said):
        check_tusimple(named)


def test_a_folder_far_from_label_files_is_told(root):
    (root / "a/b/c/d").mkdir(parents=True)
    with pytest.raises(UserError, match=r"name the folder with label files and clips$"):
        check_tusimple(root / "a/b/c/d")


def test_the_check_takes_absent_splits_for_no_faults(root):
    found = check_tusimple(root)
    assert found.faults == []
    assert [(row["split"], row["frames"]) for row in found.rows] == [("train", 2), ("val", 2)]
    assert found.skipped == [
        "split test: there is no test_label.json",
        "split train: there is no label_data_0601.json",
    ]
    (root / "label_data_0313.json").rename(root / "label_data_mine.json")
    found = check_tusimple(root)
    assert [(row["split"], row["frames"]) for row in found.rows] == [("val", 2), ("all, further files", 2)]
    assert "split train: there is no label_data_0313.json and no label_data_0601.json" in found.skipped
    (root / "clips/0/0/20.jpg").unlink()
    (fault,) = check_tusimple(root).faults
    assert "1 of 2 labelled images are missing" in fault


def moved(root, folder, *names):
    """Move parts of the folder below another one, as an archive is unpacked."""
    (root / folder).mkdir()
    for name in names:
        (root / name).rename(root / folder / name)


@pytest.mark.parametrize("below", ["", "LaneDetection/"])
def test_the_archives_may_have_folders_of_their_own(root, below):
    shutil.copy(root / "label_data_0531.json", root / "test_label.json")
    plain = {split: dataset_of(root, split=split).example(0) for split in ("train", "val", "test")}
    tests = root / below / "test_set"
    shutil.copytree(root / "clips" / "1", tests / "clips" / "1")
    (tests / "test_tasks_0627.json").write_text("")
    moved(root, f"{below}train_set", "clips", "label_data_0313.json", "label_data_0531.json")
    for at_root in (True, False):  # the test labels are a download of their own
        if not at_root:
            (root / "test_label.json").rename(tests / "test_label.json")
        for split, expected in plain.items():
            found = dataset_of(root, split=split)
            jax.tree.map(np.testing.assert_array_equal, found.example(0), expected)
            assert len(found) == 2
    assert len(dataset_of(root, split="all")) == 4
    (tests / "test_label.json").unlink()
    with pytest.raises(UserError, match=r"test_tasks_0627.json names the test images without their lanes\): add it"):
        dataset_of(root, split="test")


def test_lstrs_layout_is_found_from_the_folder_above(root):
    moved(root, "LaneDetection", "clips", "label_data_0313.json", "label_data_0531.json")
    assert [len(dataset_of(root, split=split)) for split in ("train", "val", "all")] == [2, 2, 4]
    assert dataset_of(root).example(3).image.mean() == pytest.approx(120, abs=1)


def test_further_label_files_join_the_whole(root):
    (root / "label_data_0313.json").rename(root / "label_data_mine.json")
    found = dataset_of(root)
    assert [file.name for file in found.label_files] == ["label_data_0531.json", "label_data_mine.json"]
    assert len(found) == 4


def test_mistakes_in_the_folder_are_named(root):
    with pytest.raises(UserError, match=r"no folder .*nowhere"):
        dataset_of(root / "nowhere")
    shutil.copy(root / "label_data_0531.json", root / "label_data_copy.json")
    with pytest.raises(UserError, match=r"label_data_copy.json labels clips/1/0/20.jpg, which an earlier"):
        dataset_of(root)
    (root / "label_data_copy.json").write_text("\n")
    with pytest.raises(UserError, match="no labelled frames"):
        dataset_of(root, label_files=("label_data_copy.json",))
