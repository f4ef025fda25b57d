"""Depth of nuScenes' images from the lidar: a cloud by hand, with known pixels and depths; damaged sweeps."""

import numpy as np
import pytest

from tests.datasets.nuscenes_small import DRIVEN, K, write_nuscenes
from tests.datasets.test_nuscenes import SIZES, write_images
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesData, NuScenesDataset
from tflane_jax.datasets.view_images import ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.limits import check_settings
from tflane_jax.losses.map_masks import depth_targets

pytest.importorskip("shapely")
SWEEP = "samples/LIDAR_TOP/a1.jpg"
SETTINGS = {"image": ImageConfig(scale=0.5, divisor=32), "depth_cell": 8, "example": SIZES}


@pytest.fixture
def root(tmp_path):
    write_images(tmp_path)
    return write_nuscenes(tmp_path)


def seen_at(u, v, depth):
    """Return the lidar's x, y, z of what the front camera shows at this pixel of its halved image, in this depth.

    Between sweep and exposure, the vehicle drives on; the lidar looks to its right, 0.94 m ahead, 1.84 m above.
    """
    (fx, _, cx), (_, fy, cy), _ = np.array(K) / 2
    right, down = (u - cx) / fx * depth, (v - cy) / fy * depth
    ahead, left, up = 1.5 + DRIVEN + depth, -right, 1.5 - down
    return [-left, ahead - 0.94, up - 1.84]


def write_sweep(root, *points):
    path = root / SWEEP
    path.parent.mkdir(parents=True, exist_ok=True)
    np.array([[*point, 7.0, 3.0] for point in points], "<f4").tofile(path)
    return path


@pytest.mark.parametrize("settings", [{}, {"frame": "lidar", "camera_poses": "calibration"}])
def test_the_nearest_point_of_a_cell_counts(root, settings):
    """Whatever pose the images have, points go by the camera's own moment."""
    points = [
        seen_at(20, 10, 12.0),
        seen_at(20, 10, 8.25),
        seen_at(20, 11, 0.5),  # on the vehicle
        seen_at(7.6, 4, 40.0),  # rounded to the next cell
        seen_at(4, 17.7, 9.0),  # rounded to the row below the image, which the array has
        seen_at(4, 4, -9.0),  # behind the camera
    ]
    write_sweep(root, *points)
    views = NuScenesDataset(NuScenesConfig(root, **SETTINGS, **settings)).example(1).cameras
    views.validate()
    assert views.image.shape == (6, 32, 32, 3)
    assert views.depth.shape == (6, 4, 4)
    assert np.argwhere(views.depth_valid).tolist() == [[0, 0, 1], [0, 1, 2]]
    np.testing.assert_allclose(views.depth[0, [0, 1], [1, 2]], [40.0, 8.25], rtol=1e-5)
    bins, valid = depth_targets(views, (4, 4))
    assert np.argwhere(np.asarray(valid)).tolist() == [[0, 1, 2]]
    assert bins[0, 1, 2] == 14  # from 8 m on


def test_only_training_images_have_depth(root):
    write_sweep(root, seen_at(20, 10, 8.0))
    data = NuScenesData(root, train="val", **SETTINGS)
    assert data.source("train").depth_cell == 8
    assert data.source("val").depth_cell is None
    with pytest.raises(UserError, match=r"depth_cell is 8.*None without images"):
        check_settings(NuScenesData(root, depth_cell=8), "data.")


def test_a_sweep_outside_of_the_folder_is_not_read(root):
    path = root / "v1.0-mini" / "sample_data.json"
    path.write_text(path.read_text().replace(SWEEP, f"../{SWEEP}"))
    with pytest.raises(UserError, match=r"filename: '\.\./samples/LIDAR_TOP/a1\.jpg' is not within the folder"):
        NuScenesDataset(NuScenesConfig(root, **SETTINGS)).example(1)


def test_missing_and_damaged_sweeps_are_named(root):
    dataset = NuScenesDataset(NuScenesConfig(root, **SETTINGS))
    with pytest.raises(UserError, match=r"a1\.jpg is missing.*data\.depth_cell=None and .*bev\.supervised=False"):
        dataset.example(1)
    path = write_sweep(root, seen_at(20, 10, 8.0), [1.0, np.nan, 0.0])
    with pytest.raises(UserError, match=r"LIDAR_TOP/a1\.jpg: point 1 is not finite"):
        dataset.example(1)
    for size in (0, 19):
        path.write_bytes(bytes(size))
        with pytest.raises(UserError, match=rf"a1\.jpg has {size} bytes, which are not whole points of 20"):
            dataset.example(1)
