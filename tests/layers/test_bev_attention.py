"""BEVFormer's attentions against the reference's numbers; capacity, cameras and padding."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import (
    assert_gradients_close,
    assert_outputs_close,
    case_id,
    golden_modules,
    load_module_case,
    named_gradients,
)
from tflane_jax.convert.bevformer import SPATIAL_ATTENTION, TEMPORAL_ATTENTION
from tflane_jax.convert.renaming import renamed_params
from tflane_jax.layers.bev_attention import SpatialCrossAttention, TemporalSelfAttention, first_seen


def check(case, scalar):
    step = jax.jit(jax.value_and_grad(scalar, argnums=(0, 1), has_aux=True))
    (total, out), (by_param, by_input) = step(case.params, case.inputs)
    assert_outputs_close({"output": out, "grad_scalar": total}, case.outputs)
    assert_gradients_close(named_gradients(by_param, by_input), case.gradients)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("tsa_*"), ids=case_id)
def test_temporal_attention_matches_the_reference(path):
    case = load_module_case(path)
    shape = tuple(int(n) for n in case.inputs.pop("spatial_shapes")[0])
    case.inputs.pop("shift", None)
    config, twice = case.meta["config"], "olv2" in case.meta["name"]
    dim, points = config.get("embed_dims", config.get("C")), config.get("num_points", config.get("points"))
    module = TemporalSelfAttention(dim, config.get("num_heads", config.get("heads")), points, 1 + twice)

    def scalar(torch_params, arrays):
        params = renamed_params(torch_params, TEMPORAL_ATTENTION)
        queries = arrays["query"]
        history = arrays.get("prev_bev", queries)
        batch = len(queries)
        # The reference's batch bug: offsets and weights read the first entries of [previous 0, present 0, previous 1].
        mixed = jnp.stack([history, queries], 1).reshape(2 * batch, *queries.shape[1:])[:batch]
        read = history if twice else mixed

        def one(query, position, history, read, reference):
            def read_other(run, args, kwargs, context):
                if context.module.name in ("sampling_offsets", "attention_weights"):
                    args = (jnp.concatenate([read, args[0][:, dim:]], -1),)
                return run(*args, **kwargs)

            with nn.intercept_methods(read_other):
                attended = module.apply({"params": params}, query + position, history, query, shape, reference)
            return query + attended

        reference = arrays["reference_points"].reshape(batch, 2, -1, 2).swapaxes(1, 2)
        out = jnp.stack([one(*a) for a in zip(queries, arrays["query_pos"], history, read, reference, strict=True)])
        return (out * case.weights["output"]).sum(), out

    check(case, scalar)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("sca_*"), ids=case_id)
@pytest.mark.parametrize("capacity", [None, 13])
def test_spatial_attention_matches_the_reference(path, capacity):
    case = load_module_case(path)
    shapes = [tuple(int(n) for n in row) for row in case.inputs.pop("spatial_shapes")]
    mask = case.inputs.pop("bev_mask")
    config = case.meta["config"]
    module = SpatialCrossAttention(config["embed_dims"], config["num_heads"], config["num_points"], capacity)
    seen = mask.any(-1).sum(0)
    if capacity is not None:
        assert mask.any(-1).sum(-1).max() <= capacity < mask.shape[2]

    def scalar(torch_params, arrays):
        params = renamed_params(torch_params, SPATIAL_ATTENTION)
        bias = params["output_proj"]["bias"]

        def one(query, features, reference, count):
            # The reference's batch bug: whom a camera serves is read from the first element's mask, but the mean is
            # taken over the cameras of each element's own.
            attended = module.apply({"params": params}, query, features, shapes, reference, mask[:, 0])
            factor = np.maximum(seen[0], 1) / np.maximum(count, 1)
            return query + (attended - bias[None]) * factor[:, None] + bias[None]

        per_element = (
            arrays["query"],
            arrays["feats"].transpose(2, 0, 1, 3),
            arrays["reference_points_cam"].swapaxes(0, 1),
            seen,
        )
        out = jnp.stack([one(*a) for a in zip(*per_element, strict=True)])
        return (out * case.weights["output"]).sum(), out

    check(case, scalar)


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
        return module.apply({"params": params}, *arguments, mutable=["intermediates"])

    out, pull, sown = jax.vjp(apply, params, query, features, has_aux=True)
    return (out, sown.get("intermediates", {})), pull(jnp.cos(jnp.arange(out.size)).reshape(out.shape))


def run(variables, query, features, reference, visible, capacity=None):
    """Return the attended features and what was sown, and the gradients by parameters, query and features."""
    return both(variables["params"], query, features, reference, jnp.asarray(visible), capacity)


def test_enough_capacity_changes_nothing_and_too_little_is_told(variables):
    query, features, reference, visible = scene()
    counts = visible.any(-1).sum(1)
    (dense, _), by_dense = run(variables, query, features, reference, visible)
    (compact, sown), by_compact = run(variables, query, features, reference, visible, int(counts.max()))
    np.testing.assert_allclose(compact, dense, atol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), by_compact, by_dense)
    assert sown["overflow"] == (0,)
    # The third query's share of what no camera sees is the bias alone.
    np.testing.assert_array_equal(dense[3], variables["params"]["output_proj"]["bias"])
    scarce = int(counts.max()) - 1
    (_, sown), _ = run(variables, query, features, reference, visible, scarce)
    assert sown["overflow"] == (np.maximum(counts - scarce, 0).sum(),)


@pytest.mark.parametrize("capacity", [None, 5])
def test_cameras_have_no_order_and_unseen_places_no_say(variables, capacity):
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
