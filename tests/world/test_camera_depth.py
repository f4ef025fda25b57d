"""Depth of the world's cameras against exact distances."""

import dataclasses
import functools

import numpy as np
import pytest

from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.leaves import example_from_leaves, example_leaves
from tflane_jax.datasets.procedural import ProceduralDataset, WorldData
from tflane_jax.errors import UserError
from tflane_jax.geometry.cameras import ground_points
from tflane_jax.limits import check_settings
from tflane_jax.world.cameras.depth import render_depth
from tflane_jax.world.cameras.ring import CameraRigConfig
from tflane_jax.world.cameras.solids import pack
from tflane_jax.world.render.camera import PinholeCamera, camera_pose
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import box

pytest.importorskip("cv2")

CAMERA = PinholeCamera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), camera_pose(1.5, 0.0))


def block(x, width=2.0, height=3.0):
    """Return a box of two metres' length with its center ahead of the camera."""
    solid = Solid()
    box(solid, np.array([x, 0.0]), 0.0, (2.0, width), (0.0, height), (0.5, 0.5, 0.5))
    return solid, (x, 0.0, 2.0, width, 0.0, 0.0, height)


def bodies(*blocks):
    return pack([solid for solid, _ in blocks], [shape for _, shape in blocks])


def test_ground_and_sky():
    depth, valid = render_depth(bodies(), CAMERA, 8)
    assert depth.shape == valid.shape == (6, 8)
    assert not valid[:3].any()
    assert valid[4:].all()
    # The nearest ground of a cell is seen in its lowest row of samples.
    for row in (4, 5):
        nearest, _ = ground_points(np.array([[32.0, 8.0 * (row + 1) - 1.0]]), CAMERA.intrinsics, CAMERA.camera_from_ego)
        assert depth[row, 4] == pytest.approx(nearest[0, 0], rel=1e-4)


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearest_body_is_measured_at_its_front(order):
    blocks = [block(12.0), block(30.0, width=20.0, height=8.0)][::order]
    depth, valid = render_depth(bodies(*blocks), CAMERA, 4)
    assert depth[5, 8] == pytest.approx(11.0, abs=1e-4)  # straight ahead
    assert depth[5, 12] == pytest.approx(29.0, abs=1e-4)  # beside the near block
    assert valid[5, 8]
    assert depth[-1, 8] < 5.0  # the ground before it


def test_a_body_around_the_camera_plane_is_clipped():
    depth, valid = render_depth(bodies(block(1.0, width=1.0, height=0.5)), CAMERA, 4)
    assert np.isfinite(depth).all()
    assert depth[valid].min() >= 0.6 - 1e-6


def test_cells_beyond_the_image_have_none():
    depth, valid = render_depth(bodies(), CAMERA, 20)
    assert depth.shape == (3, 4)
    assert valid[2].all()
    assert (depth[~valid] == 0.0).all()


@functools.cache
def example(cell):
    rig = CameraRigConfig(scale=0.06, depth_cell=cell)
    config = ExampleConfig(sensor=None, cameras=rig)
    return ProceduralDataset(dataclasses.replace(WorldData(1, 1, 1).source("train"), example=config)).example(2)


def test_examples_have_depth_if_asked_for_and_the_same_images_without():
    made, plain = example(6), example(None)
    made.validate()
    views = made.cameras
    height, width = views.image.shape[1:3]
    assert views.depth.shape == (6, -(-height // 6), -(-width // 6))
    assert plain.cameras.depth is None
    np.testing.assert_array_equal(views.image, plain.cameras.image)
    np.testing.assert_array_equal(example_from_leaves(example_leaves(made)).cameras.depth, views.depth)
    # The lowest cells see near ground or a road user, never the sky.
    assert views.depth_valid[:, -1].all()
    assert 0.5 < views.depth[:, -1].min() < views.depth[:, -1].max() < 20.0


def test_a_finer_grid_has_the_same_nearest_surfaces():
    coarse, fine = example(6).cameras, example(3).cameras
    rows, columns = (side // 2 for side in fine.depth.shape[1:])
    pooled = np.where(fine.depth_valid, fine.depth, np.inf)[:, : 2 * rows, : 2 * columns]
    pooled = pooled.reshape(6, rows, 2, columns, 2).min((2, 4))
    seen = coarse.depth_valid[:, :rows, :columns] & np.isfinite(pooled)
    ratio = pooled[seen] / coarse.depth[:, :rows, :columns][seen]
    assert seen.mean() > 0.4
    assert np.median(np.abs(np.log(ratio))) < 0.1


def test_cells_without_pixels_are_refused():
    with pytest.raises(
        UserError, match="depth_cell is 0: it must be a whole number of at least 1 and at most 2147483647 or None"
    ):
        check_settings(CameraRigConfig(depth_cell=0))
