"""Transformer layers against PyTorch's numbers, and what padding and dropout do to them."""

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
from tflane_jax.convert.lstr import decoder_layer_params, encoder_layer_params
from tflane_jax.layers.masks import key_mask
from tflane_jax.layers.transformer import DecoderLayer, EncoderLayer, TransformerConfig


def layer_config(case):
    config = case.meta["config"]
    return TransformerConfig(config["heads"], config["ff"], dropout=0.0, norm_first=config["norm_first"])


def compare(case, apply):
    """Compare `apply`(torch parameters, inputs) -> output over the batch, and its gradients, with the reference."""

    def scalar(torch_params, arrays):
        out = apply(torch_params, arrays)
        return (out * case.weights["output"]).sum(), out

    floats = {name: value for name, value in case.inputs.items() if value.dtype == np.float32}
    others = {name: value for name, value in case.inputs.items() if name not in floats}
    step = jax.jit(jax.value_and_grad(lambda p, x: scalar(p, x | others), argnums=(0, 1), has_aux=True))
    (_, out), (by_param, by_input) = step(case.params, floats)
    assert_outputs_close({"output": out}, {"output": case.outputs["output"]})
    assert_gradients_close(named_gradients(by_param, by_input), case.gradients)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("torch_encoder_layer*"), ids=case_id)
def test_encoder_layer_matches_pytorch(path):
    case = load_module_case(path)
    layer = EncoderLayer(layer_config(case))

    def apply(torch_params, arrays):
        variables = {"params": encoder_layer_params(torch_params)}
        position = jnp.zeros(arrays["src"].shape[1:])
        one = lambda x, padded: layer.apply(variables, x, position, key_mask(~padded))  # noqa: E731
        return jax.vmap(one)(arrays["src"], arrays["kpm"])

    compare(case, apply)


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("torch_decoder_layer*"), ids=case_id)
def test_decoder_layer_matches_pytorch(path):
    case = load_module_case(path)
    layer = DecoderLayer(layer_config(case))

    def apply(torch_params, arrays):
        variables = {"params": decoder_layer_params(torch_params)}

        def one(x, memory, padded):
            at_queries, at_memory = jnp.zeros_like(x), jnp.zeros_like(memory)
            mask = ~arrays["tgt_mask"]
            return layer.apply(variables, x, memory, at_queries, at_memory, mask, key_mask(~padded))

        return jax.vmap(one)(arrays["tgt"], arrays["memory"], arrays["mkp"])

    compare(case, apply)
