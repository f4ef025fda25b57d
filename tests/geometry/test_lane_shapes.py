"""The lane shape model: ground curve, camera and image curve agree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.ground_curves import (
    GroundCurve,
    flat_image_curve,
    ground_offset,
    normalised_image_curve,
    pinhole_image_curve,
    tilted_image_curve,
)
from tflane_jax.geometry.cameras import project
from tflane_jax.geometry.lane_shapes import curve_columns, order_from_left

FOCAL, HEIGHT = 1000.0, 1.6
AHEAD = np.linspace(8.0, 90.0, 30)

curves = st.builds(
    lambda k, m, n, b: GroundCurve(*map(np.float64, (k, m, n, b))),
    st.floats(-1e-5, 1e-5),
    st.floats(-2e-3, 2e-3),
    st.floats(-0.2, 0.2),
    st.floats(-8, 8),
)
pitches = st.floats(-0.15, 0.15)


def vector(curve):
    return np.stack(curve)


def photographed(curve, pitch):
    """Return (u, v) from the principal point of the ground curve, by the camera model of `geometry.cameras`."""
    # Ego frame: x ahead, y left, z up; the camera looks up by `pitch`.
    points = np.stack([AHEAD, -ground_offset(curve, AHEAD), np.full_like(AHEAD, -HEIGHT)], -1)
    cos, sin = np.cos(pitch), np.sin(pitch)
    camera_from_ego = np.eye(4)
    camera_from_ego[:3, :3] = np.array([[0, -1, 0], [sin, 0, -cos], [cos, 0, sin]])
    intrinsics = np.diag([FOCAL, FOCAL, 1.0])
    pixels, _, valid = project(points, intrinsics, camera_from_ego)
    assert valid.all()
    return pixels


@settings(max_examples=60)
@given(curves, pitches)
def test_a_pinhole_image_of_the_ground_curve_is_the_image_curve(curve, pitch):
    pixels = photographed(curve, pitch)
    image = vector(pinhole_image_curve(curve, FOCAL, HEIGHT, pitch))
    np.testing.assert_allclose(curve_columns(image, pixels[:, 1]), pixels[:, 0], rtol=1e-7, atol=1e-5)


@settings(max_examples=60)
@given(curves, pitches)
def test_the_papers_tilt_turns_image_points_without_dividing(curve, pitch):
    flat = flat_image_curve(curve, FOCAL, HEIGHT)
    rows = FOCAL * HEIGHT / AHEAD
    columns = curve_columns(vector(flat), rows)
    np.testing.assert_allclose(columns, FOCAL * ground_offset(curve, AHEAD) / AHEAD, rtol=1e-9, atol=1e-9)
    turned = rows * np.cos(pitch) + FOCAL * np.sin(pitch)
    tilted = tilted_image_curve(flat, FOCAL, pitch)
    np.testing.assert_allclose(curve_columns(vector(tilted), turned), columns, rtol=1e-7, atol=1e-6)


@settings(max_examples=30)
@given(curves)
def test_without_pitch_all_three_agree(curve):
    flat = flat_image_curve(curve, FOCAL, HEIGHT)
    for other in (tilted_image_curve(flat, FOCAL, 0.0), pinhole_image_curve(curve, FOCAL, HEIGHT, 0.0)):
        np.testing.assert_allclose(vector(other), vector(flat), rtol=1e-12, atol=1e-12)


def test_the_papers_tilt_is_right_for_small_pitch_only():
    curve = GroundCurve(*map(np.float64, (1e-6, -5e-4, 0.02, -1.8)))
    errors = []
    for pitch in (0.001, 0.01, 0.1):
        tilted = vector(tilted_image_curve(flat_image_curve(curve, FOCAL, HEIGHT), FOCAL, pitch))
        u, v = photographed(curve, pitch).T
        errors.append(np.abs(curve_columns(tilted, v) - u).max())
    assert errors == sorted(errors)
    assert errors[0] < 0.1  # pixels
    assert errors[2] > 2.0


@settings(max_examples=30)
@given(curves, pitches)
def test_normalised_curves_are_the_same_curves(curve, pitch):
    image = pinhole_image_curve(curve, FOCAL, HEIGHT, pitch)
    center, (width, height) = (630.0, 350.0), (1280.0, 720.0)
    fractions = vector(normalised_image_curve(image, center, (width, height)))
    rows = photographed(curve, pitch)[:, 1]
    expected = (curve_columns(vector(image), rows) + center[0]) / width
    np.testing.assert_allclose(curve_columns(fractions, (rows + center[1]) / height), expected, rtol=1e-7, atol=1e-9)


def test_lanes_of_a_road_share_all_but_two_coefficients():
    """Eq. (8): parallel lines, which differ in b alone, share k'', f'', m'' and n'."""
    left, right = (
        pinhole_image_curve(GroundCurve(*map(np.float64, (1e-6, 3e-4, 0.1, b))), FOCAL, HEIGHT, 0.03)
        for b in (-1.8, 1.8)
    )
    np.testing.assert_allclose(left[:4], right[:4], rtol=1e-12)
    assert not np.allclose(left[4:], right[4:])


def test_the_horizon_is_a_pole_only_beyond_the_least_depth():
    curve = jnp.array([0.01, 0.4, 0.02, 0.3, 0.5, 0.1])
    rows = jnp.array([0.4, 0.4 + 1e-4, 0.39, 0.6])
    value, gradient = jax.value_and_grad(lambda c: curve_columns(c, rows, 1e-2).sum())(curve)
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()
    below = curve_columns(curve, rows, 1e-2)
    assert below[0] == pytest.approx(0.01 / 1e-4 + 2.0 + 0.3 + 0.2 - 0.1, rel=1e-5)
    np.testing.assert_allclose(below[3], curve_columns(curve, rows[3:])[0], rtol=1e-6)


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (1, 1)])
def test_sizes(shape):
    assert curve_columns(np.zeros((shape[0], 6)), np.ones(shape)).shape == shape


def test_lanes_are_in_order_where_the_outer_one_leaves_the_image_higher_up():
    """Lanes that meet in (0.5, 0.4) and are cut at the sides of an image of width 1: both outer right ones end at 1."""
    slopes = np.array([3.0, -0.4, -3.0, 0.8, 8.0])
    ends = np.minimum(0.4 + 0.5 / np.abs(slopes), 0.98)
    lanes = np.zeros((5, 8))
    ends[4] = 0.4 + 0.49 / slopes[4]
    lanes[:, 0], lanes[:, 1], lanes[:, 6], lanes[:, 5] = 0.45, ends, slopes, 0.5 - 0.4 * slopes
    assert order_from_left(lanes).tolist() == [2, 1, 3, 0, 4]
    assert np.argsort(0.5 + slopes * (ends - 0.4), kind="stable").tolist() != [2, 1, 3, 0, 4]  # at their own lower ends
    for count in (0, 1):
        assert order_from_left(lanes[:count]).tolist() == list(range(count))
