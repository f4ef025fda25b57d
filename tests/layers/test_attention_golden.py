"""Multi-head attention against the numbers of `torch.nn.MultiheadAttention`."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import batch_leading, case_id, golden_modules, implemented, load_module_case, options
from tests.golden_compare import assert_outputs_close, compare
from tflane_jax.layers.attention import MultiHeadAttention, attention_probabilities, masked_attention

NAMES = ("query", "key", "value")


def our_parameters(torch):
    """Return our parameters; `bias=False` is a bias of 0, and `kdim`, `vdim` split `in_proj_weight` in three."""
    dim = torch["out_proj.weight"].shape[0]
    if "in_proj_weight" in torch:
        weights = jnp.split(torch["in_proj_weight"], 3)
    else:
        weights = [torch[f"{name[0]}_proj_weight"] for name in NAMES]
    biases = jnp.split(torch.get("in_proj_bias", np.zeros(3 * dim, np.float32)), 3)
    params = {name: {"kernel": w.T, "bias": b} for name, w, b in zip(NAMES, weights, biases, strict=True)}
    bias = torch.get("out_proj.bias", np.zeros(dim, np.float32))
    return params | {"output": {"kernel": torch["out_proj.weight"].T, "bias": bias}}


def allowed_and_bias(inputs, batch, heads, queries, keys):
    """Return torch's masks as which pairs are allowed, and what is added to the logits, each (B, H, Q, K).

    In torch true blocks, floats are added (-inf blocks), and a mask of three axes has one matrix per batch and head.
    """
    allowed, bias = np.ones((batch, heads, queries, keys), bool), np.zeros((batch, heads, queries, keys), np.float32)
    masks = []
    if (mask := inputs.get("attn_mask")) is not None:
        masks.append(mask.reshape(batch, heads, queries, keys) if mask.ndim == 3 else mask)
    if (mask := inputs.get("key_padding_mask")) is not None:
        masks.append(mask.reshape(batch, 1, 1, keys))
    for mask in masks:
        blocked = np.isneginf(mask) if mask.dtype.kind == "f" else mask.astype(bool)
        allowed = allowed & ~blocked
        if mask.dtype.kind == "f":
            bias = bias + np.where(blocked, 0.0, mask).astype(np.float32)
    return allowed, bias


def biased_attention(params, arrays, allowed, bias):
    """Run our function under an additive mask, which it takes as further channels: q' = bias, k' = one-hot."""
    heads, keys = bias.shape[1], bias.shape[-1]
    dim = params["output"]["kernel"].shape[0] // heads

    def project(name):
        x = arrays[name] @ params[name]["kernel"] + params[name]["bias"][None, None]
        return x.reshape(*x.shape[:2], heads, dim).swapaxes(1, 2)

    allowed, channels = jnp.asarray(allowed), dim + keys
    query = jnp.concatenate([project("query") * math.sqrt(channels / dim), bias * math.sqrt(channels)], -1)
    key = project("key")
    key = jnp.concatenate([key, jnp.broadcast_to(jnp.eye(keys), (*key.shape[:3], keys))], -1)
    out = jax.vmap(masked_attention)(query, key, project("value"), allowed).swapaxes(1, 2)
    out = out.reshape(*out.shape[:2], -1) @ params["output"]["kernel"] + params["output"]["bias"][None, None]
    return out, jax.vmap(attention_probabilities)(query, key, allowed)


def module_attention(params, arrays, allowed):
    """Run our module over the batch."""
    module = MultiHeadAttention(params["output"]["kernel"].shape[0], allowed.shape[1])

    def one(query, key, value, mask):
        out, state = module.apply({"params": params}, query, key, value, mask, mutable="intermediates")
        return out, state["intermediates"]["probabilities"][0]

    return jax.vmap(one)(*(arrays[name] for name in NAMES), jnp.asarray(allowed))


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("mha_*"), ids=case_id)
def test_module_matches_torch(path):
    check(load_module_case(path))


def check(case):
    heads = options(case, "heads").heads
    implemented(case, add_bias_kv=[False], add_zero_attn=[False])
    shapes = [batch_leading(case, case.inputs[name]).shape for name in NAMES]
    (batch, queries), keys = shapes[0][:2], shapes[1][1]
    allowed, bias = allowed_and_bias(case.inputs, batch, heads, queries, keys)

    def outputs(torch, inputs):
        params = our_parameters(torch)
        arrays = {name: batch_leading(case, inputs[name]) for name in NAMES}
        if bias.any():
            out, weights = biased_attention(params, arrays, allowed, bias)
        else:
            out, weights = module_attention(params, arrays, allowed)
        out = batch_leading(case, out)
        return {"output": out, "weights_per_head": weights, "weights_avg": weights.mean(1), "output_noweights": out}

    # An encoder layer that the file with fully masked rows has beside the attention.
    torch = {name: value for name, value in case.params.items() if not name.startswith("enc.")}
    beside = {"enc_fast", "enc_slow"}
    if allowed.any(-1).all():
        compare(case, outputs, params=torch, ignore=beside)
        return
    # A head without keys: in torch its weights are NaN, and with them the whole output, or, where no weights are
    # wanted, 0 before the output's projection. Ours is 0, behind the projection where no head has keys.
    assert not case.gradients
    actual = jax.jit(outputs)(torch, case.inputs)
    blind = ~allowed.any(-1)
    nothing = batch_leading(case, np.broadcast_to(blind.all(1)[..., None], batch_leading(case, actual["output"]).shape))
    for name in actual.keys() & case.outputs.keys():
        got, expected = np.asarray(actual[name]), case.outputs[name]
        if name == "output_noweights":
            got = np.where(nothing, expected, got)
        elif name == "output":
            assert not got[nothing].any()
        else:
            assert not got[blind if name == "weights_per_head" else blind.all(1)].any()
        got = np.where(np.isnan(expected), 0.0, got)
        assert_outputs_close({name: got}, {name: np.nan_to_num(expected, nan=0.0)})
    assert case.outputs.keys() - beside - {"grad_scalar"} <= actual.keys()
