"""Lanes of markers as a BEV raster against plain loops; order and padding change nothing, motion moves it along."""

import itertools
import math
from collections import defaultdict
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.priors.marker_memory import MarkerGuidance
from tflane_jax.priors.marker_raster import CHANNELS, rasterise_markers

GRID = BevGrid(PerceptionRange((-20.0, 20.0), (-10.0, 10.0)), rows=10, columns=20)
rasterise = jax.jit(rasterise_markers, static_argnums=(1, 2))


def guidance(seed, lanes=5, points=4, padding=2, gate=0.8):
    """Random lines, some of which leave the grid, and padding of NaN."""
    rng = np.random.default_rng(seed)
    line = np.cumsum(rng.uniform(-6, 6, (lanes, points, 2)), 1) + rng.uniform(-8, 8, (lanes, 1, 2))
    weight, valid = rng.uniform(0.1, 1.0, lanes), np.ones(lanes, bool)
    line[-padding:], weight[-padding:], valid[-padding:] = np.nan, np.nan, False
    line, weight = line.astype(np.float32), weight.astype(np.float32)
    return MarkerGuidance(line, weight, weight, np.float32(gate), np.zeros((lanes, lanes), bool), valid)


def loop_raster(lanes, grid, between):
    """Return the raster by loops over lanes and points."""
    (dx, dy), (x0, y0) = grid.cell, grid.range.low(2)
    found = defaultdict(list)
    for line, weight in zip(lanes.points[lanes.valid].astype(float), lanes.weight[lanes.valid], strict=True):
        places = []
        for a, b in itertools.pairwise(line):
            length = math.dist(a, b)
            direction = (b - a) / length if length else np.zeros(2)
            places += [(a + k / (between + 1) * (b - a), direction) for k in range(between + 1)]
        places.append((line[-1], direction))
        for number, ((x, y), direction) in enumerate(places):
            u, v = (x - x0) / dx, (y - y0) / dy
            if 0 <= u < grid.columns and 0 <= v < grid.rows:
                row = [*direction, u % 1 - 0.5, v % 1 - 0.5, number == 0, number == len(places) - 1]
                found[int(v) * grid.columns + int(u)].append((weight * float(lanes.gate), row))
    features = np.zeros((grid.rows * grid.columns, CHANNELS))
    for cell, hits in found.items():
        factor = np.array([hit[0] for hit in hits])
        means = np.average([hit[1] for hit in hits], 0, weights=np.maximum(factor, 1e-6))
        features[cell] = [math.log1p(len(hits) / (between + 1)), factor.max(), *means]
    return features


@pytest.mark.parametrize("between", [0, 1, 7])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_raster_equals_loops(seed, between):
    lanes = guidance(seed)
    expected = loop_raster(lanes, GRID, between)
    raster = rasterise(lanes, GRID, between)
    assert (expected[:, 0] > 0).sum() > 5
    np.testing.assert_allclose(raster.features, expected, atol=2e-4)
    np.testing.assert_array_equal(raster.factor, raster.features[:, 1])


def test_a_doubled_point_has_no_direction_and_gives_no_nan():
    lanes = guidance(3)
    lanes = replace(lanes, points=np.repeat(lanes.points[:, :1], 4, 1))
    raster = rasterise(lanes, GRID, 2)
    assert np.isfinite(raster.features).all()
    np.testing.assert_array_equal(raster.features[:, 2:4], 0.0)


@pytest.mark.parametrize("gate", [0.0, 1.0])
def test_order_of_lanes_changes_nothing_and_a_closed_gate_leaves_no_factor(gate):
    lanes, order = guidance(4, gate=gate), np.random.default_rng(0).permutation(5)
    permuted = replace(lanes, points=lanes.points[order], weight=lanes.weight[order], valid=lanes.valid[order])
    a, b = (rasterise(each, GRID, 3) for each in (lanes, permuted))
    np.testing.assert_allclose(a.features, b.features, atol=1e-6)
    assert (np.asarray(a.factor).max() > 0) == (gate > 0)
    assert np.isfinite(a.features).all()


@pytest.mark.parametrize("lanes", [0, 1])
def test_sizes_0_and_1(lanes):
    none = jax.tree.map(lambda leaf: leaf[:lanes] if np.ndim(leaf) else leaf, guidance(5))
    raster = rasterise(none, GRID, 3)
    assert raster.features.shape == (200, CHANNELS)
    assert (np.asarray(raster.features).any()) == bool(lanes)


def test_lanes_shifted_by_whole_cells_move_the_raster():
    lanes = guidance(6)
    moved = replace(lanes, points=lanes.points + jnp.asarray([[[4.0, -2.0]]]))
    a, b = (np.asarray(rasterise(each, GRID, 3).features).reshape(10, 20, -1) for each in (lanes, moved))
    np.testing.assert_allclose(b[:-1, 2:], a[1:, :-2], atol=2e-4)
