"""One real nuScenes keyframe: six calibrated cameras and boxes, against `geometry.cameras` and the image path."""

import json

import numpy as np
import pytest

from tests.shared import shared_path
from tflane_jax.datasets.openlane_frames import SUBSETS
from tflane_jax.datasets.view_images import TOPONET_SUBSET_B, fit_image
from tflane_jax.files.images import read_image
from tflane_jax.geometry import inside_image, invert_pose, project


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


# In CAM_FRONT_LEFT no labelled centre lies inside the image.
@pytest.mark.parametrize("camera", ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"])
def test_box_centres_are_where_they_are_labelled(keyframe, camera):
    """Through the ego frame, as an example holds it: K (camera_from_ego ego_from_lidar) centre."""
    _, record = keyframe
    boxes, lidar2cam, instances = labelled(record, camera)
    image = record["images"][camera]
    camera_from_ego = invert_pose(np.array(image["cam2ego"]))
    intrinsics = np.array(image["cam2img"])[:3, :3]
    ego_from_lidar = np.linalg.inv(camera_from_ego) @ lidar2cam
    centres = boxes[:, :3] @ ego_from_lidar[:3, :3].T + ego_from_lidar[:3, 3]
    pixels, depth, valid = project(centres, intrinsics, camera_from_ego)
    seen = valid & inside_image(pixels, 1600, 900)
    stored = np.array([instance["center_2d"] for instance in instances])
    stored_depth = np.array([instance["depth"] for instance in instances])
    assert seen.any()
    # Every labelled centre inside the image is that of a box, at its depth.
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
