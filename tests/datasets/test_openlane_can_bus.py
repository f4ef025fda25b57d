"""The numbers of a pose that published weights read, by hand and as the encoder takes them."""

import numpy as np
import pytest

from tflane_jax.datasets.openlane_can_bus import pose_can_bus, vehicle_state
from tflane_jax.geometry import yaw_pose
from tflane_jax.models.bevformer import can_bus_vector
from tflane_jax.scene import CameraViews

HALF, ROOT = 0.5, 0.8660254037844386
# Rotation by 60 degrees about x, after one by 30 degrees about z: 2 x 2 products of cosines and sines.
SLOPE = [[ROOT, -HALF, 0.0], [HALF * HALF, HALF * ROOT, -ROOT], [ROOT * HALF, ROOT * ROOT, HALF]]


@pytest.mark.parametrize(
    ("yaw", "real"),
    # cos(yaw / 2) of a yaw from 0 to 360 degrees, but for the last quarter, where pyquaternion changes the sign.
    [(0.0, 1.0), (60.0, ROOT), (120.0, HALF), (240.0, -HALF), (300.0, ROOT)],
)
def test_the_heading(yaw, real):
    found = pose_can_bus(np.asarray(yaw_pose(400.0, 1100.0, np.deg2rad(yaw))))
    np.testing.assert_allclose(found[:3], [400.0, 1100.0, 0.0])
    np.testing.assert_allclose(found[3:7], real, atol=1e-7)
    assert not found[7:16].any()
    np.testing.assert_allclose(found[16:], [yaw * np.pi / 180.0, yaw], atol=1e-5)


def test_on_a_slope_the_turn_about_z_comes_first():
    pose = np.eye(4)
    pose[:3, :3] = SLOPE
    found = pose_can_bus(pose)
    np.testing.assert_allclose(found[16:], [np.pi / 6.0, 30.0])
    np.testing.assert_allclose(found[3:7], 0.8365163037378079)  # cos 30 degrees x cos 15 degrees


def test_weights_of_single_frames_read_the_real_part_and_the_yaw_in_radians():
    empty = (
        np.zeros((1, 2, 2, 3), np.uint8),
        np.ones((1, 2), np.int32),
        np.eye(3)[None],
        np.eye(4)[None],
        np.ones(1, bool),
    )
    pose = np.asarray(yaw_pose(400.0, 1100.0, np.deg2rad(120.0)))
    read = can_bus_vector(CameraViews(*empty, vehicle=vehicle_state(pose, "reference")))
    expected = np.zeros(18)
    expected[3:7], expected[16] = HALF, 2.0 * np.pi / 3.0
    np.testing.assert_allclose(read, expected, atol=1e-6)
    assert vehicle_state(pose, "none") is None
