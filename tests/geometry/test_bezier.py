"""Bezier matrices against curves drawn by de Casteljau's rule."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.geometry.bezier import bezier_basis, bezier_fit


def casteljau(controls, t):
    while len(controls) > 1:
        controls = (1 - t) * controls[:-1] + t * controls[1:]
    return controls[0]


@settings(max_examples=30)
@given(st.integers(2, 7), st.integers(0, 5), st.integers(0, 1000))
def test_a_curve_is_drawn_and_found_again(controls, more, seed):
    corners = np.random.default_rng(seed).normal(size=(controls, 3)) * 20
    points = controls + more
    line = bezier_basis(points, controls) @ corners
    expected = [casteljau(corners, t) for t in np.linspace(0, 1, points)]
    np.testing.assert_allclose(line, expected, atol=1e-9)
    np.testing.assert_allclose(bezier_fit(points, controls) @ line, corners, atol=1e-6)


def test_the_fit_keeps_the_ends_and_is_the_best_of_those_that_do():
    line = np.cumsum(np.random.default_rng(0).normal(size=(11, 3)), 0)
    fit, basis = bezier_fit(11, 5) @ line, bezier_basis(11, 5)
    np.testing.assert_array_equal(fit[[0, -1]], line[[0, -1]])
    error = ((basis @ fit - line) ** 2).sum()
    for row in range(1, 4):
        for axis in range(3):
            for step in (-1e-3, 1e-3):
                moved = fit.copy()
                moved[row, axis] += step
                assert ((basis @ moved - line) ** 2).sum() > error


@pytest.mark.parametrize(("points", "controls"), [(4, 5), (3, 1)])
def test_too_few_points_are_an_error(points, controls):
    with pytest.raises(ValueError, match=f"{points} points do not determine {controls}"):
        bezier_fit(points, controls)
