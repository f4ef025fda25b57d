"""The previous frame's features in the present frame: the reference's rotation, and the warp."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case, numbered
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.geometry.poses import yaw_pose
from tflane_jax.layers.bev_alignment import ego_shift, rotate_nearest, vehicle_center, warp

GRID = BevGrid(PerceptionRange((-12.0, 12.0), (-6.0, 6.0)), 24, 48)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("rotate_nearest*"), ids=case_id)
def test_rotation_matches_torchvision(path):
    case = load_module_case(path)
    turn = jax.jit(rotate_nearest, static_argnums=2)
    names = numbered(case.inputs, r"(\d+)\.img")
    assert names
    for name in names:
        i, image = name.removesuffix(".img"), case.inputs[name].transpose(1, 2, 0)
        # torchvision turns about the middle of the image where no center is given.
        middle = image.shape[1] / 2, image.shape[0] / 2
        center = tuple(float(x) for x in case.inputs.get(f"{i}.center_xy", middle))
        got = turn(image, np.deg2rad(case.inputs[f"{i}.angle"]), center).transpose(2, 0, 1)
        np.testing.assert_array_equal(got, case.outputs[f"{i}.rotated"], err_msg=i)


warped_by = jax.jit(lambda features, pose: warp(features, GRID, pose))
turned_by = jax.jit(lambda features, yaw: rotate_nearest(features, yaw, vehicle_center(GRID)))


def bump(x, y):
    """Return a smooth feature of two channels with its middle at (x, y) metres."""
    columns, rows = (np.array(axis) for axis in GRID.centers())
    distance = (columns[None] - x) ** 2 + (rows[:, None] - y) ** 2
    return np.stack([np.exp(-distance / 8.0), 2 * np.exp(-distance / 8.0)], -1).astype(np.float32)


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (2.0, 0.5, 0.0), (0.0, 0.0, 0.4), (1.5, -0.7, -0.6)])
def test_static_features_keep_their_place_in_the_world(motion):
    """A bump at p in the present frame was at pose(p) in the previous one; both alignments must bring it back."""
    pose = yaw_pose(*(np.float32(v) for v in motion)).astype(np.float32)
    now = np.array([3.0, 1.0, 0.0, 1.0])
    before = bump(*(pose @ now)[:2])
    expected = bump(3.0, 1.0)
    warped = np.asarray(warped_by(before, pose))
    near = expected[..., 0] > 0.4
    np.testing.assert_allclose(warped[near], expected[near], atol=0.03)
    if motion == (0.0, 0.0, 0.0):
        np.testing.assert_allclose(warped, expected, atol=2e-6)
    # The reference's way: turned to the nearest cell, then looked at with a shift.
    turned = np.asarray(turned_by(before, np.float32(motion[2])))
    peak = np.unravel_index(turned[..., 0].argmax(), turned.shape[:2])
    there = np.array([GRID.centers()[0][peak[1]], GRID.centers()[1][peak[0]]])
    shift = np.asarray(ego_shift(GRID, jnp.asarray(pose))) * GRID.range.size(2)
    np.testing.assert_allclose(there, now[:2] + shift, atol=0.5)


def test_beyond_the_previous_grid_there_is_nothing():
    pose = jnp.asarray(yaw_pose(np.float32(30.0), np.float32(0), np.float32(0)), jnp.float32)
    assert not np.asarray(warped_by(jnp.ones((24, 48, 2)), pose)).any()
    half = jnp.asarray(yaw_pose(np.float32(12.0), np.float32(0), np.float32(0)), jnp.float32)
    np.testing.assert_array_equal(np.asarray(warped_by(jnp.ones((24, 48, 2)), half))[:, 24:], 0)


def test_the_vehicle_need_not_stand_in_the_middle():
    assert vehicle_center(GRID) == (24.0, 12.0)
    assert vehicle_center(BevGrid(PerceptionRange((-10.0, 30.0), (-5.0, 5.0)), 10, 40)) == (10.0, 5.0)
