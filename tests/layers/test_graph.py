"""The scene graph against the reference's numbers, plain loops, and permutations of lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import batch_leading, case_id, golden_modules, load_module_case, numbered, options
from tests.golden_compare import compare
from tflane_jax.convert.toponet import RELATIONSHIP, SCENE_GRAPH
from tflane_jax.layers.graph import (
    ElementGraphConvolution,
    ElementNodes,
    LaneGraphConvolution,
    Mlp,
    RelationshipHead,
    SceneGraphFeedForward,
    edge_probabilities,
)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("toponet_lclc_gcn*"), ids=case_id)
def test_graph_convolution_matches_the_reference(path):
    case = load_module_case(path)
    module = LaneGraphConvolution(case.params["weight"].shape[1], options(case, edge_weight=0.6).edge_weight)
    ours = {"weight": "own", "weight_forward": "forward", "weight_backward": "backward"}

    def outputs(torch_params, arrays):
        params = {ours[name]: {"kernel": value} for name, value in torch_params.items()}
        out = jax.vmap(lambda x, a: module.apply({"params": params}, x, a))(arrays["input"], arrays["adj"])
        return {"output": out}

    compare(case, outputs)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("toponet_lcte_gcn*"), ids=case_id)
def test_element_messages_match_the_reference(path):
    case = load_module_case(path)
    module = ElementGraphConvolution(case.params["weight"].shape[-1], options(case, edge_weight=0.6).edge_weight)

    def outputs(torch_params, arrays):
        def one(*nodes):
            return module.apply({"params": {"kernel": torch_params["weight"]}}, ElementNodes(*nodes))

        return {"output": jax.vmap(one)(arrays["te_query"], arrays["te_cls_scores"], arrays["lcte_adj"])}

    compare(case, outputs)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("toponet_ffn_sgnn*"), ids=case_id)
def test_scene_graph_matches_the_reference(path):
    case = load_module_case(path)
    sizes = options(case, "hidden", edge_weight=0.6)
    module = SceneGraphFeedForward(case.inputs["lc_query"].shape[-1], sizes.hidden, sizes.edge_weight)
    # Without elements the file has none of their inputs.
    names = [name for name in ("te_query", "te_cls_scores", "lcte_adj") if name in case.inputs]

    def outputs(torch_params, arrays):
        params = converted_params(torch_params, SCENE_GRAPH)

        def one(x, adjacency, *nodes):
            return module.apply({"params": params}, x, adjacency, ElementNodes(*nodes) if nodes else None)

        lanes = batch_leading(case, arrays["lc_query"])
        out = jax.vmap(one)(lanes, arrays["lclc_adj"], *(arrays[name] for name in names))
        return {"output": batch_leading(case, out)}

    compare(case, outputs)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("toponet_relationship_head*"), ids=case_id)
def test_relationship_head_matches_the_reference(path):
    case = load_module_case(path)
    last = numbered(case.params, r"MLP_o1\.layers\.(\d+)\.bias")[-1]
    module = RelationshipHead(len(case.params[last]))

    def outputs(torch_params, arrays):
        params = converted_params(torch_params, RELATIONSHIP)
        logits = jax.vmap(lambda a, b: module.apply({"params": params}, a, b))(arrays["o1_feats"], arrays["o2_feats"])
        return {"rel_pred": logits[..., None], "loss_rel": reference_loss(logits, case.inputs)}

    compare(case, outputs)


def reference_loss(logits, inputs):
    """Mean focal loss over every pair of the batch, as TopoNet has it, weight 5, from the stored assignments."""
    import optax

    targets = np.zeros(logits.shape, np.float32)
    for b in range(len(targets)):
        o1, o2 = (inputs[f"o{i}.pos_inds.{b}"] for i in (1, 2))
        g1, g2 = (inputs[f"o{i}.pos_assigned_gt_inds.{b}"] for i in (1, 2))
        targets[b][np.ix_(o1, o2)] = inputs[f"gt_adj.{b}"][np.ix_(g1, g2)]
    return 5.0 * optax.losses.sigmoid_focal_loss(logits, targets, alpha=0.25, gamma=2.0).mean()


def test_pairs_match_the_joined_form():
    """U a + V b equals one linear layer on [a | b], pair by pair."""
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.normal(size=(n, 6)).astype(np.float32)) for n in (4, 3))
    module = RelationshipHead(5)
    params = module.init(jax.random.key(0), a, b)["params"]
    got = module.apply({"params": params}, a, b)
    sides = [Mlp((6, 6, 5)).apply({"params": params[f"mlp_{s}"]}, x) for s, x in (("first", a), ("second", b))]
    kernel = np.concatenate([params["pair_first"]["kernel"], params["pair_second"]["kernel"]])
    for i in range(4):
        for j in range(3):
            joined = np.concatenate([sides[0][i], sides[1][j]])
            x = np.maximum(joined @ kernel + params["pair_first"]["bias"], 0)
            x = np.maximum(x @ params["pair_hidden"]["kernel"] + params["pair_hidden"]["bias"], 0)
            expected = x @ params["pair_out"]["kernel"] + params["pair_out"]["bias"]
            assert float(got[i, j]) == pytest.approx(float(expected[0]), abs=1e-5)


def test_scene_graph_is_equivariant_and_works_without_lanes():
    rng = np.random.default_rng(1)
    x = jnp.asarray(rng.normal(size=(6, 8)).astype(np.float32))
    adjacency = jnp.asarray(rng.random((6, 6)).astype(np.float32))
    module = SceneGraphFeedForward(8, 12)
    params = module.init(jax.random.key(0), x, adjacency)
    order = rng.permutation(6)
    out = module.apply(params, x, adjacency)
    permuted = module.apply(params, x[order], adjacency[order][:, order])
    np.testing.assert_allclose(out[order], permuted, rtol=1e-5, atol=1e-5)
    assert module.apply(params, x[:0], adjacency[:0, :0]).shape == (0, 8)
    assert RelationshipHead(4).init_with_output(jax.random.key(0), x, x[:0])[0].shape == (6, 0)


def test_edges_carry_no_gradient():
    assert float(jax.grad(lambda z: edge_probabilities(z).sum())(jnp.ones((2, 2))).sum()) == 0.0


def test_classes_of_elements_carry_no_gradient():
    rng = np.random.default_rng(2)
    features, logits, edges = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((3, 4), (3, 2), (5, 3)))
    module = ElementGraphConvolution(6)
    params = module.init(jax.random.key(0), ElementNodes(features, logits, edges))
    by_nodes = jax.grad(lambda nodes: jnp.square(module.apply(params, nodes)).sum())
    found = by_nodes(ElementNodes(features, logits, edges))
    assert not found.logits.any()
    assert found.features.any()
    assert found.edges.any()
