"""LSTR's encoder as a GTN: the same function of the same weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.convert.lstr_state import DIM, GTN, TINY, lstr_state
from tflane_jax.convert.lstr import convert_lstr
from tflane_jax.convert.lstr_graphs import selections


@pytest.mark.parametrize("similarity", ["last_hop", "every_hop"])
@pytest.mark.parametrize("weight", [1.0, 0.98, 0.5])
def test_the_selected_edge_types_have_the_weight(similarity, weight):
    import dataclasses

    encoder = dataclasses.replace(GTN, similarity=similarity, hops=3)
    scores = jnp.asarray(selections(encoder, weight))
    offered = jnp.array([[encoder.offers_similarity(hop) or e < 7 for e in range(8)] for hop in range(3)])
    fractions = np.asarray(jax.nn.softmax(jnp.where(offered[:, None], scores, -jnp.inf), -1))
    for hop, chosen in ((0, 0), (1, 0), (2, 7)):
        np.testing.assert_allclose(fractions[hop, :, chosen], weight, rtol=1e-6)
        others = np.delete(fractions[hop, 0], chosen)
        np.testing.assert_allclose(others[others > 0], others.max(), rtol=1e-5)


def test_a_warm_started_gtn_is_the_transformer():
    state, rng = lstr_state(), np.random.default_rng(3)
    features, position = (jnp.asarray(rng.normal(size=(3, 4, DIM)), jnp.float32) for _ in range(2))
    valid = jnp.asarray(rng.random((3, 4)) < 0.8)
    outputs = []
    for encoder in (TINY.encoder, GTN):
        params = convert_lstr(state, encoder).variables["params"]["encoder"]
        module = encoder.build("encoder")
        outputs.append(np.asarray(module.apply({"params": params}, features, position, valid))[np.asarray(valid)])
    np.testing.assert_allclose(outputs[0], outputs[1], rtol=1e-5, atol=1e-5)
    soft = convert_lstr(state, GTN, 0.5).variables["params"]["encoder"]
    changed = GTN.build("encoder").apply({"params": soft}, features, position, valid)
    assert np.abs(np.asarray(changed)[np.asarray(valid)] - outputs[0]).max() > 0.01
