"""Curve distances against plain recursions and loops, and their invariances."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.geometry import pose_matrix, transform_points
from tflane_jax.geometry.distances import chamfer, discrete_frechet, pad_lines, vertex_distance

QUICK = settings(max_examples=40)
seeds, sizes = st.integers(0, 10**6), st.integers(1, 8)


def random_pair(seed, n, m, dims=3):
    rng = np.random.default_rng(seed)
    return rng.uniform(-5, 5, (n, dims)), rng.uniform(-5, 5, (m, dims))


def frechet_by_recursion(a, b):
    @functools.cache
    def coupling(i, j):
        here = float(np.sqrt(((a[i] - b[j]) ** 2).sum()))
        before = [(i - 1, j), (i, j - 1), (i - 1, j - 1)]
        before = [coupling(*cell) for cell in before if min(cell) >= 0]
        return max(here, min(before)) if before else here

    return coupling(len(a) - 1, len(b) - 1)


def chamfer_by_loop(a, b):
    forward = [min(np.linalg.norm(p - q) for q in b) for p in a]
    backward = [min(np.linalg.norm(p - q) for p in a) for q in b]
    return 0.5 * (np.mean(forward) + np.mean(backward))


@QUICK
@given(seed=seeds, n=sizes, m=sizes, dims=st.sampled_from([2, 3]))
def test_definitions_and_bounds(seed, n, m, dims):
    a, b = random_pair(seed, n, m, dims)
    frechet = discrete_frechet(a, b)
    assert frechet == pytest.approx(frechet_by_recursion(a, b))
    assert chamfer(a, b) == pytest.approx(chamfer_by_loop(a, b))
    assert frechet >= max(vertex_distance(a[0], b[0]), vertex_distance(a[-1], b[-1]))
    assert frechet >= chamfer(a, b)
    for distance in (discrete_frechet, chamfer):
        assert distance(a, a) == 0.0
        assert distance(a, b) == pytest.approx(distance(b, a))
        assert distance(a[::-1], b[::-1]) == pytest.approx(distance(a, b))
    assert chamfer(a[::-1], b) == pytest.approx(chamfer(a, b))


@QUICK
@given(seed=seeds, n=sizes, m=sizes)
def test_rigid_motion_changes_nothing_and_scale_scales(seed, n, m):
    a, b = random_pair(seed, n, m)
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose = pose_matrix(rotation, rng.uniform(-100, 100, 3))
    for distance in (discrete_frechet, chamfer):
        moved = distance(transform_points(pose, a), transform_points(pose, b))
        assert moved == pytest.approx(distance(a, b), abs=1e-9)
        assert distance(3.0 * a, 3.0 * b) == pytest.approx(3.0 * distance(a, b))


@pytest.mark.parametrize("lines", [(0, 3), (3, 0), (1, 1), (4, 6)])
def test_all_pairs_equal_one_at_a_time_on_host_and_device(lines):
    rng = np.random.default_rng(0)
    a, b = (rng.uniform(-5, 5, (count, points, 3)) for count, points in zip(lines, (7, 5), strict=True))
    for distance in (discrete_frechet, chamfer):
        expected = np.array([[distance(x, y) for y in b] for x in a]).reshape(lines)
        np.testing.assert_array_equal(distance(a[:, None], b[None]), expected)
        with jax.numpy_rank_promotion("raise"):
            on_device = jax.jit(distance)(jnp.asarray(a, jnp.float32)[:, None], jnp.asarray(b, jnp.float32)[None])
        np.testing.assert_allclose(on_device, expected, rtol=1e-5, atol=1e-5)


def test_direction_matters_to_frechet_only():
    line = np.linspace((0, 0), (10, 0), 11)
    assert discrete_frechet(line, line[::-1]) == 10.0
    assert chamfer(line, line[::-1]) == 0.0


@QUICK
@given(seed=seeds, counts=st.lists(sizes, min_size=1, max_size=5))
def test_padding_by_the_last_vertex_keeps_frechet_exactly(seed, counts):
    rng = np.random.default_rng(seed)
    lines = [rng.uniform(-5, 5, (count, 3)) for count in counts]
    padded = pad_lines(lines)
    expected = [[discrete_frechet(a, b) for b in lines] for a in lines]
    np.testing.assert_array_equal(discrete_frechet(padded[:, None], padded[None]), expected)


def test_pad_lines_without_lines_or_points():
    assert pad_lines([]).shape[::2] == (0, 3)
    with pytest.raises(ValueError, match="polyline 1 has no points"):
        pad_lines([np.zeros((2, 3)), np.zeros((0, 3))])


@pytest.mark.parametrize("distance", [chamfer, jax.jit(chamfer)], ids=["host", "device"])
def test_chamfer_ignores_what_padding_holds(distance):
    a, b = random_pair(3, 6, 5)
    a_valid, b_valid = np.arange(6) < 4, np.arange(5) < 2
    dirty = np.where(a_valid[:, None], a, np.nan), np.where(b_valid[:, None], b, np.nan)
    np.testing.assert_allclose(distance(*dirty, a_valid, b_valid), chamfer_by_loop(a[:4], b[:2]), rtol=1e-5)
    assert distance(*dirty, a_valid, np.zeros(5, bool)) == np.inf


@pytest.mark.parametrize("distance", [chamfer, discrete_frechet, vertex_distance])
def test_equal_lines_have_a_gradient_of_zero(distance):
    line = jnp.asarray([[0.0, 0.0], [1.0, 2.0], [4.0, 2.0]])
    value, gradient = jax.value_and_grad(lambda a: distance(a, line).sum())(line)
    assert value == 0.0
    np.testing.assert_array_equal(gradient, jnp.zeros_like(line))
