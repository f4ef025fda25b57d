"""Faults of images and calibrations that the check of an OpenLane-V2 folder reports."""

import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tests.datasets.test_openlane_check import change, frame, swap
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_check_cameras import CameraChecks, image_size
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_frames import FrameCamera
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING

cv2 = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("openlane") / "made"
    return export_openlane_v2({"train": DriveDataset(DriveConfig(scenes=1))}, out, progress=False)


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


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


def roll(degrees):
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def function(content):
        of = content["sensor"]["CAM_FRONT"]["extrinsic"]
        of["rotation"] = (np.array(of["rotation"]) @ np.linalg.matrix_power(turn, degrees // 90)).tolist()

    return function


def of_another(content):
    of = content["sensor"]["CAM_FRONT"]
    of["image_path"] = of["image_path"].replace("CAM_FRONT", "CAM_BACK")


def at(factor):
    """Return the change that scales where a camera is; it looks on as before."""

    def function(content):
        of = content["sensor"]["CAM_FRONT"]["extrinsic"]
        of["translation"] = [factor * value for value in of["translation"]]

    return function


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (roll(90), "CAM_FRONT is rolled by 90 degrees, expected upright"),
        (roll(180), "CAM_FRONT is rolled by 180 degrees, expected upright"),
        (at(0.001), r"CAM_FRONT is at \(0.00, .*\) m, 2.3 m from where the datasets' cameras of this name are: is its"),
        (at(2.0), r"CAM_FRONT is at .* m, 2.3 m from where"),
        (at(-1.0), r"CAM_FRONT is at .* m, 4.5 m from where"),
        (of_another, r"CAM_FRONT has the image .*, which is in the folder of CAM_BACK"),
        (millimetres, r"CAM_BACK is 1580 m from the vehicle's origin: is its translation in metres"),
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
    pose[:3, 3] = {"CAM_BACK": (0.03, 0.0, 1.58), "ring_front_center": (1.64, 0.0, 1.4)}.get(name, (0.0, -0.5, 2.0))
    intrinsics = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    intrinsics[:2] *= factor
    camera = FrameCamera(name, tmp_path / "image.png", intrinsics, pose)
    checks = CameraChecks()
    checks.check(SimpleNamespace(path=tmp_path, cameras=(camera,)))
    _, faults = checks.finish()
    assert len(faults) == (abs(factor - 1.0) > 0.1 and name != "my_camera"), faults


def every_frame(folder, function):
    for number in range(FRAMES):
        for suffix in ("", "-ls"):
            change(frame(folder, number, suffix), function)


def test_a_fault_of_a_whole_segment_is_one(folder):
    every_frame(folder, scale)
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert fault.startswith(f"{frame(folder, 0)}: CAM_BACK has its principal point at")
    assert fault.endswith(f"({FRAMES} frames of the segment)")


def stretched(factor):
    def function(content):
        content["sensor"]["CAM_FRONT_LEFT"]["intrinsic"]["K"][1][1] *= factor

    return function


def test_focal_lengths_of_width_and_height_are_both_checked(folder):
    change(frame(folder), stretched(1.5))
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert re.search(r"CAM_FRONT_LEFT has focal lengths of 38 pixels along the width and 57 along the height", fault)


def invert_all(content):
    for sensor in content["sensor"].values():
        rotation, place = (np.array(sensor["extrinsic"][name]) for name in ("rotation", "translation"))
        sensor["extrinsic"] = {"rotation": rotation.T.tolist(), "translation": (-rotation.T @ place).tolist()}


def test_inverted_extrinsics_are_not_taken_for_swapped_ones(folder):
    """Inverted, every camera of a level ring looks to the right."""
    change(frame(folder), invert_all)
    faults = [fault for fault in check_openlane_v2(folder, progress=False).faults if "degrees" in fault]
    assert len(faults) >= 4
    assert all("from the ego frame to the camera" in fault for fault in faults), faults


@pytest.mark.parametrize("ring", [ARGOVERSE2_RING, NUSCENES_RING])
def test_swapped_cameras_are_not_taken_for_inverted_ones(ring, tmp_path):
    """Every pair of a ring, level cameras."""
    for a in ring:
        for b in ring:
            yaw, pose = np.deg2rad(b.yaw), np.eye(4)
            pose[:2, 0] = np.sin(yaw), -np.cos(yaw)
            pose[:3, 1] = 0.0, 0.0, -1.0
            pose[:3, 2] = np.cos(yaw), np.sin(yaw), 0.0
            pose[:3, 3] = b.x, b.y, b.z
            checks, camera = CameraChecks(), FrameCamera(a.name, tmp_path / "none.jpg", np.eye(3), pose)
            checks.check(SimpleNamespace(path=tmp_path, cameras=(camera,)))
            _, faults = checks.finish()
            assert not any("from the ego frame" in fault for fault in faults)
            assert a is not b or not faults


def images_of(folder, camera="CAM_FRONT_LEFT"):
    return sorted((folder / "train" / "01000" / "image" / camera).iterdir())


@pytest.mark.parametrize("number", [0, 1])
def test_an_image_of_another_size_is_named(folder, number):
    """The first one is not the measure of the others."""
    path = images_of(folder)[number]
    shutil.copy(images_of(folder, "CAM_BACK_RIGHT")[1], path)
    assert check_openlane_v2(folder, progress=False).rows[0]["images"] == 6 * FRAMES - 1
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert fault == f"{path} is 48 x 16 pixels, most images of CAM_FRONT_LEFT are 48 x 32"


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
