"""Pillars of the BEV grid and their images against the reference's numbers and by hand."""

import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.geometry.pillars import cell_points, pillar_points, project_pillars
from tflane_jax.geometry.poses import yaw_pose


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("bevformer_point_sampling*"), ids=case_id)
def test_matches_the_reference(path):
    case = load_module_case(path)
    config, outputs = case.meta["config"], case.outputs
    low, high = np.array(config["pc_range"]).reshape(2, 3)
    grid = BevGrid(PerceptionRange(*map(tuple, zip(low, high, strict=True))), *config["bev"])
    pillars = pillar_points(grid, config["D"])
    height, width = case.inputs["img_hw"]
    for b, matrix in enumerate(case.inputs["lidar2img"]):
        np.testing.assert_allclose(cell_points(grid), outputs["ref_2d"][b, :, 0], rtol=1e-6)
        np.testing.assert_allclose(pillars.swapaxes(0, 1), outputs["ref_3d"][b], rtol=1e-6)
        eye = np.broadcast_to(np.eye(3, dtype=np.float32), (len(matrix), 3, 3))
        size = np.tile([width, height], (len(matrix), 1))
        fraction, inside = project_pillars(grid.range.denormalise(pillars), eye, matrix, size)
        np.testing.assert_array_equal(inside, outputs["bev_mask"][:, b])
        expected = outputs["reference_points_cam"][:, b]
        np.testing.assert_allclose(fraction[inside], expected[inside], rtol=2e-5, atol=2e-5)
        # Points behind a camera lie hundreds of images away, where float32 has no more digits.
        np.testing.assert_allclose(fraction, expected, rtol=1e-4, atol=2e-5)


def test_each_camera_has_its_own_size():
    """A point on the optical axis, f = 50 pixels, principal point (40, 30), seen by a wide and by a narrow image."""
    intrinsics = np.array([[50, 0, 40], [0, 50, 30], [0, 0, 1]], np.float32)[None].repeat(2, 0)
    # Camera frame x right, y down, z ahead.
    camera_from_ego = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float32)[None].repeat(
        2, 0
    )
    points = np.array([[[10, 0, 0], [10, 0, 5], [-10, 0, 0]]], np.float32)
    fraction, inside = project_pillars(points, intrinsics, camera_from_ego, np.array([[80, 60], [40, 60]]))
    np.testing.assert_allclose(fraction[0, 0, :2], [[0.5, 0.5], [0.5, 5 / 60]], rtol=1e-6)
    np.testing.assert_allclose(fraction[1, 0, :2], [[1.0, 0.5], [1.0, 5 / 60]], rtol=1e-6)
    assert inside.tolist() == [[[True, True, False]], [[False, False, False]]]


def test_turning_vehicle_and_cameras_together_turns_the_grid():
    """Half a turn maps the grid onto itself backwards: so it must map what the cameras see."""
    grid = BevGrid(PerceptionRange((-8.0, 8.0), (-4.0, 4.0), (-2.0, 2.0)), 4, 6)
    points = grid.range.denormalise(pillar_points(grid, 4)).astype(np.float64)
    rng = np.random.default_rng(0)
    ahead = np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0.3], [0, 0, 0, 1.0]])
    cameras = np.stack([ahead @ yaw_pose(*rng.normal(size=3)) for _ in range(3)])
    intrinsics = np.array([[60, 0, 50], [0, 60, 20], [0, 0, 1.0]])[None].repeat(3, 0)
    size = np.tile([100, 50], (3, 1))
    fraction, inside = project_pillars(points, intrinsics, cameras, size)
    turned, also = project_pillars(points, intrinsics, cameras @ yaw_pose(0.0, 0.0, np.pi), size)
    np.testing.assert_array_equal(also[:, ::-1], inside)
    assert 5 < inside.sum() < inside.size / 2
    np.testing.assert_allclose(turned[:, ::-1][inside], fraction[inside], atol=1e-6)
