"""Graph Transformer Networks against the reference's numbers, and the properties of its degree normalisation."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from tests.golden import case_id, golden_modules, implemented, load_module_case, options
from tests.golden_compare import compare
from tests.layers.published_gtn import (
    GTN_2019,
    GTN_2022,
    FastGraphTransformer,
    GraphTransformer,
    convolve,
    meta_path_graphs,
    normalise,
    select,
)
from tflane_jax.layers.graph_transformer import propagate

VARIANTS = {"2019": GTN_2019, "2022": GTN_2022}


def weight(params, name):
    """A 1x1 convolution's kernel as (channels, edge types)."""
    return params[f"{name}.weight"].reshape(params[f"{name}.weight"].shape[:2])


def linear(params, name, x):
    return x @ params[f"{name}.weight"].T + params[f"{name}.bias"][None]


def classified(params, name, x, case):
    """The reference's classifier of some of the nodes, and its loss."""
    y = linear(params, name, x[case.inputs["target_x"]])
    picked = jnp.take_along_axis(jax.nn.log_softmax(y), case.inputs["target"][:, None], 1)
    return {"y": y, "loss": -picked.mean()}


def type_weights(params, name):
    return jax.nn.softmax(params[f"{name}.weight"], 1)


def single_selection(case, params, inputs):
    kernel = params["weight"]
    return {"output": select(inputs["A"][0], kernel.reshape(kernel.shape[:2]))}


def first_layer(case, params, inputs):
    weights = jnp.stack([weight(params, "conv1"), weight(params, "conv2")])
    graphs = meta_path_graphs(inputs["A"][0], weights, GTN_2019)
    return {"H": graphs, "W0": type_weights(params, "conv1"), "W1": type_weights(params, "conv2")}


def next_layer(case, params, inputs):
    graphs = inputs["H"] @ select(inputs["A"][0], weight(params, "conv1"))
    return {"H": graphs, "W0": type_weights(params, "conv1")}


def selections(case, params):
    further = [f"layers.{i}.conv1" for i in range(1, options(case, "layers").layers)]
    names = ["layers.0.conv1", "layers.0.conv2", *further]
    return names, jnp.stack([weight(params, name) for name in names])


def dense_model(case, params, inputs):
    """GTN of 2019: an MLP on the concatenated channels, then the classifier."""
    sizes, (names, chosen) = options(case, "w_out", "channels", "layers"), selections(case, params)
    adjacency = inputs["A"].transpose(2, 0, 1)
    model = GraphTransformer(sizes.w_out, sizes.channels, sizes.layers, GTN_2019)
    variables = {"selection": chosen, "convolution": {"kernel": params["weight"]}}
    x = model.apply({"params": variables}, adjacency, inputs["X"])
    outs = {}
    for name in names:
        _, layer, convolution = name.split(".")
        outs[f"W.{layer}.{int(convolution.removeprefix('conv')) - 1}"] = type_weights(params, name)
    for i in range(sizes.layers):
        outs[f"H.{i}"] = meta_path_graphs(adjacency, chosen[: i + 2], GTN_2019)
    for i in range(sizes.layers - 1):
        outs[f"Hnorm.{i}"] = normalise(outs[f"H.{i}"], "columns", "removed")
    last = outs[f"H.{sizes.layers - 1}"]
    identity = jnp.eye(len(inputs["X"]))
    added, convolved = (convolve(last, x, GTN_2019) for x in (identity, inputs["X"] @ params["weight"]))
    outs |= {f"norm_add.{c}": added[c].T for c in range(sizes.channels)}
    outs |= {f"gcn.{c}": convolved[c] for c in range(sizes.channels)}
    return outs | classified(params, "linear2", jax.nn.relu(linear(params, "linear1", x)), case)


def sparse_model(case, params, inputs):
    """GTN of 2022: the adjacency with receivers as rows, and the classifier on the concatenated channels."""
    sizes = options(case, "w_out", "channels", "layers", remove_self_loops=False)
    _, chosen = selections(case, params)
    adjacency = inputs["A"].transpose(2, 1, 0)
    # `remove_self_loops` adds no identity in the convolution, but keeps the loops that meta-paths close.
    variant = replace(GTN_2022, own=0.0) if sizes.remove_self_loops else GTN_2022
    model = GraphTransformer(sizes.w_out, sizes.channels, sizes.layers, variant)
    variables = {"selection": chosen, "convolution": {"kernel": params["gcn.weight"]}, "bias": params["gcn.bias"]}
    x = model.apply({"params": variables}, adjacency, inputs["X"])
    outs, before = {}, None
    for i in range(sizes.layers):
        graphs = meta_path_graphs(adjacency, chosen[: i + 2], variant)
        raw = select(adjacency, chosen[0]) if before is None else before
        product = raw @ select(adjacency, chosen[i + 1])
        outs |= {f"H.{i}.{c}": product[c] for c in range(sizes.channels)}
        outs |= {f"Hnorm.{i}.{c}": graphs[c] for c in range(sizes.channels)}
        before = graphs
    convolved = convolve(before, inputs["X"] @ params["gcn.weight"], variant) + params["gcn.bias"][None, None]
    outs |= {f"gcn.{c}": convolved[c] for c in range(sizes.channels)}
    return outs | classified(params, "linear", x, case)


def fast_model(case, params, inputs):
    found = options(
        case, "node_dim", "channels", "layers", fast_layers=1, beta=0.0, channel_agg="concat", non_local=False, K=None
    )
    implemented(case, channel_agg=["concat", "mean"])
    adjacency = inputs["A"].transpose(2, 1, 0)
    # The last relation is the identity.
    adjacency = jnp.concatenate([normalise(adjacency[:-1], loops="lonely"), adjacency[-1:]])
    outs = {f"Anorm.{e}": matrix for e, matrix in enumerate(adjacency)}
    x, nearest = inputs["X"], found.K if found.non_local else None
    sizes = (found.node_dim, found.channels, found.layers, found.beta, found.channel_agg)
    for k in range(found.fast_layers):
        below = f"fastGTNs.{k}"
        names = [f"{below}.layers.{i}.conv1" for i in range(found.layers)]
        kernel = jnp.concatenate([params[f"{below}.Ws.{c}"] for c in range(found.channels)], 1)
        selection = jnp.stack([weight(params, name) for name in names])
        ours = {"selection": selection, "projection": {"kernel": kernel}}
        if found.channel_agg == "concat":
            ours["joined"] = layer(params, f"{below}.linear1")
        for i in range(found.layers if found.non_local else 0):
            mlp = {f"linear_{n}": layer(params, f"{below}.feat_trans_layers.{i}.{2 * n}") for n in range(2)}
            ours[f"non_local_{i}"] = {"features": mlp}
        x = FastGraphTransformer(*sizes, non_local=nearest).apply({"params": ours}, adjacency, x)
        outs |= {f"H{k}": x} | {f"W.{i}": type_weights(params, name) for i, name in enumerate(names)}
    return outs | classified(params, "linear", x, case)


def layer(params, name):
    return {"kernel": params[f"{name}.weight"].T, "bias": params[f"{name}.bias"]}


RUNS: dict[str, Any] = {
    "GTConv": single_selection,
    "GTLayer": {False: first_layer, True: next_layer},
    "GTN": dense_model,
    "GTN (2022 sparse version)": sparse_model,
    "FastGTNs": fast_model,
}


def run_of(case):
    """The program for a case, by the class that the file was made from."""
    run = RUNS[case.source.split(".py ")[1]]
    return run["H" in case.inputs] if isinstance(run, dict) else run


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("gtn_*"), ids=case_id)
def test_matches_the_reference(path):
    check(load_module_case(path))


def check(case):
    run = run_of(case)
    compare(case, lambda params, inputs: run(case, params, inputs))


def random_graphs(seed, *shape, fraction=0.4):
    rng = np.random.default_rng(seed)
    return jnp.asarray((rng.random(shape) * (rng.random(shape) < fraction)).astype(np.float32))


def random_weights(seed, count, channels=2, types=3):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(count, channels, types)).astype(np.float32))


def test_gradients_match_finite_differences():
    with jax.enable_x64(True):
        adjacency = random_graphs(0, 3, 5, 5).astype(jnp.float64)
        weights = random_weights(1, 3).astype(jnp.float64)
        x = random_graphs(2, 5, 4).astype(jnp.float64)
        check_grads(jax.jit(lambda w: select(adjacency, w)), (weights[0],), 1, ["rev"], 1e-6, 1e-6)
        for variant in VARIANTS.values():
            run = jax.jit(lambda w, v=variant: convolve(meta_path_graphs(adjacency, w, v), x, v))
            check_grads(run, (weights,), 1, ["rev"], 1e-6, 1e-6)


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_nodes_without_incoming_edges_have_finite_gradients(variant):
    """The reference divides 0 by 0 for such nodes."""
    adjacency = random_graphs(3, 3, 6, 6).at[:, 2].set(0.0).at[:, :, 2].set(0.0)
    model = GraphTransformer(4, layers=3, variant=variant)
    x = random_graphs(4, 6, 5)
    variables = jax.jit(model.init)(jax.random.key(0), adjacency, x)
    gradients = jax.jit(jax.grad(lambda v, a: model.apply(v, a, x).sum(), argnums=(0, 1)))(variables, adjacency)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradients))


_normalise = jax.jit(normalise, static_argnums=(1, 2))


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.sampled_from(["rows", "columns"]), st.sampled_from(["kept", "removed", "lonely"]))
def test_edges_into_a_node_sum_to_one(seed, receivers, loops):
    graphs = random_graphs(seed, 2, 4, 4, fraction=0.3)
    out = np.asarray(_normalise(graphs, receivers, loops))
    seen = np.asarray(graphs) * (1 - np.eye(4) if loops == "removed" else 1)
    axis = 2 if receivers == "rows" else 1
    expected = (seen.sum(axis) > 0) | (loops == "lonely")
    np.testing.assert_allclose(out.sum(axis), expected, atol=1e-6)
    if loops == "removed":
        np.testing.assert_array_equal(np.diagonal(out, axis1=1, axis2=2), np.zeros((2, 4)))


def test_selection_mixes_between_the_edge_types():
    adjacency = random_graphs(5, 3, 4, 4)
    one_hot = jnp.asarray([[0.0, 100.0, 0.0], [0.0, 0.0, 0.0]])
    first, second = select(adjacency, one_hot)
    np.testing.assert_allclose(first, adjacency[1], rtol=1e-6)
    np.testing.assert_allclose(second, adjacency.mean(0), rtol=1e-6)


@pytest.mark.parametrize("hops", [1, 2, 4])
def test_hop_by_hop_equals_the_product_of_the_selections(hops):
    """With rows that sum to 1, FastGTN's hops are the products of 2022, whose normalisation changes nothing."""
    adjacency = normalise(random_graphs(6, 3, 7, 7), loops="lonely")
    weights, x = random_weights(7, hops), random_graphs(8, 7, 6)
    hopped = propagate(lambda _, fractions, h: jnp.einsum("ed,enm,md->nd", fractions, adjacency, h), weights, x)
    graphs = jax.jit(meta_path_graphs)(adjacency, weights[::-1])
    expected = jnp.concatenate([graphs[c] @ x[:, 3 * c : 3 * c + 3] for c in range(2)], 1)
    np.testing.assert_allclose(hopped, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("nodes", [0, 1])
@pytest.mark.parametrize("build", [partial(GraphTransformer, 3), partial(FastGraphTransformer, 3)])
def test_small_graphs(nodes, build):
    adjacency, x = jnp.ones((2, nodes, nodes)), jnp.ones((nodes, 4))
    out, variables = jax.jit(build().init_with_output)(jax.random.key(0), adjacency, x)
    assert out.shape[0] == nodes
    assert np.isfinite(out).all()
    assert variables["params"]["selection"].shape[1:] == (2, 2)
