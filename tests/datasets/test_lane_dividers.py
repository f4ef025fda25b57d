"""Dividers from the boundaries of lanes."""

import numpy as np

from tests.datasets.small_logs import segment
from tflane_jax.datasets.lane_dividers import lane_dividers


def ends(dividers):
    return sorted(sorted(map(tuple, np.round(line[[0, -1], :2], 6).tolist())) for line in dividers)


def test_the_line_between_two_lanes_is_one_divider_and_outer_lines_are_none():
    lanes = [segment(0, [(0, 0), (40, 0)]), segment(1, [(0, 3.5), (40, 3.5)]), segment(2, [(40, 7), (0, 7)])]
    assert ends(lane_dividers(lanes)) == [[(0, 1.75), (40, 1.75)], [(0, 5.25), (40, 5.25)]]


def test_stretches_are_joined_whatever_their_direction_and_their_cuts():
    forward = [segment(0, [(0, 0), (25, 0)], [1]), segment(1, [(25, 0), (60, 0)])]
    backward = [segment(2, [(60, 3.5), (0, 3.5)])]
    for lanes in (forward + backward, backward + forward):
        (divider,) = lane_dividers(lanes)
        assert ends([divider]) == [[(0, 1.75), (60, 1.75)]]


def test_a_stretch_that_only_one_lane_has_is_no_divider():
    lanes = [segment(0, [(0, 0), (30, 0)], [1]), segment(1, [(30, 0), (60, 0)]), segment(2, [(30, 3.5), (60, 3.5)])]
    assert ends(lane_dividers(lanes)) == [[(30, 1.75), (60, 1.75)]]


def test_lanes_inside_intersections_have_no_dividers():
    lanes = [segment(n, [(0, 3.5 * n), (30, 3.5 * n)], is_intersection=True) for n in range(2)]
    assert lane_dividers(lanes) == []
    assert lane_dividers([]) == []


def test_a_median_keeps_lanes_apart():
    assert lane_dividers([segment(0, [(0, 0), (30, 0)]), segment(1, [(0, 5), (30, 5)])]) == []
