"""The perception range and the BEV grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.geometry import BevGrid, PerceptionRange

RANGE = PerceptionRange((-50.0, 30.0), (-20.0, 25.0), (-2.0, 3.0))


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), dims=st.sampled_from([2, 3]))
def test_normalise_and_back(seed, dims):
    points = np.random.default_rng(seed).uniform(-80, 80, (4, 3, dims))
    unit = RANGE.normalise(points)
    np.testing.assert_allclose(RANGE.denormalise(unit), points, atol=1e-12)
    np.testing.assert_array_equal(RANGE.contains(points), ((unit[..., :2] >= 0) & (unit[..., :2] <= 1)).all(-1))


def test_corners():
    low, high = np.array([RANGE.low()]), np.array([RANGE.low()]) + np.array([RANGE.size()])
    np.testing.assert_allclose(RANGE.normalise(low), [[0, 0, 0]])
    np.testing.assert_allclose(RANGE.normalise(high), [[1, 1, 1]])
    assert RANGE.contains(np.concatenate([low, high])).all()
    assert RANGE.contains(np.array([0.0, 0.0, 99.0]))  # z is not looked at
    assert not RANGE.contains(np.array([0.0, 25.001, 0.0]))


def test_pixel_of_each_cell_center_is_its_index():
    grid = BevGrid(RANGE, rows=9, columns=16)
    assert grid.cell == pytest.approx((5.0, 5.0))
    x, y = grid.centers()
    points = np.stack(np.meshgrid(x, y), -1)
    expected = np.stack(np.meshgrid(np.arange(16), np.arange(9)), -1)
    np.testing.assert_allclose(grid.pixel(points), expected, atol=1e-12)


def test_device_equals_host_with_points_of_any_rank():
    grid = BevGrid(RANGE, rows=9, columns=16)
    points = np.random.default_rng(0).uniform(-20, 20, (2, 5, 3)).astype(np.float32)
    with jax.numpy_rank_promotion("raise"):
        for function in (RANGE.normalise, RANGE.denormalise, RANGE.contains, grid.pixel):
            np.testing.assert_allclose(jax.jit(function)(jnp.asarray(points)), function(points), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_whole_numbers_give_what_floats_give(array):
    """The borders of this range are no whole numbers."""
    grid = BevGrid(PerceptionRange((-51.2, 51.2), (-25.6, 25.6), (-2.3, 1.7)))
    points = np.array([[3, -7, 1], [0, 0, 0], [1, 1, 1]])
    for function in (grid.range.normalise, grid.range.denormalise, grid.pixel):
        found, expected = function(array(points)), function(points.astype(np.float64))
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
