"""Equivalent orders of map lines against the reference's lists, and their symmetries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case, numbered
from tflane_jax.geometry.line_orders import order_indices, point_orders
from tflane_jax.geometry.polylines import resample_lines

# v0 is left out, see `geometry.line_orders`.
PATTERNS = {
    "v1": {},
    "v4": {"ways": "both"},
    "v2": {},
    "v3": {"ways": "both"},
}
CENTERLINE = 3


def vertex_orders(vertices, points, ways):
    """Return the orders of one line before resampling, each resampled to P points: v2 (v3: `ways="both"`)."""
    if not np.array_equal(vertices[0], vertices[-1]):
        return resample_lines([vertices, vertices[::-1]], points)
    return resample_lines([vertices[order] for order in order_indices(len(vertices), ways)], points)


@pytest.mark.golden
@pytest.mark.parametrize(
    "path", [*golden_modules("maptr_gt_permutations*"), *golden_modules("maptrv2_gt_permutations*")], ids=case_id
)
def test_orders_are_those_of_the_reference(path):
    case = load_module_case(path)
    vertices = [case.inputs[name] for name in numbered(case.inputs, r"line\.(\d+)")]
    closed = np.array([np.array_equal(line[0], line[-1]) for line in vertices])
    # A directed class exists in MapTRv2 only.
    directed = (case.inputs["labels"] == CENTERLINE) & ("maptrv2" in case.source)
    patterns = {name.removeprefix("shift_") for name in case.outputs if name.startswith("shift_")} - {"v0"}
    assert patterns <= PATTERNS.keys()
    for pattern in patterns:
        expected = case.outputs[f"shift_{pattern}"]
        real = (expected > -9999).all((2, 3))
        if pattern in ("v2", "v3"):
            ways = PATTERNS[pattern].get("ways", "one")
            for line, one_way, orders, there in zip(vertices, directed, expected, real, strict=True):
                found = vertex_orders(line, orders.shape[1], ways)[: 1 if one_way else None]
                np.testing.assert_allclose(found, orders[there], rtol=1e-5, atol=1e-5, err_msg=pattern)
            continue
        points = jnp.asarray(case.outputs["fixed_num_sampled_points"])
        run = jax.jit(lambda points, pattern=pattern: point_orders(points, closed, directed, **PATTERNS[pattern]))
        found, there = run(points)
        np.testing.assert_array_equal(there, real, err_msg=pattern)
        np.testing.assert_array_equal(np.asarray(found)[real], expected[real], err_msg=pattern)


def ring(points=7, seed=0):
    corners = np.random.default_rng(seed).normal(size=(points - 1, 2)).astype(np.float32)
    return np.concatenate([corners, corners[:1]])


def as_set(orders, there):
    return {order.tobytes() for order, real in zip(np.asarray(orders)[0], np.asarray(there)[0], strict=True) if real}


@pytest.mark.parametrize("ways", ["one", "both"])
def test_the_start_of_a_ring_does_not_matter_and_its_direction_only_one_way(ways):
    closed = np.ones(1, bool)
    of = lambda line: as_set(*point_orders(line[None], closed, ways=ways))  # noqa: E731
    line = ring()
    shifted = np.concatenate([line[2:], line[1:3]])
    assert of(shifted) == of(line)
    assert len(of(line)) == 6 if ways == "one" else 12
    assert (of(line[::-1].copy()) == of(line)) == (ways == "both")


@pytest.mark.parametrize("ways", ["one", "both"])
def test_a_directed_ring_has_its_own_order_only(ways):
    orders, there = point_orders(ring()[None], np.ones(1, bool), np.ones(1, bool), ways)
    assert as_set(orders, there) == {ring().tobytes()}
    assert there.sum() == 1


@pytest.mark.parametrize("points", [2, 3, 20])
def test_any_number_of_points_and_numpy_as_jax(points):
    lines = np.stack([ring(points, 1), np.random.default_rng(2).normal(size=(points, 2)).astype(np.float32)])
    closed, directed = np.array([True, False]), np.array([False, True])
    host = point_orders(lines, closed, directed)
    device = jax.jit(point_orders)(lines, closed, directed)
    jax.tree.map(np.testing.assert_array_equal, host, device)
    assert host[1].sum(1).tolist() == [points - 1, 1]
    np.testing.assert_array_equal(host[0][:, 0], lines)
    assert order_indices(points).shape == (points - 1, points)


def test_no_lines_have_no_orders():
    orders, there = point_orders(np.zeros((0, 4, 2), np.float32), np.zeros(0, bool))
    assert orders.shape == (0, 3, 4, 2)
    assert there.shape == (0, 3)
