"""Faults and counts that the check of an OpenLane-V2 folder reports."""

import json
import re
import shutil

import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tflane_jax.cli import main
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.errors import UserError


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("openlane") / "made"
    return export_openlane_v2({"train": DriveDataset(DriveConfig(scenes=1))}, out, progress=False)


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def frame(folder, number=1, suffix=""):
    return sorted((folder / "train" / "01000" / "info").glob("*[0-9].json"))[number].with_suffix("").as_posix() + (
        f"{suffix}.json"
    )


def change(path, function):
    with open(path) as file:
        content = json.load(file)
    function(content)
    with open(path, "w") as file:
        json.dump(content, file)


def test_a_whole_folder_is_counted(whole):
    found = check_openlane_v2(whole, progress=False)
    assert found.faults == []
    assert found.subset == "B"
    assert found.rows == [
        {
            "split": "train",
            "segments": 1,
            "frames": FRAMES,
            "-ls files": FRAMES,
            "images": 6 * FRAMES,
            "lanes": 3 * FRAMES,
            "lane segments": 3 * FRAMES,
            "elements": 2 * FRAMES,
            "areas": FRAMES,
            "faults": 0,
        }
    ]


def set_rotation(content):
    content["pose"]["rotation"][0][0] = 2.0


def far(content):
    content["pose"]["translation"][0] += 1000.0


def turn_round(content):
    front = content["sensor"]["CAM_FRONT"]["extrinsic"]
    front["rotation"] = [list(row) for row in zip(*front["rotation"], strict=True)]


def annotate(**entries):
    def function(content):
        content["annotation"] |= entries

    return function


def element(**entries):
    def function(content):
        content["annotation"]["traffic_element"][0] |= entries

    return function


@pytest.mark.parametrize(
    ("suffix", "function", "said"),
    [
        ("", set_rotation, "pose.rotation is no rotation"),
        ("", far, "is 1002 m from where it was"),
        ("", turn_round, "CAM_FRONT does not look ahead"),
        ("", lambda content: content.pop("pose"), "lacks the entry 'pose'"),
        ("", lambda content: content.pop("annotation"), "has no annotation"),
        ("", lambda content: content["sensor"].update(CAM_ROOF={}), "camera 'CAM_ROOF' is none of subset B"),
        ("", annotate(topology_lclc=[[0, 1], [0, 0]]), r"topology_lclc has shape \(2, 2\), expected \(3, 3\)"),
        ("", annotate(topology_lcte=[[0, 2]] * 3), "topology_lcte holds 2, expected 0 and 1 only"),
        ("", element(attribute=13), "attribute is 13, expected a whole number from 0 to 12"),
        ("", element(attribute=7), "attribute does not fit its category"),
        ("", element(points=[[14, 12], [10, 4]]), "box has no area"),
        ("-ls", annotate(topology_lsls=[]), "topology_lsls"),
        ("-ls", lambda content: content["annotation"]["area"][0].update(category=3), "whole number from 1 to 2"),
        ("-ls", lambda content: content["annotation"]["lane_segment"][0].pop("left_laneline"), "lacks the entry"),
    ],
)
def test_a_damaged_frame_is_named(folder, suffix, function, said):
    path = frame(folder, suffix=suffix)
    change(path, function)
    found = check_openlane_v2(folder, progress=False)
    assert any(path in fault and re.search(said, fault) for fault in found.faults), found.faults
    assert found.rows[0]["faults"] == len(found.faults)


def test_missing_and_damaged_files_are_named(folder):
    images = sorted((folder / "train" / "01000" / "image" / "CAM_BACK").iterdir())
    images[0].unlink()
    images[1].write_bytes(images[1].read_bytes()[:-100])
    with open(frame(folder, 2), "w") as file:
        file.write("{")
    shutil.copy(folder / "data_dict_subset_B.json", folder / "data_dict_more.json")
    change(folder / "data_dict_more.json", lambda content: content["train"].update({"01001": ["5.json"]}))
    found = check_openlane_v2(folder, progress=False)
    said = "\n".join(found.faults)
    assert "1 of 4 train frames that split files name are missing (first train/01001/5)" in said
    assert f"{images[0]} cannot be read" in said
    assert f"{images[1]} is damaged or cut short" in said
    assert "is no JSON file" in said
    assert len(found.faults) == 4


def test_a_folder_without_frames_is_refused(tmp_path):
    with pytest.raises(UserError, match="holds no <split>"):
        check_openlane_v2(tmp_path, progress=False)


def test_the_command_prints_a_table_and_what_is_wrong(folder, capsys):
    assert main(["data", "check", "--format", "openlane-v2", str(folder)]) == 0
    assert "| train |" in capsys.readouterr().out
    change(frame(folder), set_rotation)
    assert main(["data", "check", "--format", "openlane-v2", str(folder)]) == 2
    assert "is no rotation" in capsys.readouterr().out
