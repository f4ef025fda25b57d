"""Weights that no training leaves behind, or that are of another network, are refused with the file's name."""

import pickle
import re
from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.convert.lstr_state import GTN, TINY, lstr_state
from tflane_jax.convert.lstr import load_lstr
from tflane_jax.convert.published import load_weights
from tflane_jax.errors import UserError
from tflane_jax.models.graph_encoders import GcnEncoderConfig, HanEncoderConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask

CONV, LINEAR, POINT = "layer2.0.conv1.weight", "class_embed.weight", "input_proj.weight"
NORM, VARIANCE, PACKED = (
    "transformer.decoder.norm.weight",
    "bn1.running_var",
    ("transformer.encoder.layers.0.self_attn.in_proj_weight"),
)
PACKED_BIAS, QUERIES = PACKED.replace("weight", "bias"), "query_embed.weight"
TENSORS = {
    "kernel": CONV,
    "linear": LINEAR,
    "1 x 1": POINT,
    "norm": NORM,
    "variance": VARIANCE,
    "mean": "bn1.running_mean",
    "packed": PACKED,
    "packed bias": PACKED_BIAS,
    "bias": "class_embed.bias",
    "embedding": QUERIES,
}


def _numbers(value):
    def change(state, name):
        state[name].flat[1] = value

    return change


def _type(kind):
    return lambda state, name: state.update({name: (state[name] * 10).astype(kind)})


def _axes(change):
    return lambda state, name: state.update({name: change(state[name])})


# By what happens to a tensor: the change, the message, and the tensors to which it does not happen.
CHANGES = {
    "NaN": (_numbers(np.nan), r"holds nan at \[.*\], 1 of \d+ numbers are not finite", ()),
    "infinity": (_numbers(np.inf), r"holds inf at \[.*\], 1 of \d+ numbers are not finite", ()),
    "minus infinity": (_numbers(-np.inf), r"holds -inf at", ()),
    "all NaN": (_axes(lambda t: t * np.nan), r"(\d+) of \1 numbers are not finite", ()),
    "beyond float32": (_axes(lambda t: t.astype(np.float64) * 1e200), "numbers are not finite", ()),
    "an enormous number": (_numbers(1e30), r"holds a number of size 1e\+30: no training leaves that", ()),
    "integers": (_type(np.int64), "holds int64, expected floating-point numbers", ()),
    "bytes": (_type(np.int8), "holds int8, expected floating-point numbers: weights that are quantised", ()),
    "truth values": (_type(bool), "holds bool, expected floating-point numbers", ()),
    "complex numbers": (_type(np.complex64), "holds complex64, expected floating-point numbers", ()),
    "an axis in front": (_axes(lambda t: t[None]), "expected . ax|does not fit the model", ()),
    "an axis behind": (_axes(lambda t: t[..., None]), "expected . ax|does not fit the model", ()),
    "two axes more": (_axes(lambda t: t[None, None]), "expected . ax|does not fit the model", ()),
    "flat": (
        _axes(np.ravel),
        "expected . ax|does not fit the model",
        ("norm", "variance", "mean", "packed bias", "bias"),
    ),
    "a row less": (_axes(lambda t: t[:-1]), "does not fit the model|multiple of 3|is absent", ()),
    "nothing": (_axes(lambda t: t[:0]), "does not fit the model", ()),
    "a number": (_axes(lambda t: np.float32(1.0)), "expected . ax|does not fit the model|no tensor", ()),
}
CASES = [
    (f"{change} {kind}", CHANGES[change][0], TENSORS[kind], CHANGES[change][1])
    for change in CHANGES
    for kind in TENSORS
    if kind not in CHANGES[change][2]
]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("weights") / "w.npz"


def write(path, state):
    np.savez(path, **state)
    return path


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0].replace(" ", "_"))
def test_broken_tensors_are_refused(case, path):
    _, change, name, message = case
    state = lstr_state()
    change(state, name)
    with pytest.raises(UserError) as error:
        load_lstr(write(path, state), TINY)
    said = str(error.value)
    assert said.startswith(str(path))
    assert re.search(message, said), said
    assert name in said or "does not fit the model" in said


@pytest.mark.parametrize(("name", "said"), [(CONV, "no training leaves such a kernel"), (VARIANCE, "saw no image")])
def test_tensors_of_zeros_are_refused(name, said, path):
    state = lstr_state()
    state[name] = np.zeros_like(state[name])
    with pytest.raises(UserError, match=f"{re.escape(str(path))}: {name} is 0 throughout: .*{said}"):
        load_lstr(write(path, state), TINY)


@pytest.mark.parametrize("prefix", ["module.", "model.", "module.module.", "model.module.", "_orig_mod."])
def test_what_is_around_the_network_is_no_part_of_its_names(prefix, path):
    plain = load_lstr(write(path, lstr_state()), TINY)
    wrapped = load_lstr(write(path, {prefix + name: tensor for name, tensor in lstr_state().items()}), TINY)
    jax.tree.map(np.testing.assert_array_equal, wrapped[0], plain[0])


PROJECTION = "transformer.encoder.layers.0.self_attn.out_proj.weight"
ATTENTION = {
    "packed": PACKED,
    "packed bias": PACKED_BIAS,
    "projection": PROJECTION,
    "projection bias": PROJECTION.replace("weight", "bias"),
}


@pytest.mark.parametrize("kind", ATTENTION)
@pytest.mark.parametrize("change", [*CHANGES, "one number", "lost"])
def test_broken_attention_is_refused_where_a_product_replaces_it(change, kind, path):
    state, name = lstr_state(), ATTENTION[kind]
    if change == "lost":
        del state[name]
    elif change == "one number":  # a bias that numpy would broadcast
        state[name] = state[name].reshape(-1)[:1]
    elif change == "flat" and kind.endswith("bias"):
        pytest.skip("a bias is flat")
    else:
        CHANGES[change][0](state, name)
    with pytest.raises(UserError) as error:
        load_lstr(write(path, state), replace(TINY, encoder=GcnEncoderConfig(1, hidden=12)))
    said = str(error.value)
    assert said.startswith(str(path))
    messages = name, "which are none of one attention", "value/bias is absent in the file"
    assert any(message in said for message in messages), said


# By what stands in place of a tensor: the value, and what it holds.
OTHERS = {
    "text": ("weights", "text"),
    "an array of text": (np.array(["1.5"]), "text"),
    "dates": (np.zeros(3, "datetime64[s]"), "dates"),
    "objects": (np.array([None]), "Python objects"),
    "a list": ([[1.0, 2.0]], "a value of type list"),
    "nothing": (None, "a value of type NoneType"),
}


@pytest.mark.parametrize("encoder", [TINY.encoder, GTN, GcnEncoderConfig(1, hidden=12)], ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("kind", OTHERS)
def test_what_is_no_tensor_is_named_where_one_should_be(kind, encoder, path):
    value, held = OTHERS[kind]
    others = {"epoch": 7, "note": "not a tensor's name", f"module.{PROJECTION}": value}
    state = {name: tensor for name, tensor in lstr_state().items() if name != PROJECTION} | others
    files = [path.with_suffix(".pkl")]
    files[0].write_bytes(pickle.dumps(state))
    if isinstance(value, np.ndarray):
        files.append(write(path, state))
    for file in files:
        with pytest.raises(UserError, match=rf"^{re.escape(str(file))}: module.{re.escape(PROJECTION)} holds {held}, "):
            load_lstr(file, replace(TINY, encoder=encoder))


DAMAGE = {
    "negative variance": (
        lambda s: s[VARIANCE].__setitem__(2, -0.1),
        r"bn1.running_var holds -0.1 at \[2\]: a variance",
    ),
    "a large 1 x 1 kernel": (
        lambda s: s.update({POINT: np.ones((8, 6, 3, 3), np.float32)}),
        "input_proj.weight has shape 8x6x3x3, expected a kernel of 1 x 1 pixels",
    ),
    "a transposed layer": (lambda s: s.update({LINEAR: s[LINEAR].T}), "heads/class/kernel is 2x8 in the file and 8x2"),
    "a tensor twice": (
        lambda s: s.update({f"module.{LINEAR}": s[LINEAR]}),
        "module.class_embed.weight and class_embed.weight are the same tensor",
    ),
    "a tensor lost": (lambda s: s.pop(LINEAR), "heads/class/kernel is absent in the file and 8x2 in the model"),
    "a tensor more": (lambda s: s.update({"fc.weight": s[LINEAR]}), "fc.weight is no tensor of LSTR: is this the"),
    "a name that is no name": (
        lambda s: s.update({"a" * 5000 + "\n": s[LINEAR]}),
        "a{200} is no tensor of LSTR: is this",
    ),
    "a layer more": (
        lambda s: s.update({k.replace("layers.0", "layers.1"): v for k, v in s.items() if "encoder" in k}),
        "encoder/layer_1/.* in the file and absent in the model",
    ),
    "nothing": (lambda s: s.clear(), "none of PyTorch.s"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_broken_files_are_refused(name, path):
    change, message = DAMAGE[name]
    state = lstr_state()
    change(state)
    with pytest.raises(UserError) as error:
        load_lstr(write(path, state), TINY)
    assert str(error.value).startswith(str(path))
    assert re.search(message, str(error.value)), error.value


@pytest.mark.parametrize(
    "change", [lambda p: p.unlink(), lambda p: p.write_bytes(b""), lambda p: p.write_bytes(b"PK\3\4")]
)
def test_files_that_cannot_be_read_are_named(change, path):
    change(write(path, lstr_state()))
    with pytest.raises(UserError, match=re.escape(str(path))):
        load_lstr(path, TINY)


def test_doubles_become_floats_and_counters_may_hold_anything(path):
    state = lstr_state()
    params, _ = load_lstr(write(path, state), TINY)
    doubles = {name: tensor.astype(np.float64) for name, tensor in state.items()}
    doubles["layer1.0.bn1.num_batches_tracked"] = np.array(np.nan)
    doubles["n_averaged"] = np.array(7)  # of torch.optim.swa_utils
    doubles["ema_conv1_weight"] = state["conv1.weight"] + 1.0  # of MMCV's EMAHook
    again, _ = load_lstr(write(path, doubles), TINY)
    jax.tree.map(np.testing.assert_array_equal, params, again)
    assert {leaf.dtype for leaf in jax.tree.leaves(again)} == {np.dtype(np.float32)}


def test_an_auxiliary_head_is_not_missed(path):
    """The head of the cells is trained by us alone: no file has it, and predictions do not need it."""
    model = replace(TINY, cells=True)
    params, table = load_lstr(write(path, lstr_state()), model)
    assert "cell_head" not in params
    fresh, told = load_lstr(path, model, "fresh")
    assert fresh["cell_head"]["kernel"].shape == (8, 1)
    rows = [row["becomes"] for row in table if row["tensor"] == "-"]
    assert rows[1] == "cell_head/kernel is left out: an auxiliary head that the file does not have"
    assert [row["becomes"].partition(":")[0] for row in told[-2:]] == [
        "cell_head/bias starts afresh",
        "cell_head/kernel starts afresh",
    ]
    jax.tree.map(np.testing.assert_array_equal, params, {k: v for k, v in fresh.items() if k != "cell_head"})


@pytest.mark.parametrize(
    ("encoder", "message"),
    [
        (replace(GTN, heads=1, head_dim=8), "heads 1 of 8 channels: LSTR has 2 of 4"),
        (replace(GTN, head_dim=3), "heads 2 of 3 channels: LSTR has 2 of 4"),
        (replace(GTN, similarity=None), "no similarity, which LSTR's attention becomes"),
        (replace(GTN, relations=("up", "down")), "no edge type self"),
    ],
)
def test_encoders_without_a_place_for_the_weights_are_named(encoder, message, path):
    with pytest.raises(UserError, match=rf"w.npz: .*{message}"):
        load_lstr(write(path, lstr_state()), replace(TINY, encoder=encoder))


@pytest.mark.parametrize("setting", [{"anchors": (0.35, 1.0)}, {"located": True}])
def test_networks_in_which_the_weights_mean_something_else_are_named(setting, path):
    (name,) = setting
    with pytest.raises(UserError, match=rf"w.npz: .*mean something else where task.model.{name} is"):
        load_lstr(write(path, lstr_state()), replace(TINY, **setting))


def test_edge_weights_are_checked(path):
    write(path, lstr_state())
    for weight in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(UserError, match=r"w.npz: .*must be above 0 and at most 1"):
            load_lstr(path, replace(TINY, encoder=GTN), edge_weight=weight)
    with pytest.raises(UserError, match=r"w.npz: .*selects no edge types"):
        load_weights(path, LaneShapeTask(TINY), edge_weight=0.5)
    with pytest.raises(UserError, match=r"w.npz: an edge weight applies to GTN encoders only"):
        load_weights(path, LaneGraphTask(TopoNetConfig()), edge_weight=0.5)
    with pytest.raises(UserError, match=r"w.npz: published weights are those of models with cameras"):
        load_weights(path, LaneGraphTask(TopoNetConfig()))


def test_a_han_is_written_by_convert_alone(path):
    model = replace(TINY, encoder=HanEncoderConfig(layers=1, hidden=12))
    with pytest.raises(UserError, match=r"w.npz is of a transformer, .* write a run by tflane convert"):
        load_lstr(write(path, lstr_state()), model)


def test_a_gcn_gets_the_product_of_value_and_output_projections(path):
    state = lstr_state()
    model = replace(TINY, encoder=GcnEncoderConfig(layers=1, hidden=12))
    params, table = load_lstr(write(path, state), model)
    value = params["encoder"]["layer_0"]["graph"]["value"]
    attention = "transformer.encoder.layers.0.self_attn."
    x = np.random.default_rng(1).normal(size=8).astype(np.float32)
    inner = state[PACKED][16:] @ x + state[PACKED_BIAS][16:]
    expected = state[attention + "out_proj.weight"] @ inner + state[attention + "out_proj.bias"]
    np.testing.assert_allclose(x @ value["kernel"] + value["bias"], expected, rtol=1e-5, atol=1e-6)
    packed = next(row for row in table if row["tensor"] == PACKED)
    assert "its product with the output projection is the graph's value projection" in packed["becomes"]
    state.pop(attention + "out_proj.bias")
    with pytest.raises(UserError, match=r"w.npz: .*out_proj.bias is missing"):
        load_lstr(write(path, state), model)
