"""Boundaries of lanes from center lines and outlines that can be drawn on paper."""

import numpy as np

from tflane_jax.datasets.lane_outlines import HALF_WIDTH, LaneOutline, boundaries, half_widths

ALONG = np.column_stack([np.linspace(0.0, 20.0, 21), np.zeros(21)])


def moved(line, x, y):
    return line + np.array([x, y])


def ring(*points):
    return np.array([*points, points[0]], float)


def test_sides_lie_on_the_outline():
    lane = LaneOutline(ALONG, ring((0, -2), (20, -2), (20, 1.5), (0, 1.5)))
    left, right = boundaries({0: lane}, {})[0]
    np.testing.assert_allclose(left, moved(ALONG, 0.0, 1.5), atol=1e-9)
    np.testing.assert_allclose(right, moved(ALONG, 0.0, -2.0), atol=1e-9)
    # Against the direction of driving, left and right are exchanged.
    left, right = boundaries({0: LaneOutline(ALONG[::-1], lane.outline)}, {})[0]
    np.testing.assert_allclose(left, moved(ALONG[::-1], 0.0, -2.0), atol=1e-9)
    np.testing.assert_allclose(right, moved(ALONG[::-1], 0.0, 1.5), atol=1e-9)


def test_slanted_ends_and_lines_longer_than_the_outline_keep_the_width():
    # The outline is cut off slantingly at both ends, and the center line sticks out of it.
    lane = LaneOutline(ALONG, ring((2, -2), (16, -2), (19, 2), (5, 2)))
    widths = half_widths(lane)
    np.testing.assert_allclose(widths[:, 6:15], 2.0, atol=1e-9)
    assert widths.min() > 1.2
    np.testing.assert_allclose(widths[:, [0, -1]], 2.0, atol=0.7)


def test_without_an_outline_the_width_goes_from_the_lane_before_to_the_lane_after():
    before = LaneOutline(moved(ALONG, -20.0, 0.0), ring((-20, -2), (0, -2), (0, 1), (-20, 1)))
    after = LaneOutline(moved(ALONG, 20.0, 0.0), ring((20, -1), (40, -1), (40, 3), (20, 3)))
    lanes = {1: before, 2: LaneOutline(ALONG, None), 3: after, 4: LaneOutline(moved(ALONG, 0.0, 50.0), None)}
    found = boundaries(lanes, {1: (2, 99), 2: (3,)})
    np.testing.assert_allclose(found[2][0][:, 1], np.linspace(1.0, 3.0, 21), atol=1e-9)
    np.testing.assert_allclose(found[2][1][:, 1], np.linspace(-2.0, -1.0, 21), atol=1e-9)
    # Of a lane alone nothing is known.
    np.testing.assert_allclose(found[4][0][:, 1], 50.0 + HALF_WIDTH)
    # With one neighbour, its width holds throughout.
    np.testing.assert_allclose(boundaries({1: before, 2: lanes[2]}, {1: (2,)})[2][0][:, 1], 1.0, atol=1e-9)
    np.testing.assert_allclose(boundaries({2: lanes[2], 3: after}, {2: (3,)})[2][1][:, 1], -1.0, atol=1e-9)


def test_outlines_that_are_no_sides_count_as_none():
    assert half_widths(LaneOutline(ALONG, None)) is None
    assert half_widths(LaneOutline(ALONG, np.zeros((2, 2)))) is None
    far = ring((0, -30), (20, -30), (20, 30), (0, 30))
    assert half_widths(LaneOutline(ALONG, far)) is None
    assert half_widths(LaneOutline(ALONG, ring((0, 5), (20, 5), (20, 6), (0, 6)))) is None  # beside the line


def test_a_line_that_turns_back_has_finite_sides():
    line = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 0.0], [0.0, 5.0]])
    left, right = boundaries({0: LaneOutline(line, None)}, {})[0]
    assert np.isfinite(left).all()
    assert np.isfinite(right).all()
    np.testing.assert_allclose(np.linalg.norm(left - right, axis=-1), 2 * HALF_WIDTH)
