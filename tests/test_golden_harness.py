"""The golden harness itself: fixtures of known kinds with other layouts, batches, options and sizes.

Each variant is a public case transformed by something that must not matter or matters in a known way, or a case whose
numbers are computed here with numpy.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from tests.converted import converted_params
from tests.golden import ModuleCase, golden_entries, implemented, load_module_case, numbered, options
from tests.golden_compare import compare
from tests.layers import test_attention_golden, test_bev_attention, test_deformable, test_transformer
from tests.layers.test_graph_transformer import check as check_graph_transformer
from tests.losses.test_costs import check_assignment
from tests.models import test_bevformer_golden, test_sd_map_golden
from tests.models.golden_bev import aligned, bev_config
from tests.slow import with_slow
from tflane_jax.convert.sd_map import SD_MAP_ENCODER
from tflane_jax.models.sd_map_encoder import SdMapEncoder

pytestmark = pytest.mark.golden
RNG = np.random.default_rng(0)


def public(name):
    """Return a public case; skip where the golden files are absent."""
    path = golden_entries().get(f"modules/{name}")
    if path is None:
        pytest.skip("needs the golden files under $TFLANE_SHARED")
    return load_module_case(path)


def with_options(case, **changed):
    return replace(case, meta=case.meta | {"config": case.meta.get("config", {}) | changed}, read=set())


def mapped(arrays, change, names):
    return {name: change(value) if name in names else value for name, value in arrays.items()}


def other_layout(case, *names, default=False):
    """Return the case with the first two axes of some arrays swapped, and `batch_first` the other way round."""
    swap = lambda array: array.swapaxes(0, 1)  # noqa: E731
    first = case.meta["config"].get("batch_first", default)
    return replace(
        with_options(case, batch_first=not first),
        inputs=mapped(case.inputs, swap, names),
        outputs=mapped(case.outputs, swap, names),
        weights=mapped(case.weights, swap, names),
        gradients=mapped(case.gradients, swap, [f"in/{name}" for name in names]),
    )


def without_gradients(case):
    return replace(case, gradients={}, weights={}, read=set())


SEQUENCES = ("query", "key", "value", "query_pos", "src", "tgt", "memory", "output", "output_noweights")
LAYERS = {
    "mha_keypad_bool": test_attention_golden.check,
    "mha_fullymasked": test_attention_golden.check,
    "mha_attnmask_float_perhead": test_attention_golden.check,
    "torch_encoder_layer_post": test_transformer.check_encoder_layer,
    "torch_decoder_layer_pre": test_transformer.check_decoder_layer,
    "msda_module_ref2": test_deformable.check,
}


@pytest.mark.parametrize("name", LAYERS)
def test_either_layout_of_the_batch(name):
    LAYERS[name](other_layout(public(name), *SEQUENCES))


def test_the_layout_matters():
    case = with_options(public("mha_keypad_bool"), batch_first=True)
    with pytest.raises((AssertionError, ValueError, TypeError)):
        test_attention_golden.check(case)


@pytest.mark.parametrize("name", LAYERS)
def test_gradients_may_be_absent(name):
    LAYERS[name](without_gradients(public(name)))


def twice(case, axes, *, outputs=("output",), axis=0):
    """Return a case with every batch element repeated: parameters get twice the gradient.

    Gradients by inputs are left out: the reference's mixed history sends some of them to another element.

    Args:
        case: without history, where the reference's batch bugs leave repeated elements alone.
        axes: of the batch, by input; others have none.
        outputs: to be repeated along `axis`.
    """
    repeated = lambda value, axis: np.concatenate([value, value], axis)  # noqa: E731
    gradients = {name: 2 * value for name, value in case.gradients.items() if not name.startswith("in/")}
    return replace(
        case,
        inputs={name: repeated(v, axes[name]) if name in axes else v for name, v in case.inputs.items()},
        outputs={n: repeated(v, axis) for n, v in case.outputs.items() if n in outputs}
        | {"grad_scalar": 2 * case.outputs["grad_scalar"]},
        weights={name: repeated(v, axis) for name, v in case.weights.items()},
        gradients=gradients,
        read=set(),
    )


@pytest.mark.slow
def test_a_batch_of_two_through_the_encoder():
    case = public("bevformer_encoder_2layer_noprev")
    axes = {"bev_query": 1, "feats": 2, "bev_pos": 1, "shift": 0, "lidar2img": 0, "can_bus": 0}
    test_bevformer_golden.check_encoder(twice(case, axes))


@pytest.mark.slow
def test_a_batch_of_two_through_the_constructer():
    case = public("bev_constructer_toponet_noprev")
    axes = dict.fromkeys(("feat0", "feat1", "lidar2img", "can_bus", "lidar2global_rotation"), 0)
    test_bevformer_golden.check_constructer(twice(case, axes))


def test_a_batch_of_four_through_temporal_attention():
    case = public("tsa_noprev_bs1")
    axes = dict.fromkeys(("query", "query_pos", "shift", "reference_points"), 0)
    case = twice(twice(case, axes), axes)
    test_bev_attention.check_temporal(case)


def test_a_shift_along_the_axes_of_the_lidar_is_bevformers():
    """The reference's formula, written out: length, heading and direction of the motion in degrees."""
    case = public("smerf_bev_constructer")
    case.inputs["can_bus"] = RNG.normal(size=(5, 18)).astype(np.float32)
    (x, y), heading = case.inputs["can_bus"][:, :2].T, case.inputs["can_bus"][:, -2]
    length, angle = np.hypot(x, y), heading - np.arctan2(y, x)
    low, high = np.array(options(case, "pc_range").pc_range).reshape(2, 3)
    expected = np.stack([length * np.sin(angle), length * np.cos(angle)], -1) / (high - low)[:2]
    config = bev_config(case)
    assert config.align == "bevformer"
    _, shift = aligned(case, config)
    np.testing.assert_allclose(shift, expected, atol=1e-6)
    ego = replace(config, align="reference")
    case.inputs["lidar2global_rotation"] = np.broadcast_to(np.eye(3, dtype=np.float32), (5, 3, 3))
    assert np.abs(np.asarray(aligned(case, ego)[1]) - expected).max() > 0.01


@pytest.mark.slow
def test_a_map_encoder_without_categories():
    """Without weights for its category, a line is encoded as if it had none."""
    case = public("smerf_map_graph_transformer")
    names = numbered(case.inputs, r"poly(\d+)")
    weight = case.params["map_embedding.weight"]
    width = weight.shape[1] - case.inputs["onehot.0"].shape[1]
    silenced = case.params | {"map_embedding.weight": np.where(np.arange(weight.shape[1]) < width, weight, 0.0)}
    found = {}
    config, limits = test_sd_map_golden.encoder_config(case)
    variables = {"params": converted_params(silenced, SD_MAP_ENCODER)}
    for name in names:
        lines = case.inputs[name]
        sd_map = test_sd_map_golden.SdMap(lines, np.zeros(len(lines), np.int32), np.ones(len(lines), bool))
        encode = jax.jit(lambda sd_map: SdMapEncoder(config, limits).apply(variables, sd_map)[0])
        found[name.replace("poly", "feat")] = np.asarray(encode(jax.tree.map(jnp.asarray, sd_map)))
    inputs = {n: v[:, :0] if n.startswith("onehot") else v for n, v in case.inputs.items()}
    bare = replace(
        without_gradients(with_options(case, categories=0, input_dim=width)),
        params=case.params | {"map_embedding.weight": weight[:, :width]},
        inputs=inputs,
        outputs=found,
    )
    test_sd_map_golden.check_map_encoder(bare, "made here")
    absent = replace(bare, inputs={n: v for n, v in inputs.items() if not n.startswith("onehot")}, read=set())
    test_sd_map_golden.check_map_encoder(absent, "made here")


@pytest.mark.parametrize("classes", with_slow([1, 3], quick=[3]))
def test_an_assignment_with_normalised_truth_and_other_classes(classes):
    queries, lanes, points = 9, 4, 5
    low, high = np.array([-30.0, -15.0, -3.0]), np.array([30.0, 15.0, 2.0])
    logits, labels = RNG.normal(size=(queries, classes)), RNG.integers(0, classes, lanes)
    truth, found = RNG.uniform(-10, 10, (lanes, points, 3)), RNG.uniform(size=(queries, 3 * points))
    p = 1 / (1 + np.exp(-logits))
    focal = 0.75 * p**2 * np.log(1 - p + 1e-12) - 0.25 * (1 - p) ** 2 * np.log(p + 1e-12)
    unit = ((truth - low) / (high - low)).reshape(lanes, -1)
    cost = 1.5 * focal[:, labels] + 0.025 * np.abs(found[:, None] - unit[None]).sum(-1)
    rows, columns = linear_sum_assignment(cost)
    assigned = np.zeros(queries, int)
    assigned[rows] = columns + 1
    inputs = {"lane_pred": found, "cls_pred": logits, "gt_lanes": truth.reshape(lanes, -1)}
    inputs = {name: value.astype(np.float32) for name, value in inputs.items()} | {"gt_labels": labels}
    meta = {"name": "made here", "normalize_gt": True, "pc_range": [*low, *high]}
    check_assignment(ModuleCase(meta, {}, inputs, {"cost": cost, "gt_inds": assigned}, {}, {}))


def softmax(x, axis=-1):
    weights = np.exp(x - x.max(axis, keepdims=True))
    return weights / weights.sum(axis, keepdims=True)


def row_normalised(graph):
    total = graph.sum(1, keepdims=True)
    return np.divide(graph, total, out=np.zeros_like(graph), where=total > 0)


def graph_case(source, config, params, classifier, outputs_of):
    """Return a case of a graph network of 7 nodes and 3 relations beside the identity, without gradients."""
    nodes, classes = 7, 2
    relations = RNG.random((nodes, nodes, 4)) * (RNG.random((nodes, nodes, 4)) < 0.4)
    relations[..., -1] = np.eye(nodes)
    x, targets = RNG.normal(size=(nodes, 5)), np.array([0, 2, 3])
    outputs, features = outputs_of(relations.transpose(2, 1, 0), x)
    params |= {"linear.weight": RNG.normal(size=(classes, classifier)), "linear.bias": RNG.normal(size=classes)}
    y, labels = features[targets] @ params["linear.weight"].T + params["linear.bias"], np.array([0, 1, 1])
    outputs |= {"y": y, "loss": -np.log(softmax(y))[np.arange(3), labels].mean()}
    inputs = {"A": relations.astype(np.float32), "X": x.astype(np.float32), "target_x": targets, "target": labels}
    meta = {"name": "made here", "source": f"a file.py {source}", "config": config}
    return ModuleCase(meta, {n: v.astype(np.float32) for n, v in params.items()}, inputs, outputs, {}, {})


@pytest.mark.parametrize("channels", [1, 3])
def test_a_sparse_network_that_removes_self_loops(channels):
    """The reference adds 0 times the identity in its convolution, and keeps the loops of meta-paths."""
    config = {"channels": channels, "layers": 2, "w_out": 4, "num_edge": 4, "w_in": 5, "remove_self_loops": True}
    params = {f"layers.{name}.weight": RNG.normal(size=(channels, 4)) for name in ("0.conv1", "0.conv2", "1.conv1")}
    params |= {"gcn.weight": RNG.normal(size=(5, 4)), "gcn.bias": RNG.normal(size=4)}

    def outputs_of(adjacency, x):
        first, second, third = (np.einsum("ce,enm->cnm", softmax(params[n]), adjacency) for n in list(params)[:3])
        out, features, graphs = {}, [], first
        for i, selection in enumerate((second, third)):
            products = graphs @ selection
            graphs = np.stack([row_normalised(product) for product in products])
            for c in range(channels):
                out |= {f"H.{i}.{c}": products[c], f"Hnorm.{i}.{c}": graphs[c]}
        for c in range(channels):
            convolved = row_normalised(graphs[c]) @ x @ params["gcn.weight"] + params["gcn.bias"]
            out[f"gcn.{c}"] = convolved
            features.append(np.maximum(convolved, 0))
        return out, np.concatenate(features, 1)

    check_graph_transformer(graph_case("GTN (2022 sparse version)", config, params, 4 * channels, outputs_of))


@pytest.mark.parametrize("aggregate", ["mean", "concat"])
def test_a_fast_network_with_a_non_local_graph(aggregate):
    """FastGTN appends, in each layer, a softmax over the K largest inner products of the nodes' features."""
    channels, layers, dim, nearest = 2, 2, 6, 3
    config = {"channels": channels, "layers": layers, "node_dim": dim, "fast_layers": 1, "num_edge": 4, "w_in": 5}
    config |= {"channel_agg": aggregate, "beta": 0.2, "non_local": True, "K": nearest}
    below = "fastGTNs.0"
    params = {f"{below}.layers.{i}.conv1.weight": RNG.normal(size=(channels, 5)) for i in range(layers)}
    params |= {f"{below}.Ws.{c}": RNG.normal(size=(5, dim)) for c in range(channels)}
    params |= {
        f"{below}.linear1.weight": RNG.normal(size=(dim, channels * dim)),
        f"{below}.linear1.bias": RNG.normal(size=dim),
    }
    for i in range(layers):
        for n, (width, given) in {0: (128, dim), 2: (64, 128)}.items():
            name = f"{below}.feat_trans_layers.{i}.{n}"
            params |= {f"{name}.weight": 0.3 * RNG.normal(size=(width, given)), f"{name}.bias": RNG.normal(size=width)}

    def outputs_of(adjacency, x):
        graphs = [row_normalised(graph + 1e-20 * np.eye(len(x))) for graph in adjacency[:-1]] + [adjacency[-1]]
        out = {f"Anorm.{e}": graph for e, graph in enumerate(graphs)}
        own = [x @ params[f"{below}.Ws.{c}"] for c in range(channels)]
        h = list(own)
        for i in range(layers):
            mlp = {
                key: params[f"{below}.feat_trans_layers.{i}.{key}"]
                for key in ("0.weight", "0.bias", "2.weight", "2.bias")
            }
            z = np.maximum(np.mean(h, 0) @ mlp["0.weight"].T + mlp["0.bias"], 0)
            z = np.maximum(z @ mlp["2.weight"].T + mlp["2.bias"], 0)
            similarity, similar = z @ z.T, np.zeros((len(x), len(x)))
            for node in range(len(x)):
                best = np.argsort(-similarity[node])[:nearest]
                similar[node, best] = softmax(similarity[node, best])
            chosen = softmax(params[f"{below}.layers.{i}.conv1.weight"])
            out[f"W.{i}"] = chosen
            h = [
                sum(w * graph for w, graph in zip(chosen[c], [*graphs, similar], strict=True)) @ h[c]
                for c in range(channels)
            ]
        parts = [np.maximum(0.2 * a + 0.8 * b, 0) for a, b in zip(own, h, strict=True)]
        joined = np.mean(parts, 0)
        if aggregate == "concat":
            joined = np.concatenate(parts, 1) @ params[f"{below}.linear1.weight"].T + params[f"{below}.linear1.bias"]
        out["H0"] = np.maximum(joined, 0)
        return out, out["H0"]

    check_graph_transformer(graph_case("FastGTNs", config, params, dim, outputs_of))


def tiny(**changes):
    case = ModuleCase(
        {"name": "tiny", "config": {"d": 3}}, {}, {"x": np.ones(3, np.float32)}, {"y": np.ones(3)}, {}, {}
    )
    return replace(case, **changes)


def double(_, inputs):
    return {"y": 2 * inputs["x"]}


def test_what_is_not_implemented_is_named():
    case = public("torch_encoder_layer_post")
    with pytest.raises(pytest.fail.Exception, match="activation = 'tanh' is not implemented"):
        test_transformer.check_encoder_layer(with_options(case, act="tanh"))
    with pytest.raises(pytest.fail.Exception, match="no option heads"):
        options(tiny(), "heads")
    with pytest.raises(pytest.fail.Exception, match=r"mode = 'train' is not implemented \(only eval\)"):
        implemented(tiny(meta={"name": "tiny", "mode": "train"}), mode=["eval"])


def test_a_comparison_that_fails_names_the_options_that_were_not_read():
    with pytest.raises(AssertionError) as error:
        compare(tiny(), double)
    assert error.value.__notes__ == ["options of tiny that the test does not read: dim"]
    compare(tiny(outputs={"y": np.full(3, 2.0)}), double)


def test_outputs_and_gradients_that_no_test_computes_are_named():
    known = {"y": np.full(3, 2.0)}
    with pytest.raises(pytest.fail.Exception, match="does not compute: z"):
        compare(tiny(outputs=known | {"z": np.ones(2)}), double)
    compare(tiny(outputs=known | {"z": np.ones(2)}), double, ignore=["z"])
    with pytest.raises(pytest.fail.Exception, match=r"not computed: \['z'\]"):
        compare(tiny(outputs=known, weights={"z": np.ones(3)}), double)


@pytest.mark.parametrize("wrong", [False, True])
def test_gradients_may_be_sums(wrong):
    """`gradsum_last` and `gradsum_rest` stand for a gradient too large for its file."""
    weights = np.arange(3, dtype=np.float32)
    gradients = {"last/in/x": np.float32(6.0 + wrong), "rest/in/x": 2 * weights}
    case = tiny(
        outputs={"y": np.full(3, 2.0), "grad_scalar": np.float32(6)}, weights={"y": weights}, gradients=gradients
    )
    if wrong:
        with pytest.raises(AssertionError, match="last/in/x"):
            compare(case, double)
    else:
        compare(case, double)
