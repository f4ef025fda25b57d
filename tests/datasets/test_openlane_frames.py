"""Which frames a folder of OpenLane-V2 has."""

import json

import pytest

from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_frames import frames_content, list_frames
from tflane_jax.errors import UserError


def listed(root, split, segments, data_dict):
    """Write a split of segments with one frame each, and the split file."""
    for segment in segments:
        path = root / split / segment / "info" / "1.json"
        path.parent.mkdir(parents=True)
        path.touch()
    frames = {split: {segment: ["1.json"] for segment in segments}, "val": {}}
    if data_dict is not None:
        (root / data_dict).write_text(json.dumps(frames))


@pytest.mark.parametrize("data_dict", [None, "data_dict_subset_A.json"])
def test_a_root_with_one_split_names_the_options_that_take_it(tmp_path, data_dict):
    """Regression: "is it OpenLane-V2's folder?" of a folder with the split train alone."""
    listed(tmp_path, "train", ("2", "1"), data_dict)
    assert [key.segment for key in list_frames(tmp_path, "train", "A")] == ["1", "2"]
    for split in ("val", "test"):
        with pytest.raises(UserError, match=r", only of train: choose --split train, or in a run's settings, ") as told:
            list_frames(tmp_path, split, "A")
        assert f"--data.{split} train" in str(told.value)
        assert ("data_dict)" in str(told.value)) == (data_dict is not None)


def test_a_folder_without_frames_is_none_of_openlane_v2(tmp_path):
    with pytest.raises(UserError, match=r"holds no val/<segment>/info/<timestamp>\.json: is it OpenLane-V2's folder"):
        list_frames(tmp_path, "val", "A")


@pytest.mark.parametrize("named", ["above", "root/train", "root/train/1", "root/train/1/info"])
def test_another_level_of_the_folder_is_told(tmp_path, named):
    """Regression: one message, "is it OpenLane-V2's folder?", for every level."""
    root = tmp_path / "above" / "root"
    listed(root, "train", ("1", "2"), None)
    folder = root.parent / named if named != "above" else root.parent
    said = rf"^{folder} holds no \S+/<segment>/info/<timestamp>\.json: OpenLane-V2's folder is {root}, name that$"
    with pytest.raises(UserError, match=said):
        list_frames(folder, "train", "A")
    with pytest.raises(UserError, match=said):
        check_openlane_v2(folder, progress=False)


def test_the_check_of_no_folder_says_so(tmp_path):
    with pytest.raises(UserError, match=r"there is no folder .*none: name OpenLane-V2's"):
        check_openlane_v2(tmp_path / "none", progress=False)


@pytest.mark.parametrize("name", ["first", "9" * 25])
def test_frames_are_named_after_their_times(tmp_path, name):
    (tmp_path / "train" / "00000" / "info").mkdir(parents=True)
    (tmp_path / "train" / "00000" / "info" / f"{name}.json").touch()
    with pytest.raises(UserError, match=rf"frame train/00000/{name} has no whole number of nanoseconds as its"):
        list_frames(tmp_path, "train", "A")


def test_the_folders_of_both_subsets_give_the_frames_of_one(tmp_path):
    listed(tmp_path, "train", ("1", "2", "3"), None)
    for segment, camera in (("1", "ring_front_center"), ("2", "CAM_FRONT")):
        (tmp_path / "train" / segment / "info" / "1.json").write_text(json.dumps({"sensor": {camera: {}}}))
    for subset, segments in (("A", ["1", "3"]), ("B", ["2", "3"])):  # 3 is damaged: reading it names the fault
        assert [key.segment for key in list_frames(tmp_path, "train", subset, "folders")] == segments


def test_the_content_of_a_split_is_its_frames(tmp_path):
    listed(tmp_path, "train", ("1", "2"), "data_dict_subset_A.json")
    before = frames_content(tmp_path, "train", "A")
    assert frames_content(tmp_path, "train", "A") == before
    listed(tmp_path, "train", ("3", "4"), "data_dict_subset_A.json")
    after = frames_content(tmp_path, "train", "A")
    assert after != before
    assert len({before, after, frames_content(tmp_path, "train", "A", "folders")}) == 3
