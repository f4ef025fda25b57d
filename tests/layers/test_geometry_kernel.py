"""Geometry-guided kernel attention against the reference's numbers; capacity, cameras and padding."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, load_module_case, options
from tests.golden_compare import compare
from tests.layers.batch_bugs import EXAMPLES, like_the_reference
from tflane_jax.convert.bevformer import SPATIAL_ATTENTION
from tflane_jax.layers.camera_queries import LOST
from tflane_jax.layers.geometry_kernel import GeometryKernelAttention, kernel_offsets


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("maptr_gkt_cross_attention*"), ids=case_id)
@pytest.mark.parametrize("compact", [False, True])
def test_it_matches_the_reference(path, compact):
    case = load_module_case(path)
    sizes, shapes = options(case, "dim", "heads", "kernel_size"), [tuple(case.inputs["spatial_shapes"][0].tolist())]
    mask = case.inputs["bev_mask"].astype(bool)
    most = int(mask.any(-1).sum(-1).max())
    if compact and most == mask.shape[2]:
        pytest.skip("a camera sees every query, so that a capacity leaves nothing out")
    assert kernel_offsets(tuple(sizes.kernel_size)) == [tuple(row) for row in case.inputs["grid_offsets"].tolist()]
    module = GeometryKernelAttention(sizes.dim, sizes.heads, tuple(sizes.kernel_size), most if compact else None)

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, SPATIAL_ATTENTION)

        def one(query, features, reference, visible):
            return query + module.apply({"params": params}, query, features, shapes, reference, visible)

        with like_the_reference():
            out = jax.vmap(one, axis_name=EXAMPLES)(
                inputs["query"],
                inputs["feats"].transpose(2, 0, 1, 3),
                inputs["reference_points_cam"].swapaxes(0, 1),
                jnp.asarray(mask).swapaxes(0, 1),
            )
        return {"output": out}

    compare(case, outputs)


SHAPE = (4, 6)


def scene(cameras=3, queries=10, dim=8, anchors=2):
    """Return the arguments of the attention, of queries that some cameras see and others do not."""
    rng = np.random.default_rng(0)
    query, features = rng.normal(size=(queries, dim)), rng.normal(size=(cameras, SHAPE[0] * SHAPE[1], dim))
    reference = rng.uniform(size=(cameras, queries, anchors, 2))
    visible = rng.uniform(size=(cameras, queries, anchors)) < 0.3
    visible[:, 3] = False
    return *(jnp.asarray(x, jnp.float32) for x in (query, features)), jnp.asarray(reference, jnp.float32), visible


@pytest.fixture(scope="module")
def params():
    query, features, reference, visible = scene()
    module = GeometryKernelAttention(8, 2)
    fresh = jax.eval_shape(module.init, jax.random.key(1), query, features, [SHAPE], reference, jnp.asarray(visible))
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), fresh["params"])


@partial(jax.jit, static_argnames="capacity")
def run(params, query, features, reference, visible, capacity=None):
    """Return the attended features and what was sown, and the gradients by parameters, query and features."""

    def apply(params, query, features):
        module = GeometryKernelAttention(8, 2, capacity=capacity)
        return module.apply({"params": params}, query, features, [SHAPE], reference, visible, mutable=[LOST])

    out, pull, sown = jax.vjp(apply, params, query, features, has_aux=True)
    return out, sown.get(LOST, {}), pull(jnp.cos(jnp.arange(out.size)).reshape(out.shape))


def test_it_is_the_sum_over_the_kernel_written_as_loops(params):
    query, features, reference, visible = scene()
    found, _, _ = run(params, query, features, reference, jnp.asarray(visible))
    tree = jax.tree.map(np.asarray, params)
    value = np.asarray(features) @ tree["value_proj"]["kernel"] + tree["value_proj"]["bias"]
    logits = np.asarray(query) @ tree["attention_weights"]["kernel"] + tree["attention_weights"]["bias"]
    weights = np.asarray(jax.nn.softmax(jnp.asarray(logits.reshape(10, 2, 15)), -1))
    total, count = np.zeros((10, 8)), np.maximum(visible.any(-1).sum(0), 1)
    for camera, q in zip(*np.nonzero(visible.any(-1)), strict=True):
        for head in range(2):
            u, v = np.asarray(reference)[camera, q, head] * [6, 4]
            for k, (dx, dy) in enumerate((dx, dy) for dx in (-2, -1, 0, 1, 2) for dy in (-1, 0, 1)):
                cell = int(np.clip(np.rint(v + dy), 0, 3)) * 6 + int(np.clip(np.rint(u + dx), 0, 5))
                part = slice(4 * head, 4 * head + 4)
                total[q, part] += weights[q, head, k] * value[camera, cell, part]
    expected = (total / count[:, None]) @ tree["output_proj"]["kernel"] + tree["output_proj"]["bias"]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_attention_weights_start_xavier_uniform():
    """MapTR's transformer overwrites the zeros that this module of its own starts with."""
    query, features, reference, visible = scene()
    module = GeometryKernelAttention(8, 2)
    fresh = module.init(jax.random.key(1), query, features, [SHAPE], reference, jnp.asarray(visible))["params"]
    kernel, limit = np.asarray(fresh["attention_weights"]["kernel"]), np.sqrt(6 / (8 + 30))
    assert 0.9 * limit < np.abs(kernel).max() <= limit
    assert abs(kernel.mean()) < 0.1 * limit
    np.testing.assert_allclose(kernel.std(), limit / np.sqrt(3), rtol=0.1)
    assert not np.asarray(fresh["attention_weights"]["bias"]).any()


def test_enough_capacity_changes_nothing_and_too_little_is_reported(params):
    query, features, reference, visible = scene()
    counts, visible = visible.any(-1).sum(1), jnp.asarray(visible)
    dense, _, by_dense = run(params, query, features, reference, visible)
    compact, sown, by_compact = run(params, query, features, reference, visible, capacity=int(counts.max()))
    np.testing.assert_allclose(compact, dense, atol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), by_compact, by_dense)
    assert sown["camera_cells"] == (0,)
    scarce = int(counts.max()) - 1
    left_out, sown, _ = run(params, query, features, reference, visible, capacity=scarce)
    assert sown["camera_cells"] == (np.maximum(counts - scarce, 0).sum(),)
    # The last queries do without that camera, as if it did not see them.
    visible &= (jnp.cumsum(visible.any(-1), 1) <= scarce)[..., None]
    expected, _, _ = run(params, query, features, reference, visible)
    np.testing.assert_allclose(left_out, expected, atol=1e-5)


@pytest.mark.parametrize("capacity", [None, 6])
def test_camera_order_and_unseen_places_change_nothing(params, capacity):
    query, features, reference, visible = scene()
    hidden, visible = visible.any(-1)[..., None, None], jnp.asarray(visible)
    out, _, gradients = run(params, query, features, reference, visible, capacity=capacity)
    order = jnp.array([2, 0, 1])
    shuffled, _, _ = run(params, query, features[order], reference[order], visible[order], capacity=capacity)
    np.testing.assert_allclose(shuffled, out, atol=1e-5)
    same, _, also = run(params, query, features, jnp.where(hidden, reference, jnp.nan), visible, capacity=capacity)
    np.testing.assert_array_equal(same, out)
    jax.tree.map(np.testing.assert_array_equal, also, gradients)


def test_sizes_that_do_not_fit_are_named():
    query, features, reference, visible = scene()
    with pytest.raises(ValueError, match="one level and 4 anchors are needed, not 1 and 2"):
        GeometryKernelAttention(8, 4).init(jax.random.key(0), query, features, [SHAPE], reference, visible)
