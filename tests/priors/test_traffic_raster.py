"""Traffic flow as a BEV raster against plain loops; order and padding of instances change nothing."""

import dataclasses
import math
from collections import defaultdict
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.priors.test_traffic_flow import make_flow
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig, select_traffic_flow
from tflane_jax.priors.traffic_raster import CHANNELS, rasterise_traffic_flow
from tflane_jax.scene import TrafficFlow

GRID = BevGrid(rows=10, columns=20)
CONFIG = TrafficFlowPriorConfig(max_instances=10)


@partial(jax.jit, static_argnums=(1, 2))
def rasterise(tracks, grid=GRID, between=0):
    return rasterise_traffic_flow(tracks, grid, between)


def select(flow, **options):
    config = dataclasses.replace(CONFIG, **options)
    return jax.tree.map(jnp.asarray, select_traffic_flow(flow, config, PerceptionRange()))


def loop_raster(tracks, grid, between):
    """Return the raster by loops over instances, frames and interpolated points, on positions in metres."""
    (dx, dy), (x0, y0) = grid.cell, grid.range.low(2)
    found = defaultdict(list)
    instances, frames = tracks.frame_valid.shape
    for k in range(instances):
        seen = [n for n in range(frames) if tracks.frame_valid[k, n]]
        if not seen:
            continue
        moved = min(1.0, math.dist(tracks.position[k, seen[0], :2], tracks.position[k, seen[-1], :2]) / 10.0)
        one_hot = [float(c == tracks.category[k]) for c in range(6)]
        for n in seen:
            for j in range(between + 1 if n + 1 in seen else 1):
                w = j / (between + 1)
                x, y = (1 - w) * tracks.position[k, n, :2] + (w * tracks.position[k, n + 1, :2] if j else 0.0)
                direction = (1 - w) * tracks.heading[k, n] + (w * tracks.heading[k, n + 1] if j else 0.0)
                c, s = direction / np.linalg.norm(direction)
                u, v = (x - x0) / dx, (y - y0) / dy
                cell = int(v) * grid.columns + int(u)
                row = [c, s, u - int(u) - 0.5, v - int(v) - 0.5, moved, *one_hot]
                found[cell].append(((n + w + 1) / frames, row))
    features = np.zeros((grid.rows * grid.columns, CHANNELS))
    for cell, hits in found.items():
        amount = math.log1p(len(hits) / (between + 1))
        features[cell] = [amount, max(hit[0] for hit in hits), *np.mean([hit[1] for hit in hits], 0)]
    return features, sorted(found)


@pytest.mark.parametrize("between", [0, 1, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_raster_equals_loops(seed, between):
    flow = make_flow(seed)
    tracks = select(flow)
    features, touched = loop_raster(jax.tree.map(np.asarray, tracks), GRID, between)
    assert len(touched) > 10
    raster = rasterise(tracks, GRID, between)
    np.testing.assert_array_equal(np.flatnonzero(raster.touched), touched)
    np.testing.assert_allclose(raster.features, features, atol=2e-5)


def test_order_of_instances_changes_nothing():
    tracks = select(make_flow(2))
    order = np.random.default_rng(0).permutation(CONFIG.max_instances)
    permuted = jax.tree.map(lambda leaf: leaf[order], tracks)
    a, b = (rasterise(t, GRID, 1) for t in (tracks, permuted))
    np.testing.assert_array_equal(a.touched, b.touched)
    np.testing.assert_allclose(a.features, b.features, atol=1e-6)


def test_frames_that_are_not_valid_may_hold_anything():
    tracks = select(make_flow(3))
    hole = ~tracks.frame_valid[..., None]
    dirty = tracks.replace(
        position=jnp.where(hole, jnp.nan, tracks.position), heading=jnp.where(hole, jnp.nan, tracks.heading)
    )
    a, b = (rasterise(t, GRID, 1) for t in (tracks, dirty))
    jax.tree.map(np.testing.assert_array_equal, a, b)
    assert a.touched.any()


def test_occluded_frames_leave_no_trace():
    flow = make_flow(4)
    hidden = select(flow.replace(occluded=np.ones_like(flow.occluded)))
    assert not rasterise(hidden).touched.any()
    assert not np.asarray(rasterise(hidden).features).any()
    assert not rasterise(select(TrafficFlow.empty(0, 20))).touched.any()


def test_interpolation_fills_the_gaps_of_a_fast_road_user():
    flow = TrafficFlow.empty(1, 20)
    flow.position[0, :, 0] = np.linspace(-45, 45, 20)
    flow.valid[:] = True
    tracks = select(flow, min_valid_frames=5)
    fine = BevGrid(rows=25, columns=50)
    row = fine.columns * 12
    gaps, path = (np.asarray(rasterise(tracks, fine, n).touched)[row:][:50] for n in (0, 3))
    assert gaps.sum() == 20
    assert path[3:46].all()


def test_borders_of_the_grid():
    """Positions on the upper border belong to the last cell, and positions outside to none."""
    flow = TrafficFlow.empty(1, 20)
    flow.valid[:] = True
    flow.position[0, :, :2] = GRID.range.x[1], GRID.range.y[1]
    wide = PerceptionRange((-99, 99), (-99, 99))
    for shift, cells in ((0.0, [GRID.rows * GRID.columns - 1]), (0.1, [])):
        moved = flow.replace(position=flow.position + np.float32(shift))
        tracks = select_traffic_flow(moved, CONFIG, wide)
        raster = rasterise(jax.tree.map(jnp.asarray, tracks))
        assert np.flatnonzero(raster.touched).tolist() == cells
