"""Deformable attention with its projections against the reference's numbers, and at its edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import batch_leading, case_id, golden_modules, implemented, load_module_case, options
from tests.golden_compare import compare
from tflane_jax.layers.deformable import DeformableAttention, compass_offsets, sampling_locations, star_offsets


@pytest.mark.golden
@pytest.mark.parametrize(
    "path",
    golden_modules("custom_msda_decoder*")
    + golden_modules("msda_module*")
    + [path for path in golden_modules("laneseg_lane_attention*") if not path.stem.endswith("_init")],
    ids=case_id,
)
def test_module_matches_the_reference(path):
    check(load_module_case(path))


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("laneseg_lane_attention_init*"), ids=case_id)
def test_lane_attention_starts_as_in_the_reference(path):
    case = load_module_case(path)
    sizes = options(case, "heads", "levels", "points")
    offsets = star_offsets(sizes.heads, sizes.levels, sizes.points)
    np.testing.assert_allclose(offsets.reshape(-1), case.outputs["sampling_offsets_bias"], atol=5e-6)
    # The module uses them, and a query of zeros has no other offsets.
    module = DeformableAttention(8, sizes.heads, sizes.points, sizes.levels, initial="star")
    given = jnp.zeros((1, 8)), jnp.zeros((4, 8)), [(2, 2)] * sizes.levels, jnp.zeros((1, sizes.heads, 2))
    params = jax.jit(lambda: module.init(jax.random.key(0), *given))()["params"]
    np.testing.assert_allclose(params["sampling_offsets"]["bias"], case.outputs["sampling_offsets_bias"], atol=5e-6)
    np.testing.assert_array_equal(params["sampling_offsets"]["kernel"], 0.0)


def check(case):
    sizes = options(case, "dim", "heads", "points")
    implemented(case, value_proj_ratio=[1.0, 1])
    shapes = [tuple(int(n) for n in row) for row in case.inputs["spatial_shapes"]]
    module = DeformableAttention(sizes.dim, sizes.heads, sizes.points, len(shapes))
    batch, length = batch_leading(case, case.inputs["value"]).shape[:2]
    padded = case.inputs.get("key_padding_mask", np.zeros((batch, length), bool)).astype(bool)

    def outputs(torch_params, inputs):
        params = {
            name: {"kernel": torch_params[f"{name}.weight"].T, "bias": torch_params[f"{name}.bias"]}
            for name in ("sampling_offsets", "attention_weights", "value_proj", "output_proj")
        }

        def one(query, position, value, identity, reference, padded):
            # LaneSegNet's references are (Q, levels, R, 2), a point for each head; the others' (Q, levels, 2 or 4).
            reference = reference.swapaxes(1, 2) if reference.ndim == 4 else reference[:, None]
            attended = module.apply({"params": params}, query + position, value, shapes, reference, ~padded)
            # The reference adds the query, without its position, unless it is given another identity.
            return identity + attended

        query = inputs["query"]
        position, identity = inputs.get("query_pos", jnp.zeros_like(query)), inputs.get("identity", query)
        sequences = (batch_leading(case, array) for array in (query, position, inputs["value"], identity))
        out = jax.vmap(one)(*sequences, inputs["reference_points"], padded)
        return {"output": batch_leading(case, out)}

    compare(case, outputs)


@pytest.mark.parametrize("queries", [0, 1])
def test_few_queries(queries):
    module = DeformableAttention(8, heads=2, points=3)
    value, query = jnp.ones((12, 8)), jnp.ones((queries, 8))
    reference = jnp.full((queries, 1, 2), 0.5)
    run = jax.jit(lambda *given: module.init_with_output(jax.random.key(0), *given[:2], [(3, 4)], given[2])[0])
    assert run(query, value, reference).shape == (queries, 8)


def test_heads_look_around_their_own_points():
    """With one reference point for each head, a point far outside makes only that head zero."""
    module = DeformableAttention(4, heads=2, points=1)
    rng = np.random.default_rng(1)
    value, query = (jnp.asarray(rng.normal(size=(n, 4)).astype(np.float32)) for n in (36, 1))
    center, outside = [0.5, 0.5], [9.0, 9.0]

    @jax.jit
    def run(reference):
        return module.init_with_output(jax.random.key(0), query, value, [(6, 6)], reference)[0]

    def out(*reference):
        return np.asarray(run(jnp.array([reference])))

    bias = out(outside, outside)
    np.testing.assert_allclose(
        out(center, center) - bias, out(center, outside) + out(outside, center) - 2 * bias, atol=1e-6
    )
    np.testing.assert_array_equal(out(center, center), out(center))
    with pytest.raises(ValueError, match="1 or 2 points"):
        out(center, center, center)


def test_offsets_count_in_cells_around_a_point_and_in_halves_of_a_box():
    """Worked by hand: levels of 4 x 8 and 2 x 4 cells, two points, one head."""
    offsets = jnp.ones((1, 1, 2, 2, 2))
    shapes = ((4, 8), (2, 4))
    point = sampling_locations(jnp.array([[[0.5, 0.25]]]), offsets, shapes)
    np.testing.assert_allclose(point[0, 0, :, 0], [[0.625, 0.5], [0.75, 0.75]])
    box = sampling_locations(jnp.array([[[0.5, 0.25, 0.4, 0.2]]]), offsets, shapes)
    np.testing.assert_allclose(box[0, 0, :, 1], [[0.6, 0.3], [0.6, 0.3]], rtol=1e-6)
    by_level = sampling_locations(jnp.array([[[[0.5, 0.25], [0.0, 0.0]]]]), offsets, shapes)
    np.testing.assert_allclose(by_level[0, 0, :, 0], [[0.625, 0.5], [0.25, 0.5]])
    for wrong in ((1, 1, 3), (1, 1, 3, 2)):
        with pytest.raises(ValueError, match="reference must be"):
            sampling_locations(jnp.zeros(wrong), offsets, shapes)


def test_padding_of_the_value_reaches_nothing():
    module = DeformableAttention(8, heads=2, points=2, levels=2)
    rng = np.random.default_rng(2)
    shapes, valid = ((3, 4), (2, 2)), np.ones(16, bool)
    valid[[3, 7, 11, 13, 15]] = False
    value, query = (jnp.asarray(rng.normal(size=(n, 8)).astype(np.float32)) for n in (16, 5))
    reference = jnp.asarray(rng.uniform(size=(5, 1, 2)).astype(np.float32))
    params = jax.jit(lambda: module.init(jax.random.key(0), query, value, shapes, reference))()

    @jax.jit
    def both(value, valid):
        run = lambda params: module.apply(params, query, value, shapes, reference, valid)  # noqa: E731
        out, pull = jax.vjp(run, params)
        return out, pull(jnp.ones_like(out))

    clean, garbage = both(value, valid), both(jnp.where(valid[:, None], value, jnp.nan), valid)
    jax.tree.map(np.testing.assert_array_equal, clean, garbage)
    assert np.abs(clean[0] - both(value, np.ones(16, bool))[0]).max() > 0.01


def test_a_star_needs_all_its_points():
    np.testing.assert_array_equal(star_offsets(2, 1, 4)[0], star_offsets(2, 1, 4)[1])
    np.testing.assert_allclose(star_offsets(1, 1, 16)[0, 0, :3], [[1, 0], [2, 0], [1, 1]], atol=1e-6)
    with pytest.raises(ValueError, match="12 points do not form a star"):
        star_offsets(2, 1, 12)


def test_compass_points_outward():
    offsets = compass_offsets(4, 1, 2)[:, 0]
    np.testing.assert_allclose(offsets[:, 1], 2 * offsets[:, 0], atol=1e-6)
    np.testing.assert_allclose(offsets[:, 0], [[1, 0], [0, 1], [-1, 0], [0, -1]], atol=1e-6)
