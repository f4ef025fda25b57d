"""LSTR's initial values: bounds and spread of every kind of parameter."""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from tests.convert.lstr_state import GTN, TINY
from tflane_jax.models.graph_encoders import GcnEncoderConfig
from tflane_jax.models.lstr_init import lstr_init
from tflane_jax.models.parameters import joined_statistics


def initial(encoder, seed=0):
    """Return marked parameters of a network after `lstr_init`, by path: those that it leaves alone are 7."""
    image = jax.ShapeDtypeStruct((64, 64, 3), np.float32), jax.ShapeDtypeStruct((64, 64), np.bool_)
    shapes = jax.eval_shape(replace(TINY, encoder=encoder).build().init, jax.random.key(0), *image)
    marked = jax.tree.map(lambda leaf: np.full(leaf.shape, 7.0, np.float32), joined_statistics(shapes))
    return flatten_dict(lstr_init(marked, jax.random.key(seed)), sep="/")


@pytest.mark.parametrize("encoder", [TINY.encoder, GTN, GcnEncoderConfig(1, 12)], ids=["transformer", "gtn", "gcn"])
def test_matrices_and_biases_have_lstrs_bounds(encoder):
    found = initial(encoder)
    inner = "encoder/layer_0/" + ("self_attention" if encoder is TINY.encoder else "graph")
    expand = "encoder/layer_0/" + ("feed_forward/expand" if encoder is TINY.encoder else "expand")
    bounds = {
        f"{inner}/value/kernel": math.sqrt(6 / (8 + 24)),
        f"{inner}/value/bias": 0.0,
        f"{expand}/kernel": math.sqrt(6 / (8 + 12)),
        f"{expand}/bias": 1 / math.sqrt(8),
        "decoder_0/cross_attention/output/kernel": math.sqrt(6 / 16),
        "decoder_0/cross_attention/output/bias": 0.0,
        "decoder_0/cross_attention/query/kernel": math.sqrt(6 / 32),
        "heads/specific/linear_0/kernel": 1 / math.sqrt(8),
        "heads/class/bias": 1 / math.sqrt(8),
        "input_projection/kernel": 1 / math.sqrt(6),
    }
    for name, bound in bounds.items():
        values = np.abs(np.asarray(found[name]))
        assert values.max() <= bound + 1e-6, name
        assert values.max() >= 0.6 * bound, name
    kept = {name for name, value in found.items() if (np.asarray(value) == 7.0).all()}
    norms = {"decoder_norm/scale", "decoder_norm/bias", "backbone/conv1/kernel", "queries"}
    assert norms <= kept
    assert ("encoder/layer_0/graph/selection" in kept) == (encoder is GTN)
    assert not any(name.startswith(("heads/", "input_projection/")) for name in kept)


def test_values_depend_on_the_key_and_the_name():
    first, again, other = initial(GTN), initial(GTN), initial(GTN, 1)
    name = "decoder_0/self_attention/{}/kernel"
    np.testing.assert_array_equal(first[name.format("query")], again[name.format("query")])
    assert (first[name.format("query")] != other[name.format("query")]).all()
    assert (first[name.format("query")] != first[name.format("key")]).all()
