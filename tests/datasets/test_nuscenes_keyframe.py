"""One real nuScenes keyframe: six calibrated cameras and boxes, against `geometry.cameras` and the image path."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.shared import shared_path
from tflane_jax.datasets.nuscenes_cameras import CAMERAS, camera_fits, sample_cameras, vehicle_state
from tflane_jax.datasets.nuscenes_log import level_poses
from tflane_jax.datasets.nuscenes_tables import Tables
from tflane_jax.datasets.openlane_example import camera_views
from tflane_jax.datasets.openlane_frames import SUBSETS
from tflane_jax.datasets.view_images import TOPONET_SUBSET_B, fit_image
from tflane_jax.files.images import read_image
from tflane_jax.geometry import inside_image, invert_pose, project, relative_pose, transform_points


@pytest.fixture(scope="module")
def keyframe():
    folder = shared_path("data/nuscenes_keyframe")
    record = json.loads((folder / "keyframe_info.json").read_text())["data_list"][0]
    assert set(record["images"]) == set(SUBSETS["B"].cameras)
    return folder, record


def labelled(record, camera):
    """Return the boxes (lidar frame), camera_from_lidar, and what is labelled in the image of one camera."""
    boxes = np.array([instance["bbox_3d"] for instance in record["instances"]])
    lidar2cam = np.array(record["images"][camera]["lidar2cam"])
    return boxes, lidar2cam, record["cam_instances"][camera]


# In CAM_FRONT_LEFT no labelled center lies inside the image.
@pytest.mark.parametrize("camera", ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"])
def test_box_centers_are_where_they_are_labelled(keyframe, camera):
    """Through the ego frame, as an example holds it: K (camera_from_ego ego_from_lidar) center."""
    _, record = keyframe
    boxes, lidar2cam, instances = labelled(record, camera)
    image = record["images"][camera]
    camera_from_ego = invert_pose(np.array(image["cam2ego"]))
    intrinsics = np.array(image["cam2img"])[:3, :3]
    ego_from_lidar = np.linalg.inv(camera_from_ego) @ lidar2cam
    centers = boxes[:, :3] @ ego_from_lidar[:3, :3].T + ego_from_lidar[:3, 3]
    pixels, depth, valid = project(centers, intrinsics, camera_from_ego)
    seen = valid & inside_image(pixels, 1600, 900)
    stored = np.array([instance["center_2d"] for instance in instances])
    stored_depth = np.array([instance["depth"] for instance in instances])
    assert seen.any()
    # Every labelled center inside the image is that of a box, at its depth.
    apart = np.linalg.norm(stored[:, None] - pixels[valid], axis=-1)
    inside = inside_image(stored, 1600, 900)
    matched = apart[inside].argmin(-1)
    assert np.median(apart[inside].min(-1)) < 1e-2
    close = apart[inside].min(-1) < 0.1
    np.testing.assert_allclose(depth[valid][matched[close]], stored_depth[inside][close], atol=1e-3)


def test_left_is_left(keyframe):
    """A point ahead and to the left (ego frame, metres) is in the image of the front left camera."""
    _, record = keyframe
    point = np.array([[10.0, 12.0, 1.0]])
    seen = []
    for camera, image in record["images"].items():
        pose = invert_pose(np.array(image["cam2ego"]))
        pixels, _, valid = project(point, np.array(image["cam2img"])[:3, :3], pose)
        seen += [camera] if valid[0] and inside_image(pixels, 1600, 900)[0] else []
    assert seen == ["CAM_FRONT_LEFT"]


def test_the_real_images_become_the_papers(keyframe):
    folder, record = keyframe
    image = record["images"]["CAM_FRONT"]
    pixels = read_image(next((folder / "samples" / "CAM_FRONT").iterdir()))
    fit = fit_image(pixels.shape[1], pixels.shape[0], TOPONET_SUBSET_B, front=True)
    assert fit.size == (800, 450)
    halved = pixels.reshape(450, 2, 800, 2, 3).mean((1, 3))
    np.testing.assert_allclose(fit.image(pixels), halved, atol=1)
    intrinsics = np.array(image["cam2img"])[:3, :3]
    np.testing.assert_allclose(fit.intrinsics(intrinsics)[:2], intrinsics[:2] / 2)


def test_the_pose_chain_of_the_tables_gives_the_same_pixels(keyframe):
    """The key frame written as tables, each camera with its own ego pose, and read back as an example reads it."""
    folder, record = keyframe
    global_from_ego = np.array(record["ego2global"])
    ego_from_lidar = np.array(record["lidar_points"]["lidar2ego"])
    tables = as_tables(folder, record, global_from_ego, ego_from_lidar)
    sample = tables.rows["sample"]["sample"]
    np.testing.assert_allclose(tables.ego_pose(sample), global_from_ego, atol=1e-5)
    cameras = sample_cameras(tables, sample, tables.ego_pose(sample))
    assert [camera.name for camera in cameras] == list(CAMERAS)
    boxes = np.array([instance["bbox_3d"] for instance in record["instances"]])
    centers = transform_points(ego_from_lidar, boxes[:, :3])
    apart = []
    for camera in cameras:
        _, lidar2cam, instances = labelled(record, camera.name)
        np.testing.assert_allclose(
            invert_pose(camera.ego_from_camera), lidar2cam @ invert_pose(ego_from_lidar), atol=1e-4
        )
        pixels, _, valid = project(centers, camera.intrinsics, invert_pose(camera.ego_from_camera))
        stored = np.array([instance["center_2d"] for instance in instances])
        inside = inside_image(stored, 1600, 900)
        apart += np.linalg.norm(stored[inside][:, None] - pixels[valid], axis=-1).min(-1).tolist()
    assert np.median(apart) < 0.1
    # In the frame at the lidar, a point straight ahead of it is straight ahead: the lidar's own y axis.
    level = level_poses(global_from_ego[None], ego_from_lidar[None])[0]
    ahead = relative_pose(level, global_from_ego @ ego_from_lidar) @ [0.0, 10.0, 0.0, 1.0]
    np.testing.assert_allclose(ahead[:2], [10.0, 0.0], atol=0.01)

    # From frame "lidar" into the lidar's axes, as a host of published weights has it: the published poses.
    frame = relative_pose(level, level_poses(global_from_ego[None])[0])
    state = vehicle_state(tables, {"name": "scene-0061"}, sample, frame)
    level_cameras = sample_cameras(tables, sample, tables.ego_pose(sample), frame)
    for camera in level_cameras:
        lidar2cam = labelled(record, camera.name)[1]
        pose = invert_pose(camera.ego_from_camera) @ invert_pose(state.lidar_from_ego)
        np.testing.assert_allclose(pose, lidar2cam, atol=1e-4)

    images = camera_views(cameras, camera_fits(tables, TOPONET_SUBSET_B), TOPONET_SUBSET_B)
    images.validate()
    assert images.image.shape == (6, 480, 800, 3)
    assert images.valid.all()


def as_tables(folder, record, global_from_ego, ego_from_lidar):
    """Return the key frame as joined tables; the cameras' ego poses come from `lidar2cam`, the record of the chain."""
    rows = {"calibrated_sensor": {}, "ego_pose": {}, "sample": {"sample": {"token": "sample"}}}
    data = {}

    def add(name, ego_pose, ego_from_sensor, **columns):
        for table, pose in (("ego_pose", ego_pose), ("calibrated_sensor", ego_from_sensor)):
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            rows[table][name] = {"token": name, "translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}
        rows["calibrated_sensor"][name] |= {"camera_intrinsic": columns.pop("intrinsic", [])}
        tokens = {"token": name, "ego_pose_token": name, "calibrated_sensor_token": name}
        data[name] = tokens | {"width": 1600, "height": 900, **columns}

    add("LIDAR_TOP", global_from_ego, ego_from_lidar, filename="-")
    for name, image in record["images"].items():
        ego_from_camera = np.array(image["cam2ego"])
        ego_pose = global_from_ego @ ego_from_lidar @ np.linalg.inv(image["lidar2cam"]) @ np.linalg.inv(ego_from_camera)
        # The vehicle drove on for up to 50 ms; its height stays 0.
        moved = np.linalg.norm(ego_pose[:2, 3] - global_from_ego[:2, 3])
        assert 0.0 < moved < 1.0
        assert abs(ego_pose[2, 3]) < 1e-3
        file = next((folder / "samples" / name).iterdir()).relative_to(folder).as_posix()
        add(name, ego_pose, ego_from_camera, filename=file, intrinsic=np.array(image["cam2img"])[:3, :3].tolist())
    return Tables(folder / "v1.0-mini", rows, {"sample": data}, {})
