"""Rigid motions: the group laws, and Eq. (1) of TF-Lane at city coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tflane_jax.geometry import (
    invert_pose,
    matrix_from_quaternion,
    pose_matrix,
    pose_yaw,
    relative_pose,
    transform_points,
    wrap_angle,
    yaw_pose,
)

QUICK = settings(max_examples=40)
seeds = st.integers(0, 10**6)


def random_poses(seed, shape=(), reach=10.0, dims=3):
    rng = np.random.default_rng(seed)
    count = int(np.prod(shape))
    rotation = Rotation.random(count, rng=rng).as_matrix().reshape(*shape, 3, 3)
    if dims == 2:
        yaw = rng.uniform(-4, 4, shape)
        rotation = np.stack([np.stack([np.cos(yaw), -np.sin(yaw)], -1), np.stack([np.sin(yaw), np.cos(yaw)], -1)], -2)
    return pose_matrix(rotation, rng.uniform(-reach, reach, (*shape, dims)))


@QUICK
@given(seed=seeds, dims=st.sampled_from([2, 3]))
def test_inverse_composition_and_rigidity(seed, dims):
    a, b = random_poses(seed, (3,), dims=dims), random_poses(seed + 1, (3,), dims=dims)
    points = np.random.default_rng(seed).uniform(-50, 50, (3, 7, dims))
    np.testing.assert_allclose(invert_pose(a) @ a, np.broadcast_to(np.eye(dims + 1), a.shape), atol=1e-12)
    np.testing.assert_allclose(
        transform_points(a @ b, points), transform_points(a, transform_points(b, points)), atol=1e-12
    )
    np.testing.assert_allclose(transform_points(invert_pose(a), transform_points(a, points)), points, atol=1e-12)
    moved = transform_points(a, points)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(moved, axis=1), axis=-1), np.linalg.norm(np.diff(points, axis=1), axis=-1), atol=1e-12
    )


@QUICK
@given(seed=seeds)
def test_equation_1_keeps_millimetres_at_city_coordinates(seed):
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-np.pi, np.pi)
    x, y = rng.uniform(-10_000, 10_000, 2)
    before, now = yaw_pose(x, y, yaw), yaw_pose(x + 0.7 * np.cos(yaw), y + 0.7 * np.sin(yaw), yaw + 0.02)
    local = rng.uniform(-60, 60, (9, 3))
    # A standing object seen from both ego poses, by way of the city frame in extended precision.
    city = transform_points(before.astype(np.longdouble), local.astype(np.longdouble))
    expected = (city - now[:3, 3]) @ now[:3, :3].astype(np.longdouble)
    warp = relative_pose(now, before)
    np.testing.assert_allclose(transform_points(warp, local), expected.astype(float), atol=1e-9)
    # The relative pose is small, so the device's float32 is enough from here on.
    np.testing.assert_allclose(transform_points(warp.astype(np.float32), local.astype(np.float32)), expected, atol=1e-4)
    np.testing.assert_allclose(relative_pose(before, before), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(relative_pose(now, before) @ relative_pose(before, now), np.eye(4), atol=1e-9)


@QUICK
@given(seed=seeds, norm=st.floats(0.1, 10.0))
def test_quaternion_equals_scipy_for_any_norm_and_sign(seed, norm):
    rotation = Rotation.random(4, rng=np.random.default_rng(seed))
    quaternion = rotation.as_quat(scalar_first=True)
    np.testing.assert_allclose(matrix_from_quaternion(norm * quaternion), rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(matrix_from_quaternion(-quaternion), rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("yaw", [-3.1, -0.5, 0.0, 1.2, np.pi])
def test_yaw_pose(yaw):
    pose = yaw_pose(np.full(2, 3.0), np.array([4.0, 5.0]), np.full(2, yaw))
    assert pose.shape == (2, 4, 4)
    np.testing.assert_allclose(pose_yaw(pose), yaw)
    forward = transform_points(pose[0], np.array([[1.0, 0.0, 2.0]]))
    np.testing.assert_allclose(forward, [[3 + np.cos(yaw), 4 + np.sin(yaw), 2]])


def test_one_pose_moves_points_of_any_rank_on_host_and_device():
    pose = random_poses(0)
    points = np.random.default_rng(1).normal(size=(2, 5, 3))
    moved = transform_points(pose, points)
    np.testing.assert_allclose(moved[1], transform_points(pose, points[1]))
    with jax.numpy_rank_promotion("raise"):
        on_device = jax.jit(transform_points)(jnp.asarray(pose), jnp.asarray(points))
    np.testing.assert_allclose(on_device, moved, atol=1e-5)
    assert transform_points(pose, np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("turns", [-2, 0, 1, 5])
@pytest.mark.parametrize("angle", [-3.1, -1.0, 0.0, 2.5])
def test_wrapped_angles_are_those_less_than_a_turn_that_point_the_same_way(angle, turns):
    assert float(wrap_angle(angle + 2 * np.pi * turns)) == pytest.approx(angle, abs=1e-12)
    np.testing.assert_allclose(wrap_angle(np.full((2, 3), angle)), angle)
    assert float(wrap_angle(np.pi)) == -np.pi
