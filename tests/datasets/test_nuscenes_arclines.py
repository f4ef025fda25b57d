"""Arclines: exact integration against another formula, and against numbers that the devkit's own tests hold."""

import numpy as np
import pytest

from tflane_jax.datasets.nuscenes_arclines import SHAPES, lane_points, path_poses
from tflane_jax.errors import UserError

TURN = {"L": 1.0, "S": 0.0, "R": -1.0}
# Two real paths of one lane, with poses (x, y, yaw) at a resolution of 10 m and 2 m.
STRAIGHT = {
    "start_pose": [421.2419602954602, 1087.9127960414617, 2.739593514975998],
    "shape": "LSR",
    "radius": 999.999,
    "segment_length": [0.23651121617864976, 28.593481378991886, 3.254561444252876],
}
LEFT = {
    "start_pose": [391.7142849867393, 1100.464077182952, 2.7365754617298705],
    "shape": "LSL",
    "radius": 14.473414516079979,
    "segment_length": [22.380622583127813, 0.18854612175175053, 0.0010839266609007578],
}


def path(shape, lengths, radius=8.0, start=(3.0, -2.0, 0.4)):
    return {"shape": shape, "segment_length": list(lengths), "radius": radius, "start_pose": list(start)}


def integrated(one, distance, steps=20_000):
    """Return x, y and yaw by Simpson's rule on the heading, piece by piece."""
    x, y, yaw = one["start_pose"]
    for letter, length in zip(one["shape"], one["segment_length"], strict=True):
        length = min(length, max(distance, 0.0))
        along = np.linspace(0.0, length, 2 * steps + 1)
        weights = np.ones(2 * steps + 1)
        weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
        heading = yaw + TURN[letter] / one["radius"] * along
        place = (np.exp(1j * heading) * weights).sum() * length / (6 * steps)
        x, y, yaw, distance = x + place.real, y + place.imag, heading[-1], distance - length
    return x, y, yaw


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("lengths", [(4.0, 7.0, 2.5), (0.0, 7.0, 2.5), (4.0, 0.0, 0.0), (1e-5, 6.5, 30.0)])
def test_poses_are_the_integral_of_the_heading(shape, lengths):
    one = path(shape, lengths)
    found, total = path_poses(one, 0.5, "map"), sum(lengths)
    assert len(found) == int(np.ceil(total / 0.5)) + 1
    expected = [integrated(one, d) for d in np.linspace(0.0, total, len(found))]
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("one", "resolution", "count", "second", "last"),
    [
        (STRAIGHT, 10.0, 5, (413.85953060356087, 1091.049417600379), (391.71428498673856, 1100.4640771829522)),
        (LEFT, 2.0, 13, (389.94237388555354, 1101.0909492468568), (372.7733659833847, 1093.0160135871613)),
    ],
)
def test_the_devkits_numbers(one, resolution, count, second, last):
    """Inputs and results of `map_expansion/tests/test_arcline_path_utils.py`."""
    found = path_poses(one, resolution, "map")
    assert len(found) == count
    np.testing.assert_allclose(found[1, :2], second, rtol=1e-12)
    np.testing.assert_allclose(found[-1, :2], last, rtol=1e-12)


@pytest.mark.parametrize(
    ("length", "resolution", "count"), [(0.0, 0.5, 2), (0.2, 0.5, 2), (0.5, 0.5, 2), (0.51, 0.5, 3), (10.0, 3.0, 5)]
)
def test_number_of_points(length, resolution, count):
    assert len(path_poses(path("LSR", (0.0, length, 0.0)), resolution, "map")) == count


def test_a_lane_repeats_no_joint():
    points = lane_points([STRAIGHT, LEFT], 5.0, "map")
    assert len(points) == 8 + 6 - 1
    assert (np.linalg.norm(np.diff(points, axis=0), axis=-1) > 3.0).all()
    assert lane_points([], 5.0, "map").shape == (0, 2)
    # A path of no length is one point.
    assert len(lane_points([path("LSR", (0.0, 0.0, 0.0))], 0.5, "map")) == 1


@pytest.mark.parametrize("apart", [3e-4, 6e-4, -6e-4, 4e-3, -4e-3, 0.0])
def test_a_joint_that_does_not_quite_fit_is_one_point(apart):
    """A step of a millimetre, or of none after rounding, has no direction: boundaries would jump to the other side."""
    after = path("LSR", (0.0, 2.0, 0.0), start=(2.0 + apart, 5.0, 0.0))
    points = lane_points([path("LSR", (0.0, 2.0, 0.0), start=(0.0, 5.0, 0.0)), after], 0.5, "map")
    np.testing.assert_allclose(points, np.column_stack([np.linspace(0.0, 4.0, 9), np.full(9, 5.0)]), atol=5e-3)


def test_the_end_of_a_lane_stays():
    after = path("LSR", (0.0, 0.004, 0.0), start=(2.0, 5.0, 0.0))
    points = lane_points([path("LSR", (0.0, 2.0, 0.0), start=(0.0, 5.0, 0.0)), after], 0.5, "map")
    np.testing.assert_array_equal(points[:, 0], [0.0, 0.5, 1.0, 1.5, 2.004])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": "SSS"}, r"lane x\[0\]\.shape is 'SSS', expected one of LRL"),
        ({"radius": 0.0}, "radius 0 and segment lengths"),
        ({"radius": "wide"}, "radius is of type str"),
        ({"segment_length": [1.0, -1.0, 1.0]}, "must be positive"),
        ({"segment_length": [1.0, 2e7, 1.0]}, r"add up to 20000 km"),
        ({"segment_length": [1.0, 1.0]}, r"segment_length has shape \(2,\)"),
        ({"start_pose": [0.0, float("nan"), 0.0]}, "start_pose holds nan"),
    ],
)
def test_damaged_paths_are_named(change, message):
    with pytest.raises(UserError, match=message):
        lane_points([path("LSR", (1.0, 1.0, 1.0)) | change], 0.5, "lane x")
    with pytest.raises(UserError, match="lacks the entry 'shape'"):
        lane_points([{"start_pose": [0, 0, 0], "radius": 1.0, "segment_length": [1, 1, 1]}], 0.5, "lane x")
