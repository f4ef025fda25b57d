"""Weighted sums of bilinear samples against the reference's numbers, plain formulas, and at their edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.golden import case_id, golden_modules, load_module_case
from tests.golden_compare import compare
from tflane_jax.layers import sampling
from tflane_jax.layers.sampling import deformable_attention, sample_bilinear


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("msda_func*"), ids=case_id)
def test_core_matches_the_reference(path):
    case = load_module_case(path)
    shapes = [tuple(int(n) for n in row) for row in case.inputs["spatial_shapes"]]
    batched = jax.vmap(lambda v, s, w: deformable_attention(v, shapes, s, w))

    def outputs(_, arrays):
        return {"output": batched(arrays["value"], arrays["sampling_locations"], arrays["attention_weights"])}

    compare(case, outputs)


def loop_sample(grid, x, y):
    """Bilinear sample of one (h, w) channel by hand, zero outside."""
    h, w = grid.shape
    px, py = x * w - 0.5, y * h - 0.5
    total = 0.0
    for row in (int(np.floor(py)), int(np.floor(py)) + 1):
        for column in (int(np.floor(px)), int(np.floor(px)) + 1):
            if 0 <= row < h and 0 <= column < w:
                total += grid[row, column] * (1 - abs(px - column)) * (1 - abs(py - row))
    return total


PLACES = st.floats(-0.3, 1.3, allow_subnormal=False)


@settings(max_examples=80)
@given(st.sampled_from([(3, 5), (1, 4), (4, 1), (1, 1)]), PLACES, PLACES)
def test_sample_matches_a_loop(shape, x, y):
    grid = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    got = sample_bilinear(jnp.asarray(grid.reshape(-1, 1)), shape, jnp.array([x, y], jnp.float32))
    assert float(got[0]) == pytest.approx(loop_sample(grid, np.float32(x), np.float32(y)), abs=2e-5)


def test_sample_reproduces_a_plane_and_its_slope():
    """A bilinear sample of a linear function is that function, and the gradient is its slope."""
    h, w = 6, 8
    rows, columns = np.mgrid[:h, :w]
    plane = jnp.asarray((3.0 * (columns + 0.5) / w - 2.0 * (rows + 0.5) / h).reshape(-1, 1), jnp.float32)
    at = jnp.array([0.37, 0.61])
    value, slope = jax.value_and_grad(lambda p: sample_bilinear(plane, (h, w), p)[0])(at)
    assert float(value) == pytest.approx(3 * 0.37 - 2 * 0.61, abs=1e-5)
    np.testing.assert_allclose(slope, [3.0, -2.0], rtol=1e-4)


@pytest.mark.slow
def test_the_slope_at_a_cell_center_is_that_to_the_next_cell():
    """The first locations of deformable attention lie there. Those of a grid of powers of two are exact in float32."""
    h, w = 4, 8
    grid = np.random.default_rng(0).normal(size=(h, w)).astype(np.float32)
    rows, columns = np.mgrid[:h, :w]
    centers = jnp.asarray(np.stack([(columns + 0.5) / w, (rows + 0.5) / h], -1).reshape(-1, 2), jnp.float32)
    slope = jax.vmap(jax.grad(lambda at: sample_bilinear(jnp.asarray(grid.reshape(-1, 1)), (h, w), at)[0]))(centers)
    beyond = np.pad(grid, ((0, 1), (0, 1)))
    expected = np.stack([(beyond[:h, 1:] - grid) * w, (beyond[1:, :w] - grid) * h], -1)
    np.testing.assert_allclose(np.asarray(slope).reshape(h, w, 2), expected, rtol=1e-5, atol=1e-5)


SHAPES = ((5, 7), (3, 2))
THIN = ((1, 7), (34, 1))


def plain_attention(value, locations, weights, shapes=SHAPES):
    """The definition for all cells at once: a cell's weight is the product of two hats."""
    total, begin = 0.0, 0
    for level, (h, w) in enumerate(shapes):
        grid = value[begin : begin + h * w].reshape(h, w, *value.shape[1:])
        begin += h * w
        x, y = locations[:, :, level, :, 0] * w - 0.5, locations[:, :, level, :, 1] * h - 0.5
        across = jax.nn.relu(1.0 - jnp.abs(x[..., None] - jnp.arange(w)[None, None, None]))
        down = jax.nn.relu(1.0 - jnp.abs(y[..., None] - jnp.arange(h)[None, None, None]))
        total = total + jnp.einsum("qnp,qnpy,qnpx,yxnd->qnd", weights[:, :, level], down, across, grid)
    return total.reshape(len(total), -1)


def arrays(queries=5, heads=2, points=3, channels=4):
    rng = np.random.default_rng(0)
    locations = rng.uniform(-0.2, 1.2, (queries, heads, 2, points, 2))
    made = rng.normal(size=(41, heads, channels)), locations, rng.normal(size=(queries, heads, 2, points))
    return tuple(jnp.asarray(array, jnp.float32) for array in made)


def pulled(attend, *given):
    out, pull = jax.vjp(attend, *given)
    return out, pull(jnp.cos(jnp.arange(out.size, dtype=jnp.float32)).reshape(out.shape))


@pytest.mark.parametrize("shapes", [SHAPES, THIN], ids=["", "one cell wide"])
@pytest.mark.parametrize("steps", ["one step", "many steps"])
def test_outputs_and_gradients_are_those_of_the_definition(shapes, steps, monkeypatch):
    """Five queries in several steps: the last is padded."""
    if steps == "many steps":
        monkeypatch.setattr(sampling, "_FORWARD_STEP", 300)
        monkeypatch.setattr(sampling, "_BACKWARD_STEP", 200)
    attend = lambda *given: deformable_attention(given[0], shapes, *given[1:])  # noqa: E731
    defined = lambda *given: plain_attention(*given, shapes)  # noqa: E731
    ours, plain = (jax.jit(lambda *given, f=f: pulled(f, *given))(*arrays()) for f in (attend, defined))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5), ours, plain)
    assert all(np.abs(leaf).max() > 0.1 for leaf in jax.tree.leaves(ours))


@pytest.mark.slow
def test_each_view_has_its_own_value_as_if_mapped():
    one = arrays()
    given = [jnp.stack([array, array[::-1]]) for array in one]
    attend = lambda *given: deformable_attention(given[0], SHAPES, *given[1:])  # noqa: E731
    stacked, mapped = (jax.jit(lambda *given, f=f: pulled(f, *given))(*given) for f in (attend, jax.vmap(attend)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), stacked, mapped)
    np.testing.assert_allclose(stacked[0][0], attend(*one), atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_non_finite_places_give_zero_and_finite_gradients(bad):
    value, locations, weights = arrays()
    spoiled = locations.at[2, 1, 0, 1].set(bad).at[4].set(bad)
    masked = weights.at[2, 1, 0, 1].set(0.0).at[4].set(0.0)
    attend = jax.jit(lambda *given: pulled(lambda *x: deformable_attention(x[0], SHAPES, *x[1:]), *given))
    out, (by_value, by_location, by_weight) = attend(value, spoiled, weights)
    clean, (clean_value, clean_location, _) = attend(value, locations, masked)
    np.testing.assert_array_equal(out, clean)
    np.testing.assert_array_equal(by_value, clean_value)
    np.testing.assert_array_equal(by_location, clean_location)
    assert not np.asarray(by_weight[4]).any()
    assert np.isfinite(by_weight).all()


@pytest.mark.slow
def test_gradients_have_the_dtypes_of_what_they_belong_to():
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        given = (
            jnp.asarray(rng.normal(size=(12, 2, 3)), jnp.float64),
            jnp.asarray(rng.random((5, 2, 1, 2, 2)), jnp.float32),
            jnp.asarray(rng.random((5, 2, 1, 2)), jnp.float32),
        )
        attend = lambda value, *places: deformable_attention(value, ((3, 4),), *places).sum()  # noqa: E731
        gradients = jax.grad(attend, (0, 1, 2))(*given)
    assert [g.dtype for g in gradients] == [x.dtype for x in given]


def test_gradients_by_locations_are_those_of_float32_also_for_bfloat16():
    """Regression: slopes were differences of products that had been rounded to bfloat16."""
    rng, (height, width) = np.random.default_rng(0), (9, 12)
    across, down = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    smooth = 3.0 + np.sin(2 * across + 3 * down).reshape(-1, 1, 1) * rng.normal(size=(1, 2, 4))
    value = jnp.asarray(smooth, jnp.bfloat16)
    location = jnp.asarray(rng.uniform(0.1, 0.9, (5, 2, 1, 3, 2)), jnp.float32)
    weight = jnp.asarray(rng.uniform(size=(5, 2, 1, 3)), jnp.float32)
    pull = jnp.asarray(rng.normal(size=(5, 8)), jnp.bfloat16)

    def gradient(value, pull):
        total = lambda at: (deformable_attention(value, ((height, width),), at, weight) * pull).astype(jnp.float32)  # noqa: E731
        return jax.grad(lambda at: total(at).sum())(location)

    want = gradient(value.astype(jnp.float32), pull.astype(jnp.float32))
    assert np.linalg.norm(gradient(value, pull) - want) < 1e-3 * np.linalg.norm(want)
