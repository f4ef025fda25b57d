"""Touching buffers against shapely and against figures drawn by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.metrics.buffers import buffers_touch

ZERO = np.array([0])


def touch(a, b):
    """Return whether two lines of any number of vertices, 2 m wide on each side, touch (and that order is free)."""
    a, b = (np.asarray(line, float)[None] for line in (a, b))
    (forth,), (back,) = buffers_touch(a, b, ZERO, ZERO, 2.0), buffers_touch(b, a, ZERO, ZERO, 2.0)
    assert forth == back
    return forth


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ([(0, 0), (10, 0)], [(0, 4), (10, 4)], True),  # 2 m + 2 m to the side: touching counts
        ([(0, 0), (10, 0)], [(0, 4.01), (10, 4.01)], False),
        ([(0, 0), (10, 0)], [(10, 0), (20, 0)], True),  # ends are flat
        ([(0, 0), (10, 0)], [(10.01, 0), (20, 0)], False),
        ([(0, 0), (10, 0)], [(10.01, 0), (11, 5)], True),  # its slanted end reaches back
        ([(0, 0), (0.5, 0)], [(0.9, 0), (1.4, 0)], False),  # short pieces end to end
        ([(0, 0), (10, 0)], [(5, 1), (5, 1)], False),  # no length, no buffer
        ([(0, 0), (0, 0), (10, 0)], [(3, 1), (4, 1), (4, 1)], True),  # repeated vertices change nothing
        # The tip of the mitre at (12, -2): the bevel would end at x - y = 12.
        ([(0, 0), (10, 0), (10, 10)], [(11.9, -1.9), (14, -4)], True),
        ([(0, 0), (10, 0), (10, 10)], [(12.1, -2.1), (14, -4)], False),
        ([(0, 0), (10, 0), (10, 0), (10, 10)], [(11.9, -1.9), (14, -4)], True),
        # A bend of 168 degrees: its tip would lie 10 radii away, so it is cut off after five.
        ([(0, 0), (10, 0), (0, 2)], [(19.8, -1), (24, -1.4)], True),
        ([(0, 0), (10, 0), (0, 2)], [(20.1, -1), (24, -1.4)], False),
        ([(0, 0), (10, 0), (0, 0)], [(19.9, 0), (25, 0)], True),  # there and back again
        ([(0, 0), (10, 0), (0, 0)], [(20.1, 0), (25, 0)], False),
    ],
)
def test_by_hand(a, b, expected):
    assert touch(a, b) == expected


def test_pairs_are_independent():
    lines = np.array([[(0, 0), (10, 0)], [(0, 30), (10, 30)], [(0, 3), (10, 3)]], float)
    i, j = np.nonzero(np.ones((3, 3)))
    expected = [[True, False, True], [False, True, False], [True, False, True]]
    np.testing.assert_array_equal(buffers_touch(lines, lines, i, j, 2.0).reshape(3, 3), expected)
    assert buffers_touch(lines, lines, i[:0], j[:0], 2.0).shape == (0,)


def agrees_with_shapely(a, b):
    """Check the answer on two lines, except where it depends on less than GEOS's own roundings."""
    shapely = pytest.importorskip("shapely")
    shapes = [shapely.LineString(x).buffer(2.0, cap_style="flat", join_style="mitre") for x in (a, b)]
    # GEOS simplifies lines by a hundredth of the radius before it widens them.
    if shapes[0].distance(shapes[1]) > 0.02:
        assert not touch(a, b)
    elif shapes[0].intersection(shapes[1]).area > 0.06:
        assert touch(a, b)


def bent(rng, start, turns, steps):
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(turns)
    steps = rng.uniform(*steps, (len(heading), 1)) * np.stack([np.cos(heading), np.sin(heading)], -1)
    return start + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])


@settings(max_examples=150)
@given(seed=st.integers(0, 10**6))
def test_shapely_agrees(seed):
    rng = np.random.default_rng(seed)

    def line(start):
        # Bends below 90 degrees. Steps longer than the radius: where a bend's inner side outgrows its segments, GEOS's
        # outline is not the union of pieces.
        return bent(rng, start, rng.uniform(-1.5, 1.5, rng.integers(1, 5)), (2.5, 6.0))

    agrees_with_shapely(line(np.zeros(2)), line(rng.uniform(-9, 9, 2)))


@settings(max_examples=150)
@given(seed=st.integers(0, 10**6), turn=st.floats(1.5, 3.14))
def test_shapely_agrees_at_hairpins(seed, turn):
    """One bend of up to 180 degrees: from 157 degrees on, its tip is cut off."""
    rng = np.random.default_rng(seed)
    a = bent(rng, np.zeros(2), [0.0, rng.choice([-1, 1]) * turn], (11.0, 16.0))
    tip = a[1] - 10.0 * (a[0] + a[2] - 2 * a[1]) / np.linalg.norm(a[0] + a[2] - 2 * a[1])
    agrees_with_shapely(a, bent(rng, tip + rng.uniform(-4, 4, 2), [0.0], (1.0, 6.0)))
