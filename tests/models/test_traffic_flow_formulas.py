"""What the traffic-flow module computes, against the formulas in numpy."""

import dataclasses
from functools import partial

import numpy as np
import pytest

from tests.models.test_traffic_flow_module import BEV, CONFIG, DIM, LANES, apply, spatial, tokens
from tests.parameters import random_params
from tflane_jax.models.traffic_flow_module import ALL_FUSIONS, LANE_FUSIONS, TemporalEncoder

assert_close = partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4)


def dense(params, x):
    return x @ np.asarray(params["kernel"]) + np.asarray(params.get("bias", np.zeros(1)))


def normalised(params, x):
    centered = x - x.mean(-1, keepdims=True)
    scale, bias = np.asarray(params["scale"]), np.asarray(params["bias"])
    return centered / np.sqrt(x.var(-1, keepdims=True) + 1e-6) * scale + bias


def feed_forward(params, x):
    return dense(params["linear_1"], np.maximum(dense(params["linear_0"], x), 0.0))


def attended(params, query, key, value, allowed):
    """Return multi-head attention over the allowed keys (bool, broadcastable); 0 for a query without any."""
    allowed = np.broadcast_to(allowed, (len(query), len(key)))
    heads = []
    for name, x in (("query", query), ("key", key), ("value", value)):
        heads.append(np.split(dense(params[name], x), CONFIG.heads, -1))
    found = []
    for q, k, v in zip(*heads, strict=True):
        weight = np.exp(q @ k.T / np.sqrt(q.shape[-1])) * allowed
        found.append(weight / np.maximum(weight.sum(-1, keepdims=True), 1e-30) @ v)
    return np.where(allowed.any(-1, keepdims=True), dense(params["output"], np.concatenate(found, -1)), 0.0)


@pytest.mark.parametrize("depth", [1, 2])
def test_a_token_is_computed_from_all_that_is_known_of_its_track(depth):
    """Each frame with category, size and age, pre-norm layers over the valid frames, their mean, and the two ends."""
    track = tokens(2)
    module = TemporalEncoder(dataclasses.replace(CONFIG, depth=depth), DIM, BEV)
    variables = random_params(module.init, track)
    params = variables["params"]
    given = {field.name: np.asarray(getattr(track, field.name)) for field in dataclasses.fields(track)}
    assert len(set(given["category"][given["valid"]])) > 1
    unit = (given["position"].astype(float) - BEV.low()) / BEV.size()
    angle = 2.0 * np.pi * unit[..., :2, None] / [2.0, 1.0, 0.5]
    waves = angle.reshape(*angle.shape[:2], -1)
    places = np.concatenate([np.sin(waves), np.cos(waves), unit, given["heading"]], -1)
    found = apply(module, variables, track)
    for k in np.flatnonzero(given["valid"]):
        there = given["frame_valid"][k]
        x = dense(params["frame"], places[k]) + np.asarray(params["age"])
        x += np.asarray(params["category"]["embedding"])[given["category"][k]] + dense(params["size"], given["size"][k])
        for layer in (params[f"layer_{i}"] for i in range(depth)):
            y = normalised(layer["attention_norm"], x)
            x += attended(layer["attention"], y, y, y, there)
            x += feed_forward(layer["mlp"], normalised(layer["mlp_norm"], x))
        mean = normalised(params["norm"], x)[there].mean(0)
        first, last = np.flatnonzero(there)[[0, -1]]
        expected = feed_forward(params["token"], np.concatenate([mean, places[k][first], places[k][last]]))
        assert_close(found[k], expected)


@pytest.mark.parametrize("fusions", [ALL_FUSIONS, LANE_FUSIONS])
@pytest.mark.parametrize("residual", ["fusion", "none"])
def test_lanes_and_traffic_are_fused_by_eq_2_and_3(fusions, residual):
    """T->T, T->L, L->T, L->L in this order; positions enter the lanes' queries and keys, but not their values."""
    module, variables, arguments = spatial(dataclasses.replace(CONFIG, fusions=fusions, residual=residual, depth=0))
    params = variables["params"]
    lanes, position, traffic = (np.asarray(each, float) for each in arguments[:3])
    valid = np.asarray(arguments[3].valid)

    def fused(name, x, query, key, value, allowed):
        """Eq. (2)."""
        if name not in fusions:
            return x
        label = name.replace("->", "_to_")
        found = attended(params[label], query, key, value, allowed)
        if residual == "fusion":
            return normalised(params[f"{label}_norm"], x + found)
        readers = np.broadcast_to(allowed, (len(x), len(key))).any(-1, keepdims=True)
        return np.where(readers, normalised(params[f"{label}_norm"], found), x)

    t = np.where(valid[:, None], traffic, 0.0)
    t = fused("T->T", t, t, t, t, valid[:, None] & valid)
    t = fused("T->L", t, t, lanes + position, lanes, valid[:, None])
    x = fused("L->T", lanes, lanes + position, t, t, valid)
    x = fused("L->L", x, x + position, x + position, x, np.ones((LANES, LANES), bool))
    expected = normalised(params["transform_norm"], x + feed_forward(params["transform"], x))  # Eq. (3)
    assert_close(apply(module, variables, *arguments), expected)
