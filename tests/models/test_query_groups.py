"""Groups of lane queries: all learn, the first answers, and none knows of the others."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import BASELINE, make_example
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.scene import stack_examples
from tflane_jax.training.lane_graph import LaneGraphTask

QUERIES, GROUPS = BASELINE.decoder.queries, 3
ONE = replace(BASELINE.decoder, layers=2)
HOSTS = {
    "toponet": replace(BASELINE, decoder=ONE),
    "detr": BevFormerDetrConfig(BASELINE.encoder, replace(ONE, refine="fixed"), None),
}


def grouped(task):
    return replace(task, model=replace(task.model, decoder=replace(task.model.decoder, groups=GROUPS)))


def queries_of(params, change):
    """Return parameters with other queries."""
    of = params["queries"]
    changed = {name: change(of[name]) for name in ("embedding", "anchors") if name in of}
    return params | {"queries": of | changed}


@pytest.fixture(scope="module", params=HOSTS)
def task(request):
    return LaneGraphTask(HOSTS[request.param])


@pytest.fixture(scope="module")
def params(task):
    fresh = jax.jit(grouped(task).init)(jax.random.key(0), make_example())
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda leaf: leaf + jnp.asarray(rng.normal(0, 0.05, leaf.shape), leaf.dtype), fresh)


def test_the_first_group_answers(task, params):
    one = jax.jit(task.predict)(queries_of(params, lambda leaf: leaf[:QUERIES]), make_example())
    many = jax.jit(grouped(task).predict)(params, make_example())
    jax.tree.map(np.testing.assert_array_equal, one, many)


def test_the_loss_is_the_mean_over_groups_and_each_is_matched_alone(task, params):
    batch = jax.tree.map(jnp.asarray, stack_examples([make_example(0)]))
    key, one = jax.random.key(0), jax.jit(jax.grad(task.loss, has_aux=True))
    parts = [queries_of(params, lambda leaf, g=g: leaf[g * QUERIES : (g + 1) * QUERIES]) for g in range(GROUPS)]
    alone, terms = zip(*(one(part, batch, key) for part in parts), strict=True)
    together, said = jax.jit(jax.grad(grouped(task).loss, has_aux=True))(params, batch, key)
    for name, value in said.items():
        np.testing.assert_allclose(value, np.mean([term[name] for term in terms]), rtol=1e-4, err_msg=name)
    # Groups share everything but their queries.
    mean = jax.tree.map(lambda *leaves: np.mean(leaves, 0), *(part | {"queries": {}} for part in alone))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), together | {"queries": {}}, mean)
    own = np.concatenate([part["queries"]["embedding"] for part in alone]) / GROUPS
    np.testing.assert_allclose(together["queries"]["embedding"], own, rtol=1e-3, atol=1e-6)
