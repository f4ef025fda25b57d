"""Rings of cameras: mounts, fields of view, scaling."""

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose
from tflane_jax.geometry.cameras import inside_image, project
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING, CameraRigConfig, draw_rig

RINGS = {"argoverse 2": ARGOVERSE2_RING, "nuscenes": NUSCENES_RING}


@pytest.mark.parametrize("ring", RINGS.values(), ids=RINGS)
def test_the_first_camera_looks_ahead_and_left_is_left(ring):
    cameras = draw_rig(7, CameraRigConfig(cameras=ring))
    ahead = invert_pose(cameras[0].camera_from_ego)[:3, 2]
    assert ahead[0] > 0.999
    for side, sign in (("left", 1.0), ("right", -1.0)):
        point = np.array([[2.0, sign * 15.0, 1.0]])
        seen = []
        for mount, camera in zip(ring, cameras, strict=True):
            (pixel,), _, (valid,) = project(point, camera.intrinsics, camera.camera_from_ego)
            if valid and inside_image(pixel, camera.width, camera.height):
                seen.append(mount.name.lower())
        assert seen
        assert all(side in name for name in seen)


@pytest.mark.parametrize("ring", RINGS.values(), ids=RINGS)
def test_every_direction_is_seen(ring):
    cameras = draw_rig(3, CameraRigConfig(cameras=ring))
    azimuth = np.deg2rad(np.arange(0.0, 360.0, 2.0))
    points = np.stack([60.0 * np.cos(azimuth), 60.0 * np.sin(azimuth), np.full_like(azimuth, 1.4)], -1)
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        pixels, _, valid = project(points, camera.intrinsics, camera.camera_from_ego)
        seen |= valid & inside_image(pixels, camera.width, camera.height)
    # Argoverse 2's ring has a narrow gap straight behind.
    assert seen.mean() > 0.95


def test_a_camera_depends_on_its_own_mount_and_the_scene():
    alone = draw_rig(5, CameraRigConfig(cameras=NUSCENES_RING[3:4]))[0]
    among, other = (draw_rig(seed, CameraRigConfig())[3] for seed in (5, 6))
    np.testing.assert_array_equal(alone.camera_from_ego, among.camera_from_ego)
    np.testing.assert_array_equal(alone.intrinsics, among.intrinsics)
    moved = np.abs(among.camera_from_ego - other.camera_from_ego).max()
    assert 1e-4 < moved < 0.1
    exact = draw_rig(5, CameraRigConfig(jitter=0.0))[3]
    np.testing.assert_allclose(invert_pose(exact.camera_from_ego)[:3, 3], [0.03, 0.0, 1.58], atol=1e-9)


def test_scale_and_multiple_keep_what_a_pixel_sees():
    full = draw_rig(1, CameraRigConfig(cameras=ARGOVERSE2_RING, scale=1.0))[0]
    small = draw_rig(1, CameraRigConfig(cameras=ARGOVERSE2_RING, scale=0.1, multiple=32))[0]
    assert (full.width, full.height, small.width, small.height) == (1550, 2048, 160, 224)
    np.testing.assert_allclose(small.intrinsics[:2] * [[10.0], [2048 / 205]], full.intrinsics[:2], rtol=1e-9)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (CameraRigConfig(cameras=()), r"cameras is \(\).*at least one"),
        (CameraRigConfig(severity=1.5), r"severity is 1\.5"),
        (CameraRigConfig(scale=0.001), r"scale is 0\.001"),
    ],
)
def test_errors_name_the_remedy(config, message):
    with pytest.raises(UserError, match=message):
        draw_rig(0, config)
