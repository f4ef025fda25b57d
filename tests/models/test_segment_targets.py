"""Lane segments and crossings as one set of targets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.geometry import resample
from tflane_jax.models.segment_targets import CROSSING, LANE, crossing_sides, segment_targets
from tflane_jax.scene import Areas, AreaType, LaneGraph, LineType

sides = jax.jit(crossing_sides, static_argnums=1)


def corners(angle, length=12.0, width=3.0, middle=(5.0, -2.0)):
    """Return the corners of a crossing, counter-clockwise, whose long sides head in `angle` degrees; it rises by 1 m."""
    turn = np.deg2rad(angle)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    flat = [u * length / 2 * along + v * width / 2 * across for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    ring = np.concatenate([np.array(flat) + middle, [[0.0], [1.0], [1.0], [0.0]]], 1)
    return np.concatenate([ring, ring[:1]]).astype(np.float32)


@pytest.mark.parametrize("angle", [-44, 0, 30, 90, 134])
@pytest.mark.parametrize("form", ["corners", "resampled", "backward", "other start"])
def test_sides_of_a_crossing_are_its_long_ones_and_head_along_the_road_users(angle, form):
    ring = whole = corners(angle)
    if form == "resampled":
        ring = resample(ring, 20)
    if form == "backward":
        ring = ring[::-1]
    if form == "other start":
        ring = np.concatenate([ring[2:4], ring[:3]])
    left, right = (np.asarray(side[0]) for side in sides(ring[None], 10))
    # Up to the corners that resampling has cut, in height only.
    height = 0.2 if form == "resampled" else 1e-4
    for found, start, end in ((left, whole[3], whole[2]), (right, whole[0], whole[1])):
        expected = start + np.linspace(0, 1, 10)[:, None] * (end - start)
        np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-4)
        np.testing.assert_allclose(found[:, 2], expected[:, 2], atol=height)


@pytest.mark.parametrize("angle", [-46, 136, 180])
def test_a_crossing_that_heads_the_other_way_is_turned(angle):
    one, other = sides(corners(angle)[None], 4), sides(corners(angle - 180)[None], 4)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a[..., :2], b[..., :2], atol=1e-4)  # the other crossing falls by 1 m
    heading = np.asarray(one[0][0, -1] - one[0][0, 0])
    assert heading[0] + heading[1] > 0


def graph(count, capacity, garbage=0.0):
    lanes = LaneGraph.empty(capacity, 4)
    rows = np.arange(capacity) >= capacity - count  # padding first
    lines = {name: np.full((capacity, 4, 3), garbage, np.float32) for name in ("points", "left", "right")}
    for i, name in enumerate(lines):
        lines[name][rows] = np.arange(capacity)[rows, None, None] + 10.0 * i
    types = np.where(rows, LineType.DASHED, 99).astype(np.int32)
    successor = np.arange(capacity)[:, None] + 1 == np.arange(capacity)
    return lanes.replace(**lines, left_type=types, right_type=types, successor=successor, valid=rows)


def areas(crossings, capacity, garbage=0.0):
    found = Areas.empty(capacity, 5)
    rings = np.full((capacity, 5, 3), garbage, np.float32)
    category = np.full(capacity, AreaType.ROAD_BOUNDARY, np.int32)
    valid = np.arange(capacity) <= crossings  # the last valid one is a boundary
    rings[:crossings], category[:crossings] = corners(20.0), AreaType.PEDESTRIAN_CROSSING
    rings[valid & (category == AreaType.ROAD_BOUNDARY)] = 1.0
    return found.replace(points=rings, category=category, valid=valid)


@pytest.mark.parametrize("garbage", [0.0, np.nan])
def test_valid_targets_come_first_and_keep_their_edges(garbage):
    found = jax.jit(segment_targets)(graph(3, 5, garbage), areas(1, 3, garbage))
    np.testing.assert_array_equal(found.valid, np.arange(8) < 4)
    np.testing.assert_array_equal(found.category[:4], [LANE, LANE, LANE, CROSSING])
    np.testing.assert_array_equal(found.lanes.points[:3, 0, 0], [2, 3, 4])
    np.testing.assert_array_equal(found.lanes.right[:3, 0, 0], [22, 23, 24])
    np.testing.assert_array_equal(found.lanes.left_type[:4], [2, 2, 2, LineType.NONE])
    edges = np.zeros((8, 8), bool)
    edges[[0, 1], [1, 2]] = True
    np.testing.assert_array_equal(found.lanes.successor, edges)
    crossing = found.lanes
    np.testing.assert_allclose(crossing.points[3], (crossing.left[3] + crossing.right[3]) / 2, atol=1e-6)
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(leaf).all()
    for line in (crossing.points, crossing.left, crossing.right):
        assert not np.asarray(line)[4:].any()
    assert found.lines.shape == (8, 3, 4, 3)
    found.lanes.validate()


@pytest.mark.parametrize(("lanes", "capacity", "crossings", "slots"), [(0, 0, 0, 1), (0, 2, 0, 0), (1, 1, 1, 2), (2, 2, 0, 0)])
def test_sizes_0_and_1(lanes, capacity, crossings, slots):
    truth = areas(crossings, slots) if slots else Areas.empty(0, 5)
    found = jax.jit(segment_targets)(graph(lanes, capacity), truth)
    assert int(found.valid.sum()) == lanes + crossings
    assert found.lines.shape == (capacity + slots, 3, 4, 3)
    assert jnp.isfinite(found.lines).all()
