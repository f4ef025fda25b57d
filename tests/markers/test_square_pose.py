"""Poses of a square from its corners."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.markers.test_detection import AHEAD, degrees_between, pose
from tflane_jax.geometry import invert_pose
from tflane_jax.geometry.cameras import project
from tflane_jax.markers.image_search import DetectorConfig
from tflane_jax.markers.square_pose import marker_outline, solve_square

pytest.importorskip("cv2")


def rolled(degrees: float) -> np.ndarray:
    """Return a rotation of a board in its plane."""
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@given(
    x=st.floats(4.0, 40.0),
    bearing=st.floats(-0.4, 0.4),
    z=st.floats(0.5, 4.0),
    turn=st.floats(-70.0, 70.0),
    roll=st.sampled_from([0.0, 90.0, 180.0, 270.0]) | st.floats(0.0, 360.0),
)
@example(10.0, 0.1, 2.0, 11.0, 180.0)  # wrong by 13 degrees before
@settings(max_examples=60)
def test_exact_corners_give_the_exact_pose(x, bearing, z, turn, roll):
    """Turned far enough for the two poses to differ, the right one is preferred; also of a board on its head."""
    truth = pose(x, bearing * x, z, turn) @ rolled(roll)
    corners = marker_outline(truth, 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
    fit = solve_square(corners, AHEAD.intrinsics, AHEAD.camera_from_ego)
    found = invert_pose(AHEAD.camera_from_ego) @ fit.camera_from_marker
    assert fit.error.min() < 1e-4
    assert min(degrees_between(solution, truth) for solution in found) < 0.1
    if fit.ambiguity < 0.5:
        assert degrees_between(found[0], truth) < 0.1
        np.testing.assert_allclose(found[0, :3, 3], truth[:3, 3], atol=1e-3 * x)
    assert fit.ambiguity == pytest.approx((fit.error.min() + 1e-3) / (fit.error.max() + 1e-3))


def test_the_prior_decides_where_both_poses_fit():
    """Corners between those of both poses, nearer to the wrong one, which leans."""
    truth = pose(22.0, 0.0, 9.0, 25.0)
    camera = AHEAD
    exact = marker_outline(truth, 1.0, camera.intrinsics, camera.camera_from_ego)
    both = solve_square(exact, camera.intrinsics, camera.camera_from_ego)
    wrong = invert_pose(camera.camera_from_ego) @ both.camera_from_marker[1]
    assert degrees_between(wrong, truth) > 20.0
    flipped = marker_outline(wrong, 1.0, camera.intrinsics, camera.camera_from_ego)
    ego_from, doubtful = invert_pose(camera.camera_from_ego), 0
    for fraction in np.linspace(0.0, 1.0, 81):
        between = (1.0 - fraction) * exact + fraction * flipped
        by_error = solve_square(between, camera.intrinsics, camera.camera_from_ego, DetectorConfig(ambiguous=1.0))
        by_prior = solve_square(between, camera.intrinsics, camera.camera_from_ego)
        right = [degrees_between(ego_from @ fit.camera_from_marker[0], truth) < 15.0 for fit in (by_error, by_prior)]
        assert by_error.error[0] <= by_error.error[1]
        for solution, error in zip(ego_from @ by_prior.camera_from_marker, by_prior.error, strict=True):
            off = marker_outline(solution, 1.0, camera.intrinsics, camera.camera_from_ego) - between
            assert error == pytest.approx(np.sqrt((off**2).sum(-1).mean()), abs=1e-4)
        if by_error.ambiguity <= 0.6:
            assert right[0] == right[1] == (fraction < 0.5)
        else:
            doubtful += not right[0]
            assert right[1]
    assert doubtful > 0


def test_where_both_poses_fit_upright_facing_and_error_decide_together():
    """Noisy corners: the preferred pose has the smaller sum of squares of `solve_square`."""
    rng, ego_from, config, doubtful = np.random.default_rng(0), invert_pose(AHEAD.camera_from_ego), DetectorConfig(), 0
    for x, bearing, z, turn in rng.uniform((10.0, -0.3, 1.0, -40.0), (40.0, 0.3, 4.0, 40.0), (300, 4)):
        corners = marker_outline(pose(x, bearing * x, z, turn), 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
        fit = solve_square(corners + rng.normal(0.0, 0.3, (4, 2)), AHEAD.intrinsics, AHEAD.camera_from_ego)
        found = ego_from @ fit.camera_from_marker
        toward = ego_from[:3, 3] - found[:, :3, 3]
        facing = (found[:, :3, 2] * toward).sum(-1) / np.linalg.norm(toward, axis=-1)
        lean, turned = np.arccos(found[:, 2, 1]) / config.tilt, np.arccos(facing) / config.turn
        cost = lean**2 + turned**2 + (fit.error / fit.error.min()) ** 2
        if fit.ambiguity > config.ambiguous:
            doubtful += 1
            assert cost[0] < 1.02 * cost[1]
    assert doubtful > 80


def test_outline_is_upper_left_first():
    (left, top), _, (right, bottom), _ = marker_outline(
        pose(10.0, 0.0, 1.5), 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego
    )
    np.testing.assert_allclose([left, top, right, bottom], [435.0, 225.0, 525.0, 315.0])
    middle, _, _ = project(np.array([[10.0, 0.0, 1.5]]), AHEAD.intrinsics, AHEAD.camera_from_ego)
    np.testing.assert_allclose(middle[0], [0.5 * (left + right), 0.5 * (top + bottom)])


@pytest.mark.parametrize("x", [4.0, 15.0, 39.7])
def test_a_marker_that_exactly_faces_the_camera_has_a_pose(x):
    """Seen exactly from the front, where OpenCV's solution is not a number."""
    truth = pose(x, 0.0, 1.5)
    corners = marker_outline(truth, 1.0, AHEAD.intrinsics, AHEAD.camera_from_ego)
    fit = solve_square(corners, AHEAD.intrinsics, AHEAD.camera_from_ego)
    for solution in invert_pose(AHEAD.camera_from_ego) @ fit.camera_from_marker:
        assert degrees_between(solution, truth) < 0.2
    assert fit.error.max() < 1e-3


@pytest.mark.parametrize("corners", [[(10, 10)] * 4, [(10, 10), (20, 10), (30, 10), (40, 10)]])
def test_corners_of_no_square_have_no_pose(corners):
    found = solve_square(np.array(corners, float), np.diag([500.0, 500.0, 1.0]), np.eye(4))
    assert not np.isfinite(found.error).any()
    assert np.isfinite(found.camera_from_marker).all()
