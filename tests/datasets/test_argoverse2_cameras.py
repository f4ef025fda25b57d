"""Images of Argoverse 2's ring cameras: projections by hand, missing images, damaged files, which model reads them."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.small_argoverse2 import MS, pixel, write, write_images, write_log
from tests.shared import shared_path
from tflane_jax.cli import main
from tflane_jax.datasets.argoverse2 import SOURCE, Argoverse2Config, Argoverse2Dataset, LogData, check_argoverse2
from tflane_jax.datasets.argoverse2_cameras import RING, LogImages, has_images
from tflane_jax.datasets.argoverse2_log import load_log
from tflane_jax.datasets.argoverse2_poses import POSES
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.data_source import Choice
from tflane_jax.datasets.nuscenes import NuScenesConfig
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.view_images import TOPONET_SUBSET_A, ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, transform_points
from tflane_jax.geometry.cameras import project
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig

feather = pytest.importorskip("pyarrow.feather")
cv2 = pytest.importorskip("cv2")

FRONT, SIDE = "ring_front_center", "ring_side_left"
POINT = (16.5, 2.0, 1.0)  # city; in the images of both cameras, metres
# Key frames are at 1000 and 1500 ms. The first has no side image within half a period, the second no front image.
IMAGES = [(FRONT, 980), (FRONT, 1040), (SIDE, 1475), (SIDE, 1560)]
HALVED = ImageConfig(front_rows=(60, 380), scale=0.5)
NONE = ExampleConfig(sensor=None)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("argoverse2") / "logs"
    write_images(write_log(root / "log-a"), IMAGES, POINT)
    return root


@pytest.fixture
def root(written, tmp_path):
    return shutil.copytree(written, tmp_path / "logs")


def bright(image):
    """Return the center of what is bright in an image, pixels from its corner."""
    weight = image.mean(-1) * (image.mean(-1) > 60)
    v, u = np.indices(weight.shape) + 0.5
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.mark.parametrize(("index", "camera", "time"), [(0, FRONT, 980), (1, SIDE, 1475)])
def test_a_point_of_the_city_is_in_the_image_where_the_calibration_says(written, index, camera, time):
    """Between image and key frame, the vehicle drives 20 cm."""
    dataset = Argoverse2Dataset(Argoverse2Config(written, example=NONE, image=HALVED))
    example = dataset.example(index)
    example.validate()
    views, row = example.cameras, RING.index(camera)
    assert views.valid.tolist() == [name == camera for name in RING]
    width, height = views.size[row].tolist()
    assert (width, height) == ((155, 160) if camera == FRONT else (205, 155))
    assert views.image.shape == (7, 160, 224, 3)
    pose = dataset.info(index).global_from_ego
    point = transform_points(invert_pose(pose), np.array([POINT]))
    seen, depth, _ = project(point, views.intrinsics[row], views.camera_from_ego[row])
    by_hand, distance = pixel(camera, time, POINT)
    if camera == FRONT:
        by_hand = by_hand - (0, 60)  # the rows that are cut off
    np.testing.assert_allclose(depth[0], distance, atol=1e-4)
    np.testing.assert_allclose(seen[0], by_hand / 2, atol=1e-3)
    np.testing.assert_allclose(bright(views.image[row, :height, :width]), seen[0], atol=0.5)


def test_pictures_show_what_is_there(root):
    """A model of BEV evidence reads no images; its predictions are drawn into those of the logs that have some."""
    write_log(root / "log-b")
    dataset = Argoverse2Dataset(Argoverse2Config(root, example=NONE))
    assert dataset.example(0).cameras is None
    first, second, *others = SOURCE.views(dataset.config, [0, 1, 2, 3])
    assert others == [None, None]
    assert [view.valid.sum() for view in (first, second)] == [1, 1]
    assert first.image.shape == second.image.shape == (7, 224, 224, 3)
    assert first.size[0].tolist() == [155, 205]
    with pytest.raises(UserError, match=r"log-b holds no images of the ring cameras .*image=None"):
        Argoverse2Dataset(Argoverse2Config(root, image=HALVED))
    rows = check_argoverse2(root).rows
    assert [(row["cameras"], row["missing images"], row["faults"]) for row in rows] == [(2, 2, 0), (0, 0, 0)]


def test_samples_are_drawn_into_the_images_of_their_log(written, tmp_path):
    shown = ["data", "show", "--data", "argoverse2", "--root", str(written), "--count", "2"]
    assert main([*shown, "--out", str(tmp_path / "out" / "logs.png")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"logs.png", "logs-cameras.png"}


def rows_of(path):
    return feather.read_table(str(path)).to_pylist()


def without_side(folder):
    path = folder / "calibration" / "intrinsics.feather"
    write(path, [row for row in rows_of(path) if row["sensor_name"] != SIDE])


def twice(folder):
    path = folder / "calibration" / "egovehicle_SE3_sensor.feather"
    write(path, rows_of(path) * 2)


def no_lens(folder):
    path = folder / "calibration" / "intrinsics.feather"
    write(path, [row | {"fx_px": 0.0} for row in rows_of(path)])


def long_lens(folder):
    path = folder / "calibration" / "intrinsics.feather"
    write(path, [row | {"fx_px": 1e300} for row in rows_of(path)])


def far_away(folder):
    path = folder / "calibration" / "egovehicle_SE3_sensor.feather"
    write(path, [row | {"tz_m": 1e300} for row in rows_of(path)])


def no_pose(folder):
    path = folder / POSES
    write(path, [row for row in rows_of(path) if not 960 * MS < row["timestamp_ns"] < 1000 * MS])


def renamed(folder):
    path = folder / "sensors" / "cameras" / FRONT / f"{980 * MS}.jpg"
    path.rename(path.with_name("first.jpg"))


def late(folder):
    path = folder / "sensors" / "cameras" / FRONT / f"{980 * MS}.jpg"
    path.rename(path.with_name(f"{2**63}.jpg"))


def huge(folder):
    path = folder / "calibration" / "intrinsics.feather"
    write(path, [row | {"width_px": 20_001} for row in rows_of(path)])


def uncalibrated(folder):
    shutil.rmtree(folder / "calibration")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without_side, r"intrinsics.feather lacks ring_side_left, which has images"),
        (twice, r"egovehicle_SE3_sensor.feather has two rows of ring_front_center"),
        (no_lens, r"intrinsics.feather: ring_front_center has focal lengths 0 and 300 .* no camera"),
        (long_lens, r"ring_front_center has focal lengths 1e\+300 and 300 .* no camera"),
        (far_away, r"egovehicle_SE3_sensor.feather: tx_m, ty_m, tz_m of row 0 are .*1e\+300\], no metres"),
        (no_pose, r"has no pose at the time of .*ring_front_center/980000000.jpg"),
        (renamed, r"first.jpg is not named after its time"),
        (late, r"9223372036854775808.jpg is not named after its time"),
        (huge, r"ring_\w+ has .* in images of 20001 x \d+ pixels, which is no camera"),
        (uncalibrated, r"intrinsics.feather is missing"),
    ],
)
def test_damaged_files_are_named(root, damage, message):
    folder = root / "log-a"
    damage(folder)
    with pytest.raises(UserError, match=message):
        LogImages(folder).at(load_log(folder).keyframes[0])


def test_faults_of_images_are_listed(root):
    renamed(root / "log-a")
    found = check_argoverse2(root)
    assert [row["faults"] for row in found.rows] == [1]
    assert "first.jpg is not named after its time" in found.faults[0]


def test_an_image_of_another_size_is_named(root):
    path = root / "log-a" / "sensors" / "cameras" / FRONT / f"{980 * MS}.jpg"
    assert cv2.imwrite(str(path), np.zeros((20, 30, 3), np.uint8))
    with pytest.raises(UserError, match=rf"{path.name} is 30 x 20 pixels, the first image of {FRONT} is 310 x 410"):
        Argoverse2Dataset(Argoverse2Config(root, example=NONE, image=HALVED)).example(0)


def test_a_model_of_the_same_cameras_reads_recorded_images(written, tmp_path):
    """At the focal lengths of training; without images, with other cameras or trained on logs, all is as before."""
    drawn = ExampleConfig(cameras=CameraRigConfig(ARGOVERSE2_RING, scale=0.2, multiple=32))
    without = write_log(tmp_path / "other" / "log-b").parent

    def chosen(configured, root=written):
        return SOURCE.choose(Choice("test", False, configured, root))

    found = chosen(ProceduralConfig(example=drawn))
    assert found.image == ImageConfig(scale=0.2, divisor=32)
    assert found.example == replace(drawn, cameras=None)
    assert SOURCE.cameras(found) == RING
    assert chosen(ProceduralConfig(example=drawn), without) == Argoverse2Config(without, example=drawn)
    six = ExampleConfig(cameras=CameraRigConfig())
    assert chosen(ProceduralConfig(example=six)) == Argoverse2Config(written, example=six)
    trained = OpenLaneV2Config(written, example=NONE)
    assert chosen(trained) == Argoverse2Config(written, example=NONE, image=TOPONET_SUBSET_A)
    assert chosen(NuScenesConfig(written, image=HALVED, example=NONE)).image is None
    assert chosen(Argoverse2Config(written, example=drawn)) == Argoverse2Config(written, example=drawn)
    data = LogData(written, written, written, example=NONE, image=HALVED)
    assert chosen(data.source("train")) == data.source("train")
    assert SOURCE.streams(data.source("train"))
    with pytest.raises(UserError, match="set one of them to None"):
        Argoverse2Dataset(Argoverse2Config(written, example=drawn, image=HALVED))


def test_another_folder_of_logs_leaves_the_other_settings_of_the_run(written, tmp_path):
    """Regression: which frames are examples, OpenLane-V2's folder and the loading became the defaults."""
    run = Argoverse2Config(
        tmp_path, example=NONE, keyframes="annotations", openlane=tmp_path, loading=StreamingConfig(threads=7)
    )
    assert SOURCE.choose(Choice("test", False, run, written)) == replace(run, root=written)
    other = SOURCE.choose(Choice("test", False, run, written, openlane=written))
    assert other == replace(run, root=written, openlane=written)


@pytest.mark.golden
def test_a_real_calibration_is_that_of_the_ring(tmp_path):
    """Within 2.5 cm, 1 degree and 1% of the nominal mounts; the log at hand has no images, so empty files stand in."""
    log = shared_path("data/argoverse2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede")
    assert not has_images(log)
    shutil.copytree(log / "calibration", tmp_path / "calibration")
    shutil.copy(log / POSES, tmp_path)
    for name in RING:
        (tmp_path / "sensors" / "cameras" / name).mkdir(parents=True)
        (tmp_path / "sensors" / "cameras" / name / "1.jpg").touch()
    for camera, mount in zip(LogImages(tmp_path).cameras, ARGOVERSE2_RING, strict=True):
        assert (camera.name, camera.size) == (mount.name, (mount.width, mount.height))
        assert camera.intrinsics[0, 0] == pytest.approx(mount.focal, rel=0.01)
        pose, yaw, pitch = camera.ego_from_camera, np.deg2rad(mount.yaw), np.deg2rad(mount.pitch)
        np.testing.assert_allclose(pose[:3, 3], (mount.x, mount.y, mount.z), atol=0.025)
        ahead = np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)
        assert np.rad2deg(np.arccos(pose[:3, 2] @ ahead)) < 1.0


def test_folders_without_jpgs_have_no_images(tmp_path):
    assert not has_images(tmp_path)
    (tmp_path / "sensors" / "cameras" / FRONT).mkdir(parents=True)
    assert not has_images(tmp_path)
