"""Plausible lanes: they meet on the horizon, do not cross, and lie on paint, on drawn roads."""

import numpy as np
import pytest

from tflane_jax.datasets.photos import HORIZON, Placement
from tflane_jax.evaluation.photo_lanes import (
    agreement,
    common_horizon,
    is_blank,
    judge_lanes,
    plausibility,
    without_crossings,
)

cv2 = pytest.importorskip("cv2")
WHOLE = Placement(0, 0, 1280, 720)
FEET = (-0.6, 0.15, 0.85, 1.6)  # columns of the lanes at the lower end, fractions of the view


def lane(foot, ahead=0.5, horizon=HORIZON, end=1.0):
    """Return a straight lane from the horizon to the lower end of the view."""
    v = np.linspace(horizon, end, 100)
    return np.stack([ahead + (foot - ahead) * (v - horizon) / (1.0 - horizon), v], -1)


def road(feet=FEET, view=WHOLE, size=(720, 1280), dashes=1):
    """Return a photo in which a view shows paint, 10 cm wide on the road, along these lanes."""
    grey = np.full(size, 90, np.uint8)
    for foot in feet:
        u, v = lane(foot).T
        half = 0.05 * (v - HORIZON) * 720 / 1.5 / 1280
        for i in range(0, 99, dashes):
            corners = [(u[i] - half[i], v[i]), (u[i] + half[i], v[i])]
            corners += [(u[i + 1] + half[i + 1], v[i + 1]), (u[i + 1] - half[i + 1], v[i + 1])]
            cv2.fillPoly(grey, [np.round(view.to_photo(np.array(corners))).astype(np.int32)], 200)
    return grey


def judged(grey, lanes, view=WHOLE):
    return judge_lanes(grey, view, lanes, np.ones(len(lanes)))


def test_lanes_on_paint_that_meet_on_the_horizon_are_plausible():
    found = judged(road(), [lane(foot) for foot in FEET])
    assert found.value > 1.0
    assert not found.crossed
    assert found.meeting == pytest.approx((640, HORIZON * 720), abs=2)
    assert min(found.paint) > 0.7
    assert all(found.supported)
    dashed = judged(road(dashes=5), [lane(foot) for foot in FEET])
    assert 0.2 < np.mean(dashed.paint) < 0.6
    assert found.value > dashed.value > 0.3


def test_a_part_of_a_photo_is_judged_like_the_whole():
    view = Placement(300, 150, 640, 360)
    found = judged(road(view=view, size=(600, 1000)), [lane(foot) for foot in FEET], view)
    assert found.value > 0.8
    assert found.meeting == pytest.approx((620, 150 + HORIZON * 360), abs=2)


@pytest.mark.parametrize(
    ("lanes", "most"),
    [
        ([], 0.0),
        ([lane(0.15)], 0.0),
        ([lane(0.3), lane(0.7)], 0.15),  # beside the paint
        ([lane(0.15, horizon=0.6), lane(0.85, horizon=0.6)], 0.0),  # meet far below the horizon
        ([lane(0.15, ahead=0.8), lane(0.85, ahead=0.2)], 0.0),  # cross
        ([lane(0.15, end=0.34), lane(0.85, end=0.34)], 0.0),  # above the horizon
    ],
)
def test_other_lanes_are_not(lanes, most):
    found = judged(road(), lanes)
    assert found.value <= most + 1e-3


def test_crossed_lanes_are_told():
    assert judged(road(), [lane(0.15, ahead=0.8), lane(0.85, ahead=0.2)]).crossed
    assert not judged(road(), [lane(0.15), lane(0.85)]).crossed
    # Straight lines through them meet on the horizon, but one bends across the other.
    bent = lane(0.85)
    bent[:, 0] -= 0.8 * np.sin(np.pi * (bent[:, 1] - HORIZON) / (1.0 - HORIZON)) ** 8
    assert judged(road(), [lane(0.15), bent]).crossed


def test_an_arrow_is_no_lane_line():
    grey = road(feet=(0.15, 0.85))
    grey[480:520, 600:680] = 200
    found = judged(grey, [lane(0.15), lane(0.5), lane(0.85)])
    assert found.supported == (True, False, True)
    assert 0.0 < found.paint[1] < 0.4


def test_texture_everywhere_is_no_road():
    noise = np.random.default_rng(0).integers(0, 256, (720, 1280), np.uint8)
    assert judged(noise, [lane(foot) for foot in FEET]).value < 0.05


def test_the_horizon_is_where_most_lanes_meet():
    grey, lanes = road(), [lane(foot) for foot in FEET]
    other = [lane(0.15, horizon=0.5), lane(0.85, horizon=0.5)]
    found = [judged(grey, lanes), judged(grey, lanes[1:3]), judged(grey, other), judged(grey, [])]
    assert common_horizon(found, 720) == pytest.approx((640, HORIZON * 720), abs=3)
    assert common_horizon([judged(grey, [])], 720) is None


def test_lanes_agree_as_far_as_other_views_show_them():
    one, other, short = (lane(foot) * (1280, 720) for foot in (0.15, 0.85, 0.15))
    short = short[50:]
    shown = agreement([one, other, short], [[one, other], [short], []], [0.6, 0.2, 0.2], (720, 1280))
    np.testing.assert_allclose(shown, [0.6 + 0.2 * 0.5, 0.6, 0.8], atol=0.02)
    beside = one + np.array([0.03 * 1280, 0])
    np.testing.assert_allclose(agreement([beside], [[one]], [1.0], (720, 1280)), 0, atol=0.02)
    assert agreement([], [[one]], [1.0], (720, 1280)).shape == (0,)
    np.testing.assert_array_equal(agreement([one, one[:0]], [], [], (720, 1280)), [0, 0])


def test_of_equal_views_that_with_longer_lanes_and_more_agreement_is_more_plausible():
    lanes = [lane(0.15) * (1280, 720), lane(0.85) * (1280, 720)]
    agreed = np.array([0.5, 0.5])
    whole = plausibility(0.3, agreed, lanes, 720)
    assert plausibility(0.3, agreed, [one[:50] for one in lanes], 720) == pytest.approx(whole * 49 / 99)
    assert plausibility(0.3, agreed / 4, lanes, 720) == pytest.approx(whole / 2)
    assert plausibility(0.0, agreed, lanes, 720) == 0
    assert plausibility(0.3, agreed[:0], [], 720) == 0


@pytest.mark.parametrize(
    ("grey", "blank"),
    [
        (np.zeros((9, 16), np.uint8), True),
        (np.full((9, 16), 128, np.uint8), True),
        (np.eye(900, 1600).astype(np.uint8) * 255, True),  # a few bright pixels
        (np.tile(np.arange(160, dtype=np.uint8), (90, 1)), False),
    ],
)
def test_empty_photos(grey, blank):
    assert is_blank(grey) == blank


def test_of_lanes_that_cross_the_better_one_is_kept():
    scale = np.array([1280, 720])
    lanes = [lane(foot, ahead) * scale for foot, ahead in ((0.1, 0.5), (0.9, 0.1), (1.4, 0.55))]
    np.testing.assert_array_equal(without_crossings(lanes, [0.9, 0.5, 0.7], 1280), [True, False, True])
    np.testing.assert_array_equal(without_crossings(lanes, [0.4, 0.5, 0.3], 1280), [False, True, True])
    apart = [lanes[0][:40], lanes[1][60:]]  # they share no row
    np.testing.assert_array_equal(without_crossings(apart, [1, 1], 1280), [True, True])
    assert without_crossings([], [], 1280).shape == (0,)
