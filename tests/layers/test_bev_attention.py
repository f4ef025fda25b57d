"""BEVFormer's attentions against the reference's numbers; capacity, cameras and padding."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import batch_leading, case_id, golden_modules, load_module_case, options
from tests.golden_compare import compare
from tests.layers.batch_bugs import EXAMPLES, like_the_reference
from tests.slow import with_slow
from tflane_jax.convert.bevformer import SPATIAL_ATTENTION, TEMPORAL_ATTENTION
from tflane_jax.layers.bev_attention import SpatialCrossAttention, TemporalSelfAttention
from tflane_jax.layers.camera_queries import LOST, first_seen


@pytest.mark.golden
@pytest.mark.parametrize(
    "path", with_slow(golden_modules("tsa_*"), quick=["tsa_olv2_prev", "tsa_noprev_bs1"]), ids=case_id
)
def test_temporal_attention_matches_the_reference(path):
    check_temporal(load_module_case(path))


def check_temporal(case):
    shape = tuple(int(n) for n in case.inputs["spatial_shapes"][0])
    sizes = options(case, "dim", "heads", "points")
    # OpenLane-V2's copy, which SMERF took over, projects the value twice and reads the right history.
    baseline = any(name in case.source for name in ("SMERF", "OpenLane-V2"))
    module = TemporalSelfAttention(sizes.dim, sizes.heads, sizes.points, 1 + baseline)

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, TEMPORAL_ATTENTION)

        def one(query, position, history, reference):
            attended = module.apply({"params": params}, query + position, history, query, shape, reference)
            return query + attended

        queries = leading(case, inputs["query"])
        position = leading(case, inputs.get("query_pos", jnp.zeros_like(inputs["query"])))
        history = leading(case, inputs.get("prev_bev", inputs["query"]))
        # Index 2 b is the previous frame of batch element b, 2 b + 1 its present one.
        reference = inputs["reference_points"].reshape(len(queries), 2, -1, 2).swapaxes(1, 2)
        with like_the_reference(mixed_history=not baseline):
            out = jax.vmap(one, axis_name=EXAMPLES)(queries, position, history, reference)
        return {"output": leading(case, out)}

    compare(case, outputs)


def leading(case, array):
    return batch_leading(case, array, default=True)


@pytest.mark.golden
@pytest.mark.parametrize("path", with_slow(golden_modules("sca_*"), quick=["sca_bs2"]), ids=case_id)
@pytest.mark.parametrize("compact", [False, True])
def test_spatial_attention_matches_the_reference(path, compact):
    check_spatial(load_module_case(path), compact)


def check_spatial(case, compact):
    shapes = [tuple(int(n) for n in row) for row in case.inputs["spatial_shapes"]]
    mask = case.inputs["bev_mask"].astype(bool)
    sizes = options(case, "dim", "heads", "points")
    most = int(mask.any(-1).sum(-1).max())
    if compact and most == mask.shape[2]:
        pytest.skip("a camera sees every query, so that a capacity leaves nothing out")
    module = SpatialCrossAttention(sizes.dim, sizes.heads, sizes.points, most if compact else None)

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, SPATIAL_ATTENTION)

        def one(query, features, reference, visible):
            return query + module.apply({"params": params}, query, features, shapes, reference, visible)

        with like_the_reference():
            out = jax.vmap(one, axis_name=EXAMPLES)(
                leading(case, inputs["query"]),
                inputs["feats"].transpose(2, 0, 1, 3),
                inputs["reference_points_cam"].swapaxes(0, 1),
                jnp.asarray(mask).swapaxes(0, 1),
            )
        return {"output": leading(case, out)}

    compare(case, outputs)


SHAPES = ((4, 6), (2, 3))


def scene(cameras=3, queries=10, dim=8):
    """Return the arguments of a spatial attention, of queries that some cameras see and others do not."""
    rng = np.random.default_rng(0)
    query, features = rng.normal(size=(queries, dim)), rng.normal(size=(cameras, 30, dim))
    reference = rng.uniform(size=(cameras, queries, 2, 2))
    visible = rng.uniform(size=(cameras, queries, 2)) < 0.3
    visible[:, 3] = False
    return *(jnp.asarray(x, jnp.float32) for x in (query, features)), jnp.asarray(reference, jnp.float32), visible


@pytest.fixture(scope="module")
def variables():
    query, features, reference, visible = scene()
    module = SpatialCrossAttention(8, 2, 4)
    return jax.jit(lambda: module.init(jax.random.key(1), query, features, SHAPES, reference, jnp.asarray(visible)))()


@partial(jax.jit, static_argnames="capacity")
def both(params, query, features, reference, visible, capacity):
    def apply(params, query, features):
        arguments = (query, features, SHAPES, reference, visible)
        module = SpatialCrossAttention(8, 2, 4, capacity)
        return module.apply({"params": params}, *arguments, mutable=[LOST])

    out, pull, sown = jax.vjp(apply, params, query, features, has_aux=True)
    return (out, sown.get(LOST, {})), pull(jnp.cos(jnp.arange(out.size)).reshape(out.shape))


def run(variables, query, features, reference, visible, capacity=None):
    """Return the attended features and what was sown, and the gradients by parameters, query and features."""
    return both(variables["params"], query, features, reference, jnp.asarray(visible), capacity)


def test_enough_capacity_changes_nothing_and_too_little_is_reported(variables):
    query, features, reference, visible = scene()
    visible[:, -1] = True
    counts = visible.any(-1).sum(1)
    assert len(set(counts.tolist())) > 1
    (dense, _), by_dense = run(variables, query, features, reference, visible)
    (compact, sown), by_compact = run(variables, query, features, reference, visible, int(counts.max()))
    np.testing.assert_allclose(compact, dense, atol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), by_compact, by_dense)
    assert sown["camera_cells"] == (0,)
    # A query that no camera sees gets the bias of the projection alone.
    np.testing.assert_array_equal(dense[3], variables["params"]["output_proj"]["bias"])
    scarce = int(counts.max()) - 1
    (left_out, sown), _ = run(variables, query, features, reference, visible, scarce)
    assert sown["camera_cells"] == (np.maximum(counts - scarce, 0).sum(),)
    # The last queries do without that camera, as if it did not see them.
    visible &= (np.cumsum(visible.any(-1), 1) <= scarce)[..., None]
    (expected, _), _ = run(variables, query, features, reference, visible)
    np.testing.assert_allclose(left_out, expected, atol=1e-6)


@pytest.mark.parametrize("capacity", [None, 5])
def test_camera_order_and_unseen_places_change_nothing(variables, capacity):
    query, features, reference, visible = scene()
    (out, _), gradients = run(variables, query, features, reference, visible, capacity)
    order = jnp.array([2, 0, 1])
    (shuffled, _), _ = run(variables, query, features[order], reference[order], visible[order], capacity)
    np.testing.assert_allclose(shuffled, out, atol=1e-6)
    hidden = visible.any(-1)[..., None, None]
    (same, _), also = run(variables, query, features, jnp.where(hidden, reference, jnp.nan), visible, capacity)
    np.testing.assert_array_equal(same, out)
    jax.tree.map(np.testing.assert_array_equal, also, gradients)


def test_the_first_seen_are_listed_in_order():
    seen = np.array([[1, 0, 1, 1, 0], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], bool)
    assert first_seen(jnp.asarray(seen), 3).tolist() == [[0, 2, 3], [5, 5, 5], [0, 1, 2]]
    assert first_seen(jnp.asarray(seen), 5)[0].tolist() == [0, 2, 3, 5, 5]
