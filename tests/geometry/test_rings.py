"""Which way rings run, and where they start."""

import numpy as np
import pytest

from tflane_jax.geometry.rings import from_first_corner, oriented, signed_area

SQUARE = np.array([[2, 1, 5], [6, 1, 6], [6, 4, 7], [2, 4, 8], [2, 1, 5]], float)  # counter-clockwise


def rolled(ring, steps):
    corners = np.roll(ring[:-1], steps, 0)
    return np.concatenate([corners, corners[:1]])


def test_the_area_is_positive_to_the_left_of_the_ring():
    assert signed_area(SQUARE) == 12.0
    assert signed_area(SQUARE[::-1]) == -12.0
    assert signed_area(SQUARE + 1e7) == 12.0
    assert signed_area(SQUARE[:1]) == 0.0


@pytest.mark.parametrize("turned", [False, True])
def test_exteriors_run_clockwise_and_interiors_the_other_way(turned):
    inner = np.array([[3, 2], [4, 2], [4, 3], [3, 2]], float)
    rings = [SQUARE[:, :2], inner]
    outside, *inside = oriented([ring[::-1] for ring in rings] if turned else rings)
    assert signed_area(outside) == -12.0
    assert [signed_area(ring) for ring in inside] == [0.5]
    assert oriented([]) == []


@pytest.mark.parametrize("steps", range(4))
def test_a_ring_starts_at_its_first_corner_with_its_heights(steps):
    found = from_first_corner(rolled(SQUARE, steps))
    np.testing.assert_array_equal(found, SQUARE)
    np.testing.assert_array_equal(from_first_corner(rolled(SQUARE[::-1], steps)), SQUARE[::-1])


def test_rounding_does_not_choose_the_corner():
    noise = np.random.default_rng(0).normal(size=(20, *SQUARE.shape)) * 1e-9
    starts = {tuple(from_first_corner(SQUARE + one)[0].round(6)) for one in noise}
    assert starts == {(2.0, 1.0, 5.0)}
