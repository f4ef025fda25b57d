"""Dense points of a map."""

import numpy as np
import pytest

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.scene import LineType
from tflane_jax.world.bev.map_samples import DASH, DASH_PERIOD, SPACING, sample_map


def one_line(kind, *, reverse=False, length=90.0):
    line = [(0.0, 0.0), (length, 0.0)]
    return segment(0, line[::-1] if reverse else line, left=kind, right=LineType.NONE)


def test_only_painted_boundaries_are_sampled():
    solid = sample_map(lane_map(one_line(LineType.SOLID)))
    assert solid.lines == 1
    np.testing.assert_allclose(solid.paint[:, 1], 1.75)
    np.testing.assert_allclose(np.diff(solid.paint[:, 0]), SPACING)
    np.testing.assert_allclose(solid.paint_along, solid.paint[:, 0])
    assert len(sample_map(lane_map(one_line(LineType.NONE))).paint) == 0


def test_dashes_have_their_length_and_do_not_depend_on_the_direction():
    x = np.sort(sample_map(lane_map(one_line(LineType.DASHED))).paint[:, 0])
    gaps = np.diff(x)[np.diff(x) > 2 * SPACING]
    np.testing.assert_allclose(gaps, DASH_PERIOD - DASH, atol=2 * SPACING)
    assert len(x) * SPACING == pytest.approx(90 * DASH / DASH_PERIOD, rel=0.1)
    back = sample_map(lane_map(one_line(LineType.DASHED, reverse=True))).paint[:, 0]
    distance = np.abs(back[:, None] - x)
    assert max(distance.min(0).max(), distance.min(1).max()) < 1.5 * SPACING


def test_a_line_that_neighbours_share_is_there_once():
    left = segment(0, [(0.0, 3.5), (30.0, 3.5)], left=LineType.NONE, right=LineType.DASHED)
    right = segment(1, [(0.0, 0.0), (30.0, 0.0)], left=LineType.DASHED, right=LineType.NONE)
    opposite = segment(2, [(30.0, 0.0), (0.0, 0.0)], left=LineType.NONE, right=LineType.SOLID)
    samples = sample_map(lane_map(left, right, opposite))
    assert samples.lines == 1
    assert set(samples.paint_line) == {0}


def test_crossings_are_filled():
    ring = np.array([[0, 0, 1], [4, 3, 1], [1, 7, 1], [-3, 4, 1], [0, 0, 1]], float)
    samples = sample_map(lane_map(crossings=(ring,)))
    assert len(samples.crossing) * SPACING**2 == pytest.approx(25.0, rel=0.03)
    np.testing.assert_allclose(samples.crossing.mean(0), [0.5, 3.5, 1.0], atol=0.1)


def test_an_empty_map_has_no_points():
    samples = sample_map(lane_map())
    assert (len(samples.paint), len(samples.edge), len(samples.crossing), samples.lines) == (0, 0, 0, 0)
