"""Graph encoders against explicit dense products, and padding, sizes and intermediates."""

import dataclasses
from functools import cache, partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.layers.published_gtn import GTN_2022, meta_path_graphs
from tests.layers.test_image_graph import dense_stack
from tests.parameters import random_params
from tests.shared import random_array
from tests.slow import with_slow
from tflane_jax.layers.image_graph import SIDES
from tflane_jax.layers.masks import key_mask
from tflane_jax.layers.transformer import EncoderLayer, TransformerConfig
from tflane_jax.models.graph_encoders import (
    GcnEncoderConfig,
    GraphEncoderLayer,
    GtnEncoderConfig,
    HanEncoderConfig,
    HeterogeneousAttention,
    MetaPathConvolution,
)

DIM, SHAPE, BLOCK = 8, (5, 6), (3, 4)
GTN = GtnEncoderConfig(head_dim=4, hidden=16)
CONFIGS = {
    "gtn": GTN,
    "gtn every hop": dataclasses.replace(GTN, similarity="every_hop", hops=3, heads=2, channels=4),
    "gtn structural": dataclasses.replace(GTN, similarity=None),
    "gtn similarity alone": dataclasses.replace(GTN, similarity="every_hop", relations=()),
    "gcn": GcnEncoderConfig(hidden=16),
    "han": HanEncoderConfig(hidden=16, semantic=8),
    "han meta-paths": HanEncoderConfig(1, hidden=16, semantic=8, relations=("near", "near+row", "row+column")),
}
# Each of these has a part that no other has; the slow ones have parts of several.
QUICK = ("gtn every hop", "gcn", "han meta-paths")
PARAMETERS = {"gtn": 23_360, "gcn": 19_072, "han": 22_016}

every_config = pytest.mark.parametrize("name", with_slow(CONFIGS, QUICK))


def scene(seed=0, shape=SHAPE):
    """Features, positions, and validity with some padding."""
    valid = np.random.default_rng(seed).random(shape) < 0.7
    return random_array(seed + 1, *shape, DIM), random_array(seed + 2, *shape, DIM), jnp.asarray(valid)


@cache
def built(config):
    """The module, and variables in which no weight is at a special value."""
    module, zeros = config.build("encoder"), jnp.zeros((1, 1, DIM))
    variables = jax.eval_shape(module.init, jax.random.key(0), zeros, zeros, jnp.ones((1, 1), bool))
    rng = np.random.default_rng(7)
    weight = lambda leaf: jnp.asarray(0.4 * rng.normal(size=leaf.shape).astype(np.float32))  # noqa: E731
    return module, jax.tree.map(weight, variables)


@cache
def compiled(name):
    """Return a program: features, position, valid -> memory, intermediates, and gradients of all but `valid`.

    The scalar weights each cell by its features.
    """
    module, variables = built(CONFIGS[name])

    def scalar(variables, features, position, valid):
        weight = jax.lax.stop_gradient(jnp.where(valid[..., None], features, 0.0))
        out, state = module.apply(variables, features, position, valid, mutable="intermediates")
        return (weight * out).sum(), (out, state["intermediates"])

    step = jax.value_and_grad(scalar, argnums=(0, 1, 2), has_aux=True)

    @jax.jit
    def run(features, position, valid):
        (_, (out, seen)), gradients = step(variables, features, position, valid)
        return out, seen, gradients

    return run


@pytest.mark.parametrize("similarity", ["last_hop", "every_hop", None])
def test_gtn_equals_dense_meta_path_products(similarity):
    """Shifts, means and attention, hop by hop, are graph convolution on the product of soft adjacencies."""
    config = dataclasses.replace(GTN, similarity=similarity, hops=3)
    x, position, valid = scene()
    x, position = jnp.where(valid[..., None], x, 0.0), jnp.where(valid[..., None], position, 0.0)
    module = MetaPathConvolution(config)
    params = random_params(module.init, x, position, valid)["params"]
    selection = random_array(3, *params["selection"].shape)
    apply = jax.jit(partial(module.apply, mutable="intermediates"))
    out, state = apply({"params": params | {"selection": selection}}, x, position, valid)

    stack = dense_stack(config.relations, np.asarray(valid))
    if similarity is not None:
        (similar,) = state["intermediates"]["probabilities"]
        stack = jnp.concatenate([stack, similar * valid.reshape(1, -1, 1)])
        offered = np.array([similarity == "every_hop", similarity == "every_hop", True])
        structural = jnp.arange(len(stack)) < len(config.relations)
        selection = jnp.where(structural[None, None] | offered[:, None, None], selection, -jnp.inf)
    (fractions,) = state["intermediates"]["relations"]
    np.testing.assert_allclose(fractions, jax.nn.softmax(selection, -1), rtol=1e-6)
    # The hop that acts first stands last in the product; normalising changes nothing, since rows sum to 1.
    graphs = meta_path_graphs(stack, selection[::-1], GTN_2022)
    np.testing.assert_allclose(graphs.sum(-1), np.broadcast_to(valid.reshape(1, -1), graphs.shape[:2]), atol=1e-5)
    value = (x @ params["value"]["kernel"]).reshape(-1, DIM) + params["value"]["bias"][None]
    heard = jnp.concatenate([graph @ half for graph, half in zip(graphs, jnp.split(value, 2, axis=1), strict=True)], 1)
    expected = (heard @ params["output"]["kernel"] + params["output"]["bias"][None]).reshape(x.shape)
    np.testing.assert_allclose(out[valid], expected[valid], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("heads", [1, 2])
def test_a_gtn_that_selects_similarity_is_the_transformers_layer(heads):
    config = dataclasses.replace(GTN, heads=heads, head_dim=DIM // heads)
    x, position, valid = scene()
    x, position = jnp.where(valid[..., None], x, 0.0), jnp.where(valid[..., None], position, 0.0)
    module = GraphEncoderLayer(config)
    params = random_params(module.init, x, position, valid)["params"]
    selection = params["graph"].pop("selection")
    shared = {
        "self_attention": params["graph"],
        "attended": {"norm": params["graph_norm"]},
        "feed_forward": {name: params[name] for name in ("expand", "contract")},
        "fed": {"norm": params["fed_norm"]},
    }
    layer, mask = EncoderLayer(TransformerConfig(heads, config.hidden)), key_mask(valid.reshape(-1))
    expected = layer.apply({"params": shared}, x.reshape(-1, DIM), position.reshape(-1, DIM), mask).reshape(x.shape)
    similar = jnp.full_like(selection, -1e9).at[0, :, 0].set(0.0).at[1, :, -1].set(0.0)
    params = params | {"graph": params["graph"] | {"selection": similar}}
    out = jax.jit(module.apply)({"params": params}, x, position, valid)
    np.testing.assert_allclose(out[valid], expected[valid], rtol=1e-4, atol=1e-5)


def dense_edge(edge, weights, heads):
    """One edge's attention weights as matrices (heads, n, n), destinations as rows."""
    height, width = SHAPE
    cells = list(np.ndindex(SHAPE))
    dense = np.zeros((heads, height * width, height * width))
    for i, (row, column) in enumerate(cells):
        if edge == "near":
            for weight, (down, right) in zip(weights[:, row, column], [(0, 0), *SIDES.values()], strict=True):
                if 0 <= row + down < height and 0 <= column + right < width:
                    dense[:, i, (row + down) * width + column + right] = weight
            continue
        for j, (other_row, other_column) in enumerate(cells):
            if edge == "row" and row == other_row:
                dense[:, i, j] = weights[row, column, other_column]
            if edge == "column" and column == other_column:
                dense[:, i, j] = weights[column, row, other_row]
    return dense


@pytest.mark.parametrize("scores", ["learned", "zero"])
def test_a_composed_meta_path_is_the_product_of_its_edges(scores):
    """Of attention matrices, with rows that sum to 1; with scores of zero, of the relations' D^-1 A."""
    relations = ("near+row", "column+near", "row+column")
    config = HanEncoderConfig(1, relations=relations, semantic=4)
    x, position, valid = scene()
    x, position = jnp.where(valid[..., None], x, 0.0), jnp.where(valid[..., None], position, 0.0)
    module = HeterogeneousAttention(config)
    params = random_params(module.init, x, position, valid)["params"]
    if scores == "zero":
        params["scores"] = jax.tree.map(jnp.zeros_like, params["scores"])
    out, state = jax.jit(partial(module.apply, mutable="intermediates"))({"params": params}, x, position, valid)
    value = np.asarray(x @ params["value"]["kernel"] + params["value"]["bias"][None, None]).reshape(-1, 2, DIM // 2)
    shown, (fractions,) = np.asarray(valid).reshape(-1), state["intermediates"]["relations"]
    by_path = []
    for relation in relations:
        path = relation.split("+")
        weights = [np.asarray(edge) for edge in state["intermediates"][f"{relation}_probabilities"]]
        dense = [dense_edge(edge, weight, 2) for edge, weight in zip(path, weights, strict=True)]
        if scores == "zero":
            first, second = (given_edge(edge, np.asarray(valid)) for edge in path)
            dense = [np.stack([graph] * 2) for graph in (first, second)]
        product = dense[1] @ (dense[0] * shown[None, :, None])
        np.testing.assert_allclose(product.sum(-1)[:, shown], 1.0, rtol=1e-5)
        heard = np.einsum("hnm,mhd->nhd", product, value).reshape(-1, DIM)
        by_path.append(np.asarray(jax.nn.elu(heard)))
    # Eq. (7) to (9): softmax of the mean over valid cells of q^T tanh(W z + b).
    summaries = [np.tanh(z @ params["semantic"]["kernel"] + params["semantic"]["bias"][None]) for z in by_path]
    asked = np.exp([(each @ params["question"]["kernel"])[shown].mean() for each in summaries])
    np.testing.assert_allclose(fractions[0, 0], asked / asked.sum(), rtol=1e-5)
    expected = np.einsum("r,rnd->nd", asked / asked.sum(), by_path)
    np.testing.assert_allclose(np.asarray(out).reshape(-1, DIM)[shown], expected[shown], rtol=1e-4, atol=1e-5)


def given_edge(edge, valid):
    """D^-1 A of one edge type (n, n), by the definition of the neighbourhood."""
    cells = np.argwhere(np.ones_like(valid))
    down, right = np.moveaxis(cells[:, None] - cells, -1, 0)
    linked = {"near": (abs(down) < 2) & (abs(right) < 2), "row": down == 0, "column": right == 0}[edge]
    linked = linked * valid.reshape(1, -1)
    return linked / np.maximum(linked.sum(1, keepdims=True), 1)


@every_config
def test_padding_changes_nothing(name):
    """The content of padded cells, NaN included, reaches neither outputs nor gradients."""
    run, (features, position, valid) = compiled(name), scene()
    fill = lambda value: [jnp.where(valid[..., None], x, value) for x in (features, position)]  # noqa: E731
    clean, dirty = run(*fill(0.0), valid), run(*fill(jnp.nan), valid)
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    out, _, (by_param, by_feature, by_position) = dirty
    np.testing.assert_array_equal(out[~valid], 0.0)
    assert float(jnp.abs(by_feature[valid]).min()) > 0
    assert bool(by_position[valid].any()) == (name not in ("gcn", "gtn structural"))  # the two without queries
    np.testing.assert_array_equal(by_feature[~valid], 0.0)
    # A constant added to all keys changes no softmax, and one edge type leaves nothing to select.
    idle = ("['key']['bias']", "['selection']") if name == "gtn similarity alone" else ("['key']['bias']",)
    for path, leaf in jax.tree.leaves_with_path(by_param):
        assert np.isfinite(leaf).all(), path
        assert jax.tree_util.keystr(path).endswith(idle) or float(jnp.abs(leaf).max()) > 0, path


@every_config
def test_without_valid_cells_the_output_is_zero(name):
    nothing = jnp.full((*SHAPE, DIM), jnp.nan, jnp.float32)
    out, _, gradients = compiled(name)(nothing, nothing, jnp.zeros(SHAPE, bool))
    for leaf in jax.tree.leaves((out, gradients)):
        np.testing.assert_array_equal(leaf, jnp.zeros_like(leaf))


@pytest.mark.parametrize("name", with_slow(CONFIGS, QUICK[:1]))
def test_the_place_of_padding_changes_nothing(name):
    """A small map, and the same map anywhere within a padded one: the same memory and the same gradients."""
    features, position, _ = scene(shape=BLOCK)
    expected, _, (by_param, by_feature, _) = compiled(name)(features, position, jnp.ones(BLOCK, bool))
    for down, right in ((0, 0), (2, 1), (1, 2)):
        place = (slice(down, down + BLOCK[0]), slice(right, right + BLOCK[1]))
        large, valid = jnp.full((*SHAPE, DIM), jnp.nan, jnp.float32), jnp.zeros(SHAPE, bool).at[place].set(True)
        padded = compiled(name)(large.at[place].set(features), large.at[place].set(position), valid)
        out, _, (to_params, to_features, _) = padded
        np.testing.assert_allclose(out[place], expected, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(to_features[place], by_feature, rtol=1e-3, atol=1e-4)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), to_params, by_param)


@every_config
def test_intermediates_are_available(name):
    config, (_, seen, _) = CONFIGS[name], compiled(name)(*scene())
    for i in range(config.layers):
        layer = seen[f"layer_{i}"]["graph"]
        (fractions,) = layer["relations"]
        np.testing.assert_allclose(fractions.sum(-1), np.ones(fractions.shape[:2]), rtol=1e-5)
        if isinstance(config, GtnEncoderConfig):
            assert fractions.shape[:2] == (config.hops, config.channels)
            assert ("probabilities" in layer) == (config.similarity is not None)
        if isinstance(config, HanEncoderConfig):
            assert {f"{relation}_probabilities" for relation in config.relations} <= set(layer)


@pytest.mark.parametrize("name", ["gtn structural", "gcn"])
def test_flipped_maps_give_flipped_memories(name):
    """The graph is symmetric if the selection weights of opposite directions are equal, as here."""
    config = dataclasses.replace(CONFIGS[name], layers=1)
    module, variables = built(config)
    variables = jax.tree.map(lambda leaf: leaf, variables)
    features, position, valid = scene()
    if isinstance(config, GtnEncoderConfig):
        left, right = (config.relations.index(side) for side in ("left", "right"))
        graph = variables["params"]["layer_0"]["graph"]
        graph["selection"] = graph["selection"].at[..., left].set(graph["selection"][..., right])
    apply = jax.jit(module.apply)
    out = apply(variables, features, position, valid)
    flipped = apply(variables, features[:, ::-1], position[:, ::-1], valid[:, ::-1])
    np.testing.assert_allclose(out[:, ::-1], flipped, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["gtn", "gtn similarity alone", "gcn", "han"])
@pytest.mark.parametrize("shape", [(1, 1), (0, 4)])
def test_small_maps(name, shape):
    module, variables = built(dataclasses.replace(CONFIGS[name], layers=1))
    x = random_array(5, *shape, DIM)
    out = jax.jit(module.apply)(variables, x, x, jnp.ones(shape, bool))
    assert out.shape == x.shape
    assert np.isfinite(out).all()


@pytest.mark.slow
def test_the_weights_of_meta_paths_do_not_depend_on_the_number_of_cells():
    """Semantic attention is over the mean of all cells (Eq. 7): a map repeated in rows and columns has the same."""
    module = HeterogeneousAttention(HanEncoderConfig(semantic=8, relations=("row", "column")))
    x, position, valid = scene()
    params = random_params(module.init, x, position, valid, spread=1.0)
    repeated = (jnp.tile(leaf, (2, 2, 1)[: leaf.ndim]) for leaf in (x, position, valid))
    out, often = module.apply(params, x, position, valid), module.apply(params, *repeated)
    shown = np.tile(valid, (2, 2))
    np.testing.assert_allclose(often[shown], np.tile(out, (2, 2, 1))[shown], rtol=1e-4, atol=1e-5)


def test_dropout_is_seeded():
    """Dropout of the encoder layer that all graphs have in common."""
    module, variables = built(dataclasses.replace(CONFIGS["gcn"], layers=1))
    apply = jax.jit(module.apply, static_argnames="deterministic")
    run = lambda seed: apply(variables, *scene(), deterministic=False, rngs={"dropout": jax.random.key(seed)})  # noqa: E731
    np.testing.assert_array_equal(run(0), run(0))
    assert float(jnp.abs(run(0) - run(1)).max()) > 0
    assert float(jnp.abs(run(0) - apply(variables, *scene(), deterministic=True)).max()) > 0


@pytest.mark.parametrize(
    ("name", "attends"), [("gtn", True), ("gcn", False), pytest.param("han", True, marks=pytest.mark.slow)]
)
def test_dropout_reaches_attention_weights(name, attends):
    """As in the transformer's layer. The dropout that all layers have in common is left out."""
    module, variables = built(dataclasses.replace(CONFIGS[name], layers=1))

    def others_off(call, arguments, settings, context):
        common = isinstance(context.module, nn.Dropout) and context.module.name != "weights_dropout"
        return arguments[0] if common else call(*arguments, **settings)

    with nn.intercept_methods(others_off):
        run = lambda **how: module.apply(variables, *scene(), **how)  # noqa: E731
        first, second = (run(deterministic=False, rngs={"dropout": jax.random.key(seed)}) for seed in range(2))
        change = float(jnp.abs(first - run(deterministic=True)).max())
    assert (change > 1e-3) == attends
    assert (float(jnp.abs(first - second).max()) > 1e-3) == attends


@pytest.mark.parametrize("name", PARAMETERS)
def test_number_of_parameters_at_lstrs_size(name):
    """Beside LSTR's transformer encoder: 25,408."""
    config = {"gtn": GtnEncoderConfig(), "gcn": GcnEncoderConfig(), "han": HanEncoderConfig()}[name]
    module, x = config.build("encoder"), jnp.zeros((12, 20, 32))
    variables = jax.eval_shape(module.init, jax.random.key(0), x, x, jnp.ones((12, 20), bool))
    assert sum(leaf.size for leaf in jax.tree.leaves(variables)) == PARAMETERS[name]
