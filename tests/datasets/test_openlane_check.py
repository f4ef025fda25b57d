"""Faults and counts that the check of an OpenLane-V2 folder reports."""

import json
import pickle
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tflane_jax.cli import main
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_check_cameras import CameraChecks, image_size
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_frames import FrameCamera
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


def swap(content):
    left, right = (content["sensor"][f"CAM_FRONT_{side}"] for side in ("LEFT", "RIGHT"))
    left["extrinsic"], right["extrinsic"] = right["extrinsic"], left["extrinsic"]


def invert(content):
    back = content["sensor"]["CAM_BACK_LEFT"]["extrinsic"]
    back["rotation"] = [list(row) for row in zip(*back["rotation"], strict=True)]


def scale(content):
    K = content["sensor"]["CAM_BACK"]["intrinsic"]["K"]
    K[:2] = [[2.0 * value for value in row] for row in K[:2]]


def millimetres(content):
    back = content["sensor"]["CAM_BACK"]["extrinsic"]
    back["translation"] = [1000.0 * value for value in back["translation"]]


def scaled(factor):
    def function(content):
        K = content["sensor"]["CAM_FRONT_LEFT"]["intrinsic"]["K"]
        K[:2] = [[factor * value for value in row] for row in K[:2]]

    return function


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (millimetres, r"CAM_BACK is 2193 m from the vehicle's origin: is its translation in metres"),
        (scaled(0.75), r"CAM_FRONT_LEFT has a focal length of 29 pixels in images of 48 x 32, expected about 38"),
        (
            swap,
            r"CAM_FRONT_RIGHT looks to 5\d degrees .*, expected about -5\d, where CAM_FRONT_LEFT should look: .*swap",
        ),
        (swap, "CAM_FRONT_LEFT looks to -5. degrees .*, where CAM_FRONT_RIGHT should look"),
        (invert, "CAM_BACK_LEFT looks to .* from the ego frame to the camera"),
        (scale, r"CAM_BACK has its principal point at \(48, 32\) .* in images of 48 x 32: .*another size"),
    ],
)
def test_a_calibration_that_cannot_be_is_named(folder, function, said):
    for suffix in ("", "-ls"):
        change(frame(folder, suffix=suffix), function)
    faults = check_openlane_v2(folder, progress=False).faults
    assert any(re.search(said, fault) for fault in faults), faults
    assert len(faults) == (2 if function is swap else 1)


@pytest.mark.parametrize("name", ["CAM_BACK", "ring_front_center", "my_camera"])
@pytest.mark.parametrize("factor", [0.75, 0.85, 0.95, 1.0, 1.05, 1.15, 1.25])
def test_a_focal_length_is_compared_with_that_of_the_dataset(tmp_path, name, factor):
    """Images of a tenth of the native size; all intrinsics are scaled, as in images of another size."""
    focal, width, height = (80.9, 160, 90) if name != "ring_front_center" else (177.6, 155, 205)
    assert cv2.imwrite(str(tmp_path / "image.png"), np.zeros((height, width, 3), np.uint8))
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) * (
        [[-1.0], [-1.0], [1.0]] if name == "CAM_BACK" else 1.0
    )
    intrinsics = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    intrinsics[:2] *= factor
    camera = FrameCamera(name, tmp_path / "image.png", intrinsics, pose)
    _, faults = CameraChecks().check(SimpleNamespace(path=tmp_path, cameras=(camera,)))
    assert len(faults) == (abs(factor - 1.0) > 0.1 and name != "my_camera"), faults


def test_a_camera_that_frames_lack_is_one_fault(folder):
    for number in (0, 2):
        change(frame(folder, number), lambda content: content["sensor"].pop("CAM_BACK"))
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert re.search(r"train/01000: 2 frames have no camera CAM_BACK \(first train/01000/15", fault)
    assert not check_openlane_v2(folder, cameras="some", progress=False).faults


def images_of(folder, camera="CAM_FRONT_LEFT"):
    return sorted((folder / "train" / "01000" / "image" / camera).iterdir())


def test_an_image_of_another_size_is_named(folder):
    path = images_of(folder)[1]
    shutil.copy(images_of(folder, "CAM_BACK_RIGHT")[1], path)
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert fault == f"{path} is 48 x 16 pixels, the first image of CAM_FRONT_LEFT is 48 x 32"


@pytest.mark.parametrize("damage", [b"\xff\xc1", bytes(5000)], ids=["marker", "hole"])
def test_damage_within_an_image_is_found_where_it_is_read_as_a_whole(folder, damage):
    noise = np.random.default_rng(0).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    for path in images_of(folder):
        assert cv2.imwrite(str(path), noise)
    path = images_of(folder)[2]
    assert not any("damaged" in fault for fault in check_openlane_v2(folder, images="whole", progress=False).faults)
    content = bytearray(path.read_bytes())
    content[10_000 : 10_000 + len(damage)] = damage
    path.write_bytes(content)
    assert not any("damaged" in fault for fault in check_openlane_v2(folder, progress=False).faults)
    found = [fault for fault in check_openlane_v2(folder, images="whole", progress=False).faults if "damaged" in fault]
    (fault,) = found
    assert re.fullmatch(rf"{re.escape(str(path))} is damaged (9999|10000) bytes after its start", fault)


def test_the_size_of_an_image_is_in_its_header(tmp_path):
    for name in ("a.jpg", "a.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((7, 300, 3), np.uint8))
        assert image_size(tmp_path / name) == (300, 7)
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:20])
        assert image_size(tmp_path / name) is None
    assert image_size(tmp_path / "none.jpg") is None


def test_both_subsets_in_one_folder(folder, tmp_path):
    other = export_openlane_v2(
        {"train": DriveDataset(DriveConfig(scenes=1, cameras=7))}, tmp_path / "a", progress=False
    )
    shutil.copytree(other, folder, dirs_exist_ok=True)
    found = check_openlane_v2(folder, progress=False)
    assert (found.subset, found.faults) == ("A and B", [])
    assert [(row["subset"], row["segments"], row["images"]) for row in found.rows] == [("A", 1, 21), ("B", 1, 18)]
    change(frame(folder), swap)
    assert [row["faults"] for row in check_openlane_v2(folder, progress=False).rows] == [0, 2]


def test_stray_files_are_named_and_skipped(folder, capsys):
    segment = folder / "train" / "01000"
    strays = [segment / "info" / name for name in (".DS_Store", "15 (1).json", "notes.json")] + [
        folder / "train/readme"
    ]
    for path in strays:
        path.write_text("x")
    (folder / "train" / "empty").mkdir()
    found = check_openlane_v2(folder, progress=False)
    assert found.faults == []
    assert [text.partition(" is no ")[0] for text in found.skipped] == sorted(
        map(str, [*strays, folder / "train/empty"])
    )
    assert main(["data", "check", "--format", "openlane-v2", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "5 skipped:" in said
    assert "readme is no segment" in said


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
