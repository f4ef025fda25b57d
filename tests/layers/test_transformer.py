"""Transformer layers against PyTorch's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

from tests.converted import converted_params
from tests.golden import batch_leading, case_id, golden_modules, implemented, load_module_case, options
from tests.golden_compare import compare
from tests.parameters import random_params
from tests.shared import random_array
from tflane_jax.convert.lstr import DECODER_LAYER, ENCODER_LAYER
from tflane_jax.layers.transformer import DecoderLayer, EncoderLayer, FeedForward, TransformerConfig

# The fixtures' names of PyTorch's masks.
SELF_MASK = {"torch_encoder_layer": ("src_mask", "attn_mask", "mask"), "torch_decoder_layer": ("tgt_mask",)}
SELF_PADDING = {
    "torch_encoder_layer": ("kpm", "src_key_padding_mask", "key_padding_mask"),
    "torch_decoder_layer": ("tkp", "tkpm", "tgt_key_padding_mask"),
}
MEMORY_MASK, MEMORY_PADDING = ("memory_mask", "mm"), ("mkp", "mkpm", "memory_key_padding_mask")


def layer_config(case):
    found = options(case, "heads", activation="relu", norm_first=False)
    implemented(case, activation=["relu", "gelu"], layer_norm_eps=[1e-5], bias=[True])
    (hidden,) = case.params["linear1.bias"].shape
    return TransformerConfig(found.heads, hidden, 0.0, norm_first=found.norm_first, activation=found.activation)


def allowed(case, mask_names, padding_names, batch, queries, keys, heads):
    """Return which query may attend to which key, (B, H, Q, K), from torch's masks: true or -inf blocks."""
    pairs = np.ones((batch, heads, queries, keys), bool)
    for name in (*mask_names, *padding_names):
        if name not in case.inputs:
            continue
        mask = case.inputs[name]
        if mask.dtype.kind == "f":
            if not np.isin(mask, (0.0, -np.inf)).all():
                pytest.fail(f"{case.meta['name']}: {name} adds numbers to the logits, which our layers do not")
            mask = np.isneginf(mask)
        if name in padding_names:
            mask = mask.reshape(batch, 1, 1, keys)
        elif mask.ndim == 3:
            mask = mask.reshape(batch, heads, queries, keys)
        pairs = pairs & ~mask.astype(bool)
    return jnp.asarray(pairs)


def known_inputs(case, names):
    if unknown := sorted(case.inputs.keys() - set(names)):
        pytest.fail(f"{case.meta['name']}: inputs that the test does not read: {', '.join(unknown)}")


def check_encoder_layer(case):
    config, kind = layer_config(case), "torch_encoder_layer"
    known_inputs(case, ("src", *SELF_MASK[kind], *SELF_PADDING[kind]))
    batch, length = batch_leading(case, case.inputs["src"]).shape[:2]
    pairs = allowed(case, SELF_MASK[kind], SELF_PADDING[kind], batch, length, length, config.heads)

    def outputs(torch_params, inputs):
        variables = {"params": converted_params(torch_params, ENCODER_LAYER)}
        one = lambda x, mask: EncoderLayer(config).apply(variables, x, jnp.zeros_like(x), mask)  # noqa: E731
        return {"output": batch_leading(case, jax.vmap(one)(batch_leading(case, inputs["src"]), pairs))}

    compare(case, outputs)


def check_decoder_layer(case):
    config, kind = layer_config(case), "torch_decoder_layer"
    known_inputs(case, ("tgt", "memory", *SELF_MASK[kind], *SELF_PADDING[kind], *MEMORY_MASK, *MEMORY_PADDING))
    (batch, queries), keys = (batch_leading(case, case.inputs["tgt"]).shape[:2], case.inputs["memory"])
    keys = batch_leading(case, keys).shape[1]
    among = allowed(case, SELF_MASK[kind], SELF_PADDING[kind], batch, queries, queries, config.heads)
    across = allowed(case, MEMORY_MASK, MEMORY_PADDING, batch, queries, keys, config.heads)

    def outputs(torch_params, inputs):
        variables = {"params": converted_params(torch_params, DECODER_LAYER)}

        def one(x, memory, mask, memory_mask):
            positions = jnp.zeros_like(x), jnp.zeros_like(memory)
            return DecoderLayer(config).apply(variables, x, memory, *positions, mask, memory_mask)

        arrays = (batch_leading(case, inputs[name]) for name in ("tgt", "memory"))
        return {"output": batch_leading(case, jax.vmap(one)(*arrays, among, across))}

    compare(case, outputs)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("torch_encoder_layer*"), ids=case_id)
def test_encoder_layer_matches_pytorch(path):
    check_encoder_layer(load_module_case(path))


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("torch_decoder_layer*"), ids=case_id)
def test_decoder_layer_matches_pytorch(path):
    check_decoder_layer(load_module_case(path))


def test_positions_are_in_queries_and_keys_but_not_in_values():
    """A token alone attends to itself whatever its position is, so that only a value could show it."""
    config = TransformerConfig(2, 8, 0.0)
    x, memory, there, elsewhere = (random_array(seed, 2, 4) for seed in range(4))
    encoder, decoder = EncoderLayer(config), DecoderLayer(config)
    of_encoder, of_decoder = random_params(encoder.init, x, there), random_params(decoder.init, x, memory, there, there)
    for count, same in ((1, True), (2, False)):
        few, tokens, here, away = (leaf[:count] for leaf in (x, memory, there, elsewhere))
        encoded = [encoder.apply(of_encoder, few, place) for place in (here, away)]
        assert np.allclose(*encoded, atol=1e-6) is same
        places = (here, here), (away, away)
        assert np.allclose(*(decoder.apply(of_decoder, few, tokens, *both) for both in places), atol=1e-6) is same


def test_gelu_is_the_exact_one():
    """As PyTorch's by default; its approximation by tanh differs by up to 5e-4."""
    x = jnp.linspace(-4.0, 4.0, 80).reshape(20, 4)
    layer = {"kernel": jnp.eye(4), "bias": jnp.zeros(4)}
    block = FeedForward(TransformerConfig(1, 4, 0.0, activation="gelu"))
    found = block.apply({"params": {"expand": layer, "contract": layer}}, x, deterministic=True)
    np.testing.assert_allclose(found, x * 0.5 * (1.0 + erf(np.asarray(x) / np.sqrt(2.0))), atol=2e-6)
