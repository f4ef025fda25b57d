"""Masks against the truth table of each pair, and the spatial mask against its definition entry by entry."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from tests.shared import random_mask
from tflane_jax.layers.masks import (
    SpatialMask,
    causal_mask,
    key_mask,
    nearest_mask,
    pair_mask,
    radius_mask,
    squared_line_distance,
    track_distance,
)


@pytest.mark.parametrize(("queries", "keys"), [(3, 4), (1, 1), (0, 2), (2, 0)])
def test_pairs(queries, keys):
    valid_queries, valid_keys = random_mask(0, queries), random_mask(1, keys)
    by_key = np.broadcast_to(key_mask(valid_keys), (queries, keys))
    by_pair = np.asarray(pair_mask(valid_queries, valid_keys))
    assert by_pair.shape == (queries, keys)
    for i in range(queries):
        for j in range(keys):
            assert by_key[i, j] == valid_keys[j]
            assert by_pair[i, j] == (valid_queries[i] and valid_keys[j])


@pytest.mark.parametrize(("lanes", "traffic"), [(4, 3), (1, 1), (0, 2), (3, 0)])
@pytest.mark.parametrize("host", ["no mask", "own mask"])
def test_spatial_mask_entry_by_entry(lanes, traffic, host):
    """Lanes attend to the lanes of the host's mask and to valid instances; valid instances to lanes and each other."""
    valid = random_mask(2, traffic)
    lane_mask = random_mask(3, lanes, lanes) if host == "own mask" else None
    dense = np.asarray(SpatialMask.from_validity(lanes, valid, lane_mask).dense())
    assert dense.shape == (lanes + traffic, lanes + traffic)
    for i in range(lanes + traffic):
        for j in range(lanes + traffic):
            if i < lanes and j < lanes:
                expected = lane_mask is None or lane_mask[i, j]
            else:
                expected = (i < lanes or valid[i - lanes]) and (j < lanes or valid[j - lanes])
            assert dense[i, j] == expected, (i, j)


def test_spatial_mask_works_under_vmap_and_takes_custom_quadrants():
    valid = random_mask(4, 5, 3)
    batch = jax.vmap(lambda v: SpatialMask.from_validity(2, v))(valid)
    assert batch.lane_lane is None
    dense = jax.vmap(SpatialMask.dense)(batch)
    for i in range(5):
        np.testing.assert_array_equal(dense[i], SpatialMask.from_validity(2, valid[i]).dense())

    near = random_mask(5, 2, 3)
    swapped = SpatialMask.from_validity(2, valid[0]).replace(lane_traffic=near)
    np.testing.assert_array_equal(swapped.dense()[:2, 2:], near)


def test_unused_quadrants_are_not_built():
    """4,000 x 4,000 lanes without a mask of the host's own must not cost 16 MB."""
    mask = SpatialMask.from_validity(4000, random_mask(6, 30))
    assert sum(leaf.size for leaf in jax.tree.leaves(mask)) <= 30 * 30 + 3 * 30  # quadrants, and the validity itself


@given(st.integers(0, 2**31), st.floats(0.5, 20.0))
def test_a_place_attends_to_lines_within_the_radius(seed, radius):
    rng = np.random.default_rng(seed)
    places, lines, valid = rng.uniform(-20, 20, (6, 2)), rng.uniform(-20, 20, (4, 5, 2)), np.arange(4) < 3
    expected = np.array(
        [[shapely.LineString(line).distance(shapely.Point(place)) for line in lines] for place in places]
    )
    clear = np.abs(expected - radius) > 1e-3
    lines[3] = np.nan
    mask = np.asarray(radius_mask(jnp.asarray(places, jnp.float32), jnp.asarray(lines, jnp.float32), valid, radius))
    np.testing.assert_array_equal(mask[clear], ((expected <= radius) & valid)[clear])


def test_a_line_at_the_radius_itself_is_within_it():
    places = jnp.array([[3.0, 4.0], [-5.0, 0.0], [3.0, 4.25]])
    np.testing.assert_array_equal(radius_mask(places, jnp.zeros((1, 1, 2)), jnp.ones(1, bool), 5.0)[:, 0], [1, 1, 0])


def test_a_line_without_length_is_a_point():
    mask = radius_mask(jnp.array([[3.0, 0.0], [3.1, 0.0]]), jnp.zeros((1, 2, 2)), jnp.ones(1, bool), 3.05)
    np.testing.assert_array_equal(mask, [[True], [False]])
    assert radius_mask(jnp.zeros((2, 2)), jnp.zeros((0, 2, 2)), jnp.ones(0, bool), 1.0).shape == (2, 0)


@pytest.mark.parametrize("points", [0, 1, 2])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_lines_of_no_and_of_one_point(points, count):
    """Regression: radius_mask and squared_line_distance ended with a TypeError for lines of one point."""
    rng = np.random.default_rng(10 * points + count)
    places, lines = rng.uniform(-5, 5, (4, 2)), rng.uniform(-5, 5, (count, points, 2))
    apart = np.full((4, count), np.inf)
    if points:  # a straight line of one or two points, the same point by point
        dense = lines[:, :1] + np.linspace(0, 1, 2001)[:, None] * (lines[:, -1:] - lines[:, :1])
        apart = np.sqrt(((dense[None] - places[:, None, None]) ** 2).sum(-1)).min(-1)
    mask = radius_mask(jnp.asarray(places), jnp.asarray(lines), jnp.ones(count, bool), 4.0)
    np.testing.assert_array_equal(mask, apart <= 4.0)
    np.testing.assert_allclose(
        squared_line_distance(jnp.asarray(places), jnp.asarray(lines)), apart.T**2, rtol=1e-2, atol=1e-3
    )
    assert radius_mask(jnp.zeros((0, 2)), jnp.asarray(lines), jnp.ones(count, bool), 4.0).shape == (0, count)


@pytest.mark.parametrize(("lanes", "tracks", "positions"), [(2, 3, 0), (2, 0, 4), (0, 3, 4), (2, 0, 0)])
def test_distances_without_lanes_tracks_or_positions(lanes, tracks, positions):
    """Regression: tracks without positions had no minimum."""
    found = track_distance(
        jnp.zeros((lanes, 5, 2)), jnp.zeros((tracks, positions, 2)), jnp.ones((tracks, positions), bool)
    )
    np.testing.assert_array_equal(found, np.full((lanes, tracks), np.inf))


@pytest.mark.parametrize("points", [1, 2, 5])
def test_distance_of_lanes_and_tracks_against_shapely(points):
    """The nearest valid position of a track counts; what is not valid may hold NaN."""
    rng = np.random.default_rng(points)
    lanes, tracks = rng.uniform(-20, 20, (6, points, 2)), rng.uniform(-20, 20, (4, 7, 2))
    valid = rng.random((4, 7)) < 0.6
    valid[2] = False
    holes = jnp.asarray(np.where(valid[..., None], tracks, np.nan))
    found = np.asarray(track_distance(jnp.asarray(lanes), holes, jnp.asarray(valid)))
    for i, lane in enumerate(lanes):
        shape = shapely.Point(lane[0]) if points == 1 else shapely.LineString(lane)
        for j, track in enumerate(tracks):
            own = [shape.distance(shapely.Point(place)) for place in track[valid[j]]]
            assert found[i, j] == pytest.approx(min(own, default=np.inf), rel=1e-4)


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_nearest_keys_first_ones_of_equal_distance(count):
    distance = np.array([[3.0, 1.0, 1.0, np.inf, 2.0], [np.inf] * 5, [1.0] * 5])
    found = np.asarray(nearest_mask(jnp.asarray(distance), count))
    for row, own in zip(distance, found, strict=True):
        order = [i for i in np.argsort(row, kind="stable") if np.isfinite(row[i])][:count]
        assert set(np.flatnonzero(own)) == set(order)


@pytest.mark.parametrize("heads", [(), (2,)])
def test_restrictions_are_composed_entry_by_entry(heads):
    valid, one, other = random_mask(7, 3), random_mask(8, *heads, 4, 3), random_mask(9, 4, 3)
    lane_mask = random_mask(10, 4, 4)
    mask = SpatialMask.from_validity(4, valid, lane_mask).restricted(one).restricted(other)
    dense, free = np.asarray(mask.dense()), np.asarray(SpatialMask.from_validity(4, valid, lane_mask).dense())
    assert dense.shape == (*heads, 7, 7)
    pairs = np.broadcast_to(np.asarray(one) & np.asarray(other), (*heads, 4, 3)).reshape(-1, 4, 3)
    for own, allowed in zip(dense.reshape(-1, 7, 7), pairs, strict=True):
        expected = free.copy()
        expected[:4, 4:] &= allowed
        expected[4:, :4] &= allowed.T
        np.testing.assert_array_equal(own, expected)


def test_each_group_of_lanes_has_its_copy_of_the_instances():
    """Entry by entry: within a group as without groups, between groups nothing."""
    valid, pairs = random_mask(0, 3), random_mask(1, 2, 5, 3)
    whole = SpatialMask.from_validity(
        5, jnp.asarray(valid), jnp.asarray(np.arange(5)[:, None] // 2 == np.arange(5) // 2)
    )
    whole = whole.restricted(jnp.asarray(pairs))
    copies = whole.by_group((2, 3))
    np.testing.assert_array_equal(copies.valid, np.tile(valid, 2))
    single, dense = (np.asarray(mask.dense()) for mask in (whole, copies))
    np.testing.assert_array_equal(dense[:, :5, :5], single[:, :5, :5])
    groups = [*range(2), 5, 6, 7], [*range(2, 5), 8, 9, 10]
    for members, lanes in zip(groups, (slice(2), slice(2, 5)), strict=True):
        kept = [*range(5)[lanes], 5, 6, 7]
        np.testing.assert_array_equal(dense[:, members][:, :, members], single[:, kept][:, :, kept])
    assert not dense[:, groups[0]][:, :, [8, 9, 10]].any()
    assert not dense[:, groups[1]][:, :, [5, 6, 7]].any()
    assert not dense[:, [5, 6, 7]][:, :, groups[1]].any()


@pytest.mark.parametrize("frames", [0, 1, 4])
def test_a_frame_sees_itself_and_earlier_ones(frames):
    expected = [[j <= i for j in range(frames)] for i in range(frames)]
    assert np.asarray(causal_mask(frames)).tolist() == expected


@pytest.mark.parametrize("shape", [(3, 3), (1, 3), (4, 2), (2, 3, 3)])
def test_a_restriction_is_of_all_lanes_and_instances(shape):
    mask = SpatialMask.from_validity(4, jnp.ones(3, bool))
    wanted = re.escape(f"pairs have shape {shape}, expected ([H,] L, T) = ([H,] 4, 3)")
    with pytest.raises(ValueError, match=wanted):
        mask.restricted(jnp.ones(shape, bool))
