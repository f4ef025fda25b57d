"""Faults and counts that the check of an OpenLane-V2 folder reports."""

import json
import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tflane_jax.cli import main
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_frames import list_frames
from tflane_jax.errors import UserError

cv2 = pytest.importorskip("cv2")


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
    assert found.format == "OpenLane-V2, subset B"
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
            "SD maps": 0,
            "faults": 0,
        }
    ]


def set_rotation(content):
    content["pose"]["rotation"][0][0] = 2.0


def moved(axis):
    def function(content):
        content["pose"]["translation"][axis] += 1000.0

    return function


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
        ("", moved(0), "is 1002 m from its place 0.5 s before: pose or timestamp is wrong"),
        ("", moved(2), "is 1000 m from its place 0.5 s before"),
        ("", turn_round, "CAM_FRONT does not look ahead"),
        ("", lambda content: content["sensor"]["CAM_FRONT"].update(image_path="/a.jpg"), "'/a.jpg' is not within"),
        ("", lambda content: content.pop("pose"), "lacks the entry 'pose'"),
        ("", lambda content: content.pop("annotation"), "has no annotation"),
        ("", lambda content: content["sensor"].update(CAM_ROOF={}), "camera 'CAM_ROOF' is none of subset B"),
        ("", annotate(topology_lclc=[[0, 1], [0, 0]]), r"topology_lclc has shape \(2, 2\), expected \(3, 3\)"),
        ("", annotate(topology_lcte=[[0, 2]] * 3), "topology_lcte holds 2, expected 0 and 1 only"),
        ("", lambda c: c["annotation"]["lane_centerline"][0].update(points=[[5.0, 1.0, 0.0]] * 3), "has no length"),
        ("-ls", lambda c: c["annotation"]["area"][0].update(points=[[5.0, 1.0, 0.0]]), "has no length"),
        ("", element(attribute=13), "attribute is 13, expected a whole number from 0 to 12"),
        ("", element(attribute=7), "attribute does not fit its category"),
        ("", element(points=[[14, 12], [10, 4]]), "box has no area"),
        ("-ls", annotate(topology_lsls=[]), "topology_lsls"),
        ("-ls", lambda content: content["annotation"]["area"][0].update(category=3), "whole number from 1 to 2"),
        ("-ls", lambda content: content["annotation"]["area"][0].update(category=1), "does not end where it begins"),
        ("-ls", lambda content: content["annotation"]["lane_segment"][0].pop("left_laneline"), "lacks the entry"),
    ],
)
def test_a_damaged_frame_is_named(folder, suffix, function, said):
    path = frame(folder, suffix=suffix)
    change(path, function)
    found = check_openlane_v2(folder, progress=False)
    assert any(path in fault and re.search(said, fault) for fault in found.faults), found.faults
    assert found.rows[0]["faults"] == len(found.faults)


def test_frames_that_are_named_in_another_unit_are_named(folder):
    """Subset B counts microseconds: nanoseconds would not fit in 64 bits."""
    path = Path(frame(folder, 1))
    path.rename(path.with_name(f"{path.stem}000.json"))
    (folder / "data_dict_subset_B.json").unlink()
    said = "\n".join(check_openlane_v2(folder, progress=False).faults)
    assert f"1 train frames, first train/01000/{path.stem}000: it has no whole number of microseconds" in said
    with pytest.raises(UserError, match=rf"{path.stem}000 has no whole number of microseconds as its timestamp"):
        list_frames(folder, "train", "B")


@pytest.mark.parametrize("name", ["9" * 5000, "-5", "first"])
def test_names_that_are_no_times_are_named(folder, name):
    change(folder / "data_dict_subset_B.json", lambda content: content["train"]["01000"].append(f"{name}.json"))
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert f"{name} has no whole number as its timestamp" in fault


def test_missing_and_damaged_files_are_named(folder):
    images = sorted((folder / "train" / "01000" / "image" / "CAM_BACK").iterdir())
    images[0].unlink()
    images[1].write_bytes(images[1].read_bytes()[:-100])
    images[2].unlink()
    images[2].symlink_to("/dev/null")  # /dev/zero would be read until memory is full
    with open(frame(folder, 2), "w") as file:
        file.write("{")
    shutil.copy(folder / "data_dict_subset_B.json", folder / "data_dict_more.json")
    change(folder / "data_dict_more.json", lambda content: content["train"].update({"01001": ["5.json"]}))
    found = check_openlane_v2(folder, progress=False)
    said = "\n".join(found.faults)
    assert "1 of 4 train frames that split files name are missing (first train/01001/5)" in said
    assert f"{images[0]} cannot be read" in said
    assert f"{images[1]} is damaged or cut short" in said
    assert f"{images[2]} cannot be read (it is a folder or a device)" in said
    assert "is no JSON file" in said
    assert len(found.faults) == 5


def test_a_camera_that_frames_lack_is_one_fault(folder):
    for number in (0, 2):
        change(frame(folder, number), lambda content: content["sensor"].pop("CAM_BACK"))
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert re.search(r"train/01000: 2 frames have no camera CAM_BACK \(first train/01000/15", fault)
    assert not check_openlane_v2(folder, cameras="some", progress=False).faults


def swap(content):
    left, right = (content["sensor"][f"CAM_FRONT_{side}"] for side in ("LEFT", "RIGHT"))
    left["extrinsic"], right["extrinsic"] = right["extrinsic"], left["extrinsic"]


def every_file(folder, number, function):
    for suffix in ("", "-ls"):
        change(frame(folder, number, suffix), function)


def farther(content):
    for name in ("lane_centerline", "lane_segment"):
        for lane in content["annotation"].get(name, []):
            for line in lane.keys() & {"points", "centerline"}:
                lane[line] = (100 * np.array(lane[line])).tolist()


def test_lanes_of_another_scale_are_named(folder):
    every_file(folder, 1, farther)
    faults = check_openlane_v2(folder, progress=False).faults
    assert len(faults) == 2
    assert all(re.search(r"a lane reaches \d{4} m from the vehicle, expected some 50", fault) for fault in faults)


def test_frames_that_a_training_does_not_see_are_named(folder):
    (file,) = folder.glob("data_dict_*.json")
    content = json.loads(file.read_text())
    first = next(iter(content["train"]))
    names = content["train"][first]
    content["train"][first] = names[:1] + names[:2]
    file.write_text(json.dumps(content))
    found = check_openlane_v2(folder, progress=False)
    assert found.faults == [f"{file}: 1 train frames are named twice"]
    (said,) = found.skipped
    assert f"{FRAMES - 2} of {FRAMES} train frames are named by no split file (first train/01000/" in said
    file.unlink()
    (said,) = check_openlane_v2(folder, progress=False).skipped
    assert said.startswith(f"{file} is missing: a training takes its frames from it")


def test_both_subsets_in_one_folder(folder, tmp_path):
    other = export_openlane_v2(
        {"train": DriveDataset(DriveConfig(scenes=1, cameras=7))}, tmp_path / "a", progress=False
    )
    shutil.copytree(other, folder, dirs_exist_ok=True)
    found = check_openlane_v2(folder, progress=False)
    assert (found.format, found.faults) == ("OpenLane-V2, subset A and B", [])
    assert [(row["subset"], row["segments"], row["images"]) for row in found.rows] == [("A", 1, 21), ("B", 1, 18)]
    change(frame(folder), swap)
    assert [row["faults"] for row in check_openlane_v2(folder, progress=False).rows] == [0, 2]


STRAYS = (
    "README", "sample/", "trian/", "train/readme", "train/empty/", "train/01000/notes.txt",
    "train/01000/info/.DS_Store", "train/01000/info/15 (1).json", "train/01000/info/notes.json",
    "train/01000/info/7.json/", "train/01000/image/CAM_ROOF/", "train/01000/image/CAM_BACK/Thumbs.db",
)  # fmt: skip


def stray(folder, names):
    for name in names:
        path = folder / name
        if name.endswith("/"):
            path.mkdir()
        else:
            path.write_text("x")


def test_stray_files_are_named_and_skipped(folder, capsys):
    stray(folder, STRAYS)
    found = check_openlane_v2(folder, progress=False)
    assert found.faults == []
    assert [re.split(" is (?:no|neither) ", text)[0] for text in found.skipped] == sorted(
        str(folder / name) for name in STRAYS
    )
    assert main(["data", "check", "--format", "openlane-v2", str(folder)]) == 0
    said = capsys.readouterr().out
    assert f"{len(STRAYS)} skipped:" in said
    assert "readme is no segment" in said


def test_long_lists_are_cut_unless_all_is_asked_for(folder, capsys):
    stray(folder, [f"train/{number:03d}.txt" for number in range(60)])
    for number in range(70):
        (folder / f"{number:03d}.pkl").write_bytes(b"")
    command = ["data", "check", "--format", "openlane-v2", str(folder)]
    assert main(command) == 2
    said = capsys.readouterr().out
    assert "... and 20 more: --all lists them" in said
    assert "... and 10 more: --all lists them" in said
    assert "059.txt" not in said
    assert main([*command, "--all"]) == 2
    said = capsys.readouterr().out
    assert said.count("  - ") == 130
    assert "more:" not in said


def test_sd_maps_are_counted_and_checked(tmp_path):
    folder = export_openlane_v2({"train": DriveDataset(DriveConfig(scenes=3))}, tmp_path / "made", progress=False)
    maps = [folder / "train" / segment / "sdmap.json" for segment in ("01000", "01001", "01002")]
    maps[0].write_text('[{"category": "road", "points": [[0, 0], [1, 1]]}]')
    maps[1].write_text('{"a"')
    found = check_openlane_v2(folder, progress=False)
    assert found.rows[0]["SD maps"] == 1
    damaged, missing = found.faults
    assert f"{maps[1]} is no JSON file" in damaged
    assert "1 of 3 segments have no sdmap.json (first train/01002)" in missing


def collection(folder):
    """Return what the devkit's collection of a split holds."""
    made = {}
    for number in range(FRAMES):
        with open(frame(folder, number)) as file:
            content = json.load(file)
        content["pose"] = {name: np.array(value) for name, value in content["pose"].items()}
        made["train", "01000", str(content["timestamp"])] = content
    return made


def other_pose(made):
    first = next(iter(made.values()))
    first["pose"]["translation"] = first["pose"]["translation"] + 0.5


class Evil:
    def __reduce__(self):
        return print, ("run",)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda made: None, None),
        (lambda made: made.update({("train", "01001", "5"): {}}), r"holds 1 of 4 frames .* \(first train/01001/5\)"),
        (lambda made: made.pop(next(iter(made))), r"lacks 1 frames of its segments \(first train/01000/15"),
        (other_pose, "has another pose than .*: the collection was made of other files"),
        (lambda made: next(iter(made.values())).pop("pose"), "lacks the entry 'pose'"),
        (lambda made: made.update(x=1), "'x' is no frame"),
        (lambda made: made.update({10**5000: 1}), "an integer of many digits is no frame"),
        (lambda made: made.clear(), "holds no frame"),
        (lambda made: made.update(evil=Evil()), "is refused: .*print"),
    ],
)
def test_collections_beside_the_folders(folder, capsys, damage, said):
    made = collection(folder)
    damage(made)
    (folder / "data_dict_subset_B_train.pkl").write_bytes(pickle.dumps(made))
    faults = check_openlane_v2(folder, progress=False).faults
    assert "run" not in capsys.readouterr().out
    if said is None:
        assert faults == []
    else:
        (fault,) = faults
        assert re.search(f"data_dict_subset_B_train.pkl.* {said}", fault)


def test_a_folder_without_frames_is_refused(tmp_path):
    with pytest.raises(UserError, match="holds no <split>"):
        check_openlane_v2(tmp_path, progress=False)


def test_the_command_prints_a_table_and_what_is_wrong(folder, capsys):
    assert main(["data", "check", "--format", "openlane-v2", str(folder)]) == 0
    assert "| train |" in capsys.readouterr().out
    change(frame(folder), set_rotation)
    assert main(["data", "check", "--format", "openlane-v2", str(folder)]) == 2
    assert "is no rotation" in capsys.readouterr().out
