"""A drive as files: read back as written, and refused with one message otherwise."""

import json
import re

import numpy as np
import pytest

from tflane_jax.datasets.drive_files import Drive, DriveCamera, DriveFrame, JumpWarning, load_drive, save_drive
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, yaw_pose

cv2 = pytest.importorskip("cv2")
SECOND = 10**9


def camera(name, center=(30.5, 20.0), **more):
    intrinsics = np.array([[90.0, 0.0, center[0]], [0.0, 91.0, center[1]], [0.0, 0.0, 1.0]])
    return DriveCamera(name, intrinsics, yaw_pose(np.ones(1), np.zeros(1), np.zeros(1))[0], **more)


@pytest.fixture
def drive(tmp_path):
    """Two cameras and two frames; the second frame lacks an image."""
    rng = np.random.default_rng(1)
    for name, size in (("a0.png", (40, 60)), ("b0.png", (50, 30)), ("a1.png", (40, 60))):
        cv2.imwrite(str(tmp_path / name), rng.integers(0, 255, (*size, 3), np.uint8))
    pose = yaw_pose(np.array([5.0]), np.array([2.0]), np.array([0.3]))[0]
    frames = (
        DriveFrame(0, np.eye(4), {"a": tmp_path / "a0.png", "b": tmp_path / "b0.png"}),
        DriveFrame(SECOND, pose, {"a": tmp_path / "a1.png"}),
    )
    return Drive((camera("a"), camera("b", (15.5, 24.0), distortion=(-0.3, 0.1, 0.0, 0.0), size=(30, 50))), frames)


def test_a_file_holds_what_was_written(drive, tmp_path):
    read = load_drive(save_drive(drive, tmp_path / "poses.json", tmp_path), tmp_path)
    assert [frame.timestamp_ns for frame in read.frames] == [0, SECOND]
    for old, new in zip(drive.cameras, read.cameras, strict=True):
        assert (old.name, old.distortion, old.size) == (new.name, new.distortion, new.size)
        np.testing.assert_allclose(new.intrinsics, old.intrinsics)
        np.testing.assert_allclose(new.ego_from_camera, old.ego_from_camera)
    assert read.frames[0].images == drive.frames[0].images
    np.testing.assert_allclose(read.frames[1].global_from_ego, drive.frames[1].global_from_ego)


def test_views_are_padded_and_without_distortion(drive):
    views = drive.views(drive.frames[0])
    views.validate()
    assert views.size.tolist() == [[60, 40], [30, 50]]
    first = cv2.imread(str(drive.frames[0].images["a"]))[..., ::-1]
    np.testing.assert_array_equal(views.image[0, :40], first)
    assert not views.image[0, 40:].any()
    second = cv2.imread(str(drive.frames[0].images["b"]))[..., ::-1]
    assert (views.image[1, :50, :30] != second).mean() > 0.3
    np.testing.assert_allclose(views.camera_from_ego[1], invert_pose(drive.cameras[1].ego_from_camera), atol=1e-6)
    late = drive.views(drive.frames[1])
    assert late.valid.tolist() == [True, False]
    assert not late.image[1].any()
    assert late.size.tolist() == views.size.tolist()  # that of other frames, so that shapes stay
    assert late.image.shape == views.image.shape


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.update(format="x"), "this is no drive"),
        (lambda r: r.update(version=True), "version is True"),
        (lambda r: r.update(cameras=[]), "there is none"),
        (lambda r: r.update(frames=[]), "frames is empty"),
        (lambda r: r["cameras"].append(r["cameras"][0]), "distinct names"),
        (lambda r: r["cameras"][0].update(intrinsics=[0, 9, 1, 1]), "cameras[0]: intrinsics are fx, fy"),
        (lambda r: r["cameras"][0].update(intrinsics=[9, 9, 1]), "cameras[0]: intrinsics has shape (3,)"),
        (lambda r: r["cameras"][0].update(intrinsics=[1e-300, 9, 1, 1]), "with fx and fy from 1 to a million"),
        (lambda r: r["cameras"][0].update(distortion=[1]), "distortion has 1 numbers"),
        (lambda r: r["cameras"][0].update(distortion=[1e10] * 5), "distortion holds 1e+10, expected at most 100"),
        (lambda r: r["cameras"][0].update(size=[60]), "size has 1 numbers, expected width and height"),
        (lambda r: r["cameras"][0].update(size=[60, 0]), "cameras[0]: size is 0, expected a whole number from 1"),
        (lambda r: r["cameras"][0].update(name=""), "cameras[0]: name is ''"),
        (lambda r: r["cameras"][0]["ego_from_camera"].reverse(), "ego_from_camera is no pose"),
        (lambda r: r["frames"][0].update(timestamp_ns=1e400), "timestamp_ns is inf"),
        (lambda r: r["frames"][1].update(timestamp_ns=0), "frames[1] is not later"),
        (lambda r: r["frames"][0].update(images=3), "images is 3"),
        (lambda r: r["frames"][0].update(images={"c": "a0.png"}), "names the camera 'c'"),
        (lambda r: r["frames"][0].update(images={"a": "gone.png"}), "there is no image"),
        (lambda r: r["frames"][0].update(images={"a": "../a0.png"}), "is not within the folder"),
        (lambda r: r["frames"][0].update(images={"a": "x" * 999}), "expected a name"),
        (lambda r: r["frames"][0].update(global_from_ego=[[1e300] * 4] * 4), "global_from_ego is no pose"),
    ],
)
def test_faults_are_named(drive, tmp_path, change, message):
    record = json.loads(save_drive(drive, tmp_path / "poses.json", tmp_path).read_text())
    change(record)
    (tmp_path / "wrong.json").write_text(json.dumps(record))
    with pytest.raises(UserError, match=re.escape(message)) as error:
        load_drive(tmp_path / "wrong.json", tmp_path)
    assert "wrong.json" in str(error.value)


def shrunk(path, factor):
    image = cv2.imread(str(path))
    cv2.imwrite(str(path), cv2.resize(image, None, fx=factor, fy=factor))


@pytest.mark.parametrize(
    ("shrink", "message"),
    [
        ({"a0.png": 0.5, "a1.png": 0.5}, "a0.png is 30 x 20, but the principal point is (30.5, 20)"),
        ({"b0.png": 0.9}, "b0.png is 27 x 45, the calibration of camera b 30 x 50"),
    ],
)
def test_images_of_another_size_than_the_calibration_are_refused(drive, tmp_path, shrink, message):
    """Boards in them would be seen at another distance."""
    for name, factor in shrink.items():
        shrunk(tmp_path / name, factor)
    with pytest.raises(UserError, match=re.escape(message)):
        drive.views(drive.frames[0])
    faults = {}
    views = drive.views(drive.frames[0], faults)
    assert views.valid.sum() == 2 - len(faults) == 1


def test_two_sizes_of_one_camera_are_refused(drive, tmp_path):
    """Which of them is the right one cannot be told."""
    shrunk(tmp_path / "a0.png", 0.9)
    assert drive.views(drive.frames[0]).valid.all()
    with pytest.raises(UserError, match=re.escape("a1.png is 60 x 40, the first image of camera a 54 x 36")):
        drive.views(drive.frames[1])


def test_a_first_image_of_another_size_does_not_count(drive, tmp_path):
    shrunk(tmp_path / "a0.png", 0.5)
    assert drive.views(drive.frames[1]).valid.tolist() == [True, False]
    assert drive.views(drive.frames[0], {}).valid.tolist() == [False, True]


def test_a_jump_is_told(drive, tmp_path):
    record = json.loads(save_drive(drive, tmp_path / "poses.json", tmp_path).read_text())
    record["frames"][1]["global_from_ego"][0][3] = 9e7
    (tmp_path / "far.json").write_text(json.dumps(record))
    with pytest.warns(JumpWarning, match=r"frames\[1\]: the vehicle is 90000000 m from its place 1 s before"):
        load_drive(tmp_path / "far.json", tmp_path)
