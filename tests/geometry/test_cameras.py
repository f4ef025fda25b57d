"""Pinhole cameras against the written-out formulas, and round trips."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.geometry import invert_pose, pose_matrix
from tflane_jax.geometry.cameras import crop_intrinsics, ground_points, inside_image, project, resize_intrinsics

QUICK = settings(max_examples=40)
INTRINSICS = np.array([[1000.0, 0, 800], [0, 1100, 450], [0, 0, 1]])
# Optical axis along the vehicle's x, 1.5 m above the ground.
FORWARD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
CAMERA = invert_pose(pose_matrix(FORWARD.T, np.array([2.0, 0, 1.5])))


def test_forward_camera_by_hand():
    points = np.array([[12.0, 0, 1.5], [12, -1, 1.5], [12, 0, 0.5], [-8, 0, 1.5], [2, 1, 1]])
    pixels, depth, valid = project(points, INTRINSICS, CAMERA)
    np.testing.assert_allclose(depth, [10, 10, 10, -10, 0], atol=1e-12)
    np.testing.assert_array_equal(valid, [True, True, True, False, False])
    # To the right is larger u, lower is larger v.
    np.testing.assert_allclose(pixels[:3], [[800, 450], [900, 450], [800, 560]])
    assert np.isfinite(pixels).all()


@QUICK
@given(seed=st.integers(0, 10**6), height=st.floats(-0.5, 0.5))
def test_ground_point_projects_back_to_its_pixel(seed, height):
    rng = np.random.default_rng(seed)
    tilt = np.linalg.qr(FORWARD + 0.1 * rng.normal(size=(3, 3)))[0]
    tilt = tilt * np.sign((tilt * FORWARD).sum(-1, keepdims=True))
    camera = invert_pose(pose_matrix(tilt.T, np.array([2.0, 0, 1.5])))
    pixels = rng.uniform((0, 0), (1600, 900), (20, 2))
    ground, valid = ground_points(pixels, INTRINSICS, camera, height)
    assert np.isfinite(ground).all()
    np.testing.assert_array_equal(ground[:, 2], height)
    again, _, in_front = project(ground[valid], INTRINSICS, camera)
    assert in_front.all()
    np.testing.assert_allclose(again, pixels[valid], atol=1e-6)
    # A ray misses the ground exactly if it does not point down.
    rays = np.column_stack([pixels, np.ones(20)]) @ np.linalg.inv(INTRINSICS).T @ tilt
    np.testing.assert_array_equal(valid, rays[:, 2] < 0)


def test_level_camera_sees_no_ground_from_the_horizon_up():
    _, valid = ground_points(np.array([[800.0, 460], [800, 450], [800, 0]]), INTRINSICS, CAMERA)
    np.testing.assert_array_equal(valid, [True, False, False])


@QUICK
@given(seed=st.integers(0, 10**6), scale=st.tuples(st.floats(0.1, 2), st.floats(0.1, 2)))
def test_resize_and_crop_move_pixels_as_they_move_the_image(seed, scale):
    points = np.random.default_rng(seed).uniform((5, -5, 0), (50, 5, 3), (6, 3))
    pixels = project(points, INTRINSICS, CAMERA)[0]
    resized = project(points, resize_intrinsics(INTRINSICS, scale), CAMERA)[0]
    np.testing.assert_allclose(resized, pixels * scale)
    cropped = project(points, crop_intrinsics(INTRINSICS, (30.0, 200.0)), CAMERA)[0]
    np.testing.assert_allclose(cropped, pixels - [30, 200], atol=1e-9)


def test_inside_image():
    pixels = np.array([[0.0, 0.0], [1599.9, 899.9], [1600, 5], [5, 900], [-0.1, 5]])
    np.testing.assert_array_equal(inside_image(pixels, 1600, 900), [True, True, False, False, False])


def test_several_cameras_on_host_and_device():
    cameras = np.stack([CAMERA, CAMERA @ np.diag([-1.0, -1, 1, 1])])
    intrinsics = resize_intrinsics(np.stack([INTRINSICS] * 2), (0.5, 0.5))
    points = np.random.default_rng(0).uniform(-30, 30, (7, 3))
    expected = [project(points, k, c) for k, c in zip(intrinsics, cameras, strict=True)]
    args = points[None], intrinsics, cameras
    for got in (project(*args), jax.jit(project)(*map(jnp.asarray, args))):
        for part, per_camera in zip(got, zip(*expected, strict=True), strict=True):
            np.testing.assert_allclose(part, np.stack(per_camera), rtol=2e-3, atol=1e-2)
    with jax.numpy_rank_promotion("raise"):
        jax.jit(lambda k: crop_intrinsics(resize_intrinsics(k, (0.5, 0.5)), (1, 2)))(jnp.asarray(intrinsics))
    assert project(np.zeros((0, 3)), INTRINSICS, CAMERA)[0].shape == (0, 2)


def test_gradient_is_finite_for_points_behind_and_in_the_camera_plane():
    points = jnp.array([[12.0, 1, 0], [2, 1, 1], [-8, 0, 0]])

    def total(p):
        pixels, _, valid = project(p, jnp.asarray(INTRINSICS), jnp.asarray(CAMERA))
        return jnp.where(valid[:, None], pixels, 0.0).sum()

    gradient = jax.jit(jax.grad(total))(points)
    assert np.isfinite(gradient).all()
    np.testing.assert_array_equal(gradient[1:], 0.0)


@pytest.mark.parametrize("count", [0, 1])
def test_ground_points_of_few_pixels(count):
    ground, valid = ground_points(np.full((count, 2), 600.0), INTRINSICS, CAMERA)
    assert ground.shape == (count, 3)
    assert valid.all()


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_intrinsics_of_whole_numbers_are_those_of_floats(array):
    intrinsics = np.array([[1000, 0, 800], [0, 1000, 450], [0, 0, 1]])
    exact = intrinsics.astype(np.float64)
    resized, cropped = resize_intrinsics(array(intrinsics), (0.5, 0.25)), crop_intrinsics(array(intrinsics), (0.5, 1.5))
    np.testing.assert_allclose(resized, resize_intrinsics(exact, (0.5, 0.25)))
    np.testing.assert_allclose(cropped, crop_intrinsics(exact, (0.5, 1.5)))
