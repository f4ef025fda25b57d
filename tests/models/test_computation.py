"""Half precision and recomputed activations in the marker fusion, the SD map's encoder and the lane-shape networks."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.layers.test_precision import halves, steps
from tests.models.images import HEIGHT, WIDTH, tiny_model
from tests.models.test_graph_encoders import GTN
from tests.models.test_marker_fusion import CONFIG, LINES
from tests.parameters import random_params
from tests.slow import with_slow
from tflane_jax.geometry import BevGrid
from tflane_jax.models.graph_encoders import GcnEncoderConfig, HanEncoderConfig
from tflane_jax.models.marker_fusion import MarkerEncoder, MarkerFusion
from tflane_jax.models.sd_map_encoder import SdMapEncoder, SdMapFusion, SdMapModuleConfig
from tflane_jax.priors.marker_memory import MarkerGuidance
from tflane_jax.scene import SdMap

RNG = np.random.default_rng(3)
BEV, POSITION, TOKENS = (RNG.normal(size=(n, 8)).astype(np.float32) for n in (6, 6, 3))
LANES = MarkerGuidance(
    points=RNG.uniform(-20, 20, (3, 4, 2)).astype(np.float32),
    successor=np.eye(3, k=1, dtype=bool),
    weight=np.array([1.0, 0.5, 0.5], np.float32),
    confidence=np.array([0.5, 0.25, 0.0], np.float32),
    valid=np.array([True, True, False]),
    gate=np.float32(0.5),
)
MAP = SdMap.empty(3, 4)
MAP.points[:2], MAP.valid[:2] = RNG.uniform(-20, 20, (2, 4, 2)), True
SD_MAP = SdMapModuleConfig(lines=replace(LINES, attend="lines"), heads=2)
RANGE, MASK, VALID = BevGrid().range, np.ones((6, 3), bool), np.array([True, True, False])
NETWORKS = {"gtn": GTN, "gcn": GcnEncoderConfig(hidden=16), "han": HanEncoderConfig(hidden=16, semantic=8)}
IMAGE, SHOWN = RNG.normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32), np.ones((HEIGHT, WIDTH), bool)

# Module of the settings, what it reads, and how many parts are recomputed.
PARTS = {
    "marker tokens": (lambda **s: MarkerEncoder(replace(CONFIG, connectivity=True, **s), RANGE), (LANES,), 1),
    "markers, MLP": (lambda **s: MarkerEncoder(replace(CONFIG, encoding="mlp", **s), RANGE), (LANES,), 0),
    "marker fusion": (lambda **s: MarkerFusion(replace(CONFIG, **s)), (BEV, POSITION, TOKENS, MASK, LANES.gate), 1),
    "map tokens": (lambda **s: SdMapEncoder(replace(SD_MAP, **s), RANGE), (MAP,), 1),
    "map fusion": (lambda **s: SdMapFusion(replace(SD_MAP, **s)), (BEV, POSITION, TOKENS, VALID), 1),
    "empty map, as published": (
        lambda **s: SdMapFusion(replace(SD_MAP, absent="reference", **s)),
        (BEV, POSITION, TOKENS, VALID & False),
        1,
    ),
    "lstr": (lambda **s: tiny_model(**s).build(), (IMAGE, SHOWN), 5),
} | {name: (lambda e=e, **s: tiny_model(e, **s).build(), (IMAGE, SHOWN), 6) for name, e in NETWORKS.items()}


def part(name):
    make, inputs, parts = PARTS[name]
    return make, jax.tree.map(jnp.asarray, inputs), parts


def outputs(name, variables=None, **settings):
    """Return a function of the variables of a part, and these."""
    make, inputs, _ = part(name)
    if variables is None:
        variables = random_params(lambda key, x: make().init(key, *x), inputs, spread=0.3)
    return lambda variables: make(**settings).apply(variables, *inputs), variables


def program(name, **settings):
    """Return the steps of the gradient of a part's outputs, and their dtypes."""
    make, inputs, _ = part(name)
    shapes = jax.eval_shape(lambda key: make(**settings).init(key, *inputs), jax.random.key(0))
    assert {leaf.dtype.name for leaf in jax.tree.leaves(shapes)} == {"float32"}
    assert jax.tree.map(jnp.shape, shapes) == jax.tree.map(
        jnp.shape, jax.eval_shape(lambda key: make().init(key, *inputs), jax.random.key(0))
    )

    def total(variables):
        found = [leaf for leaf in jax.tree.leaves(make(**settings).apply(variables, *inputs)) if leaf.dtype != bool]
        return sum(leaf.astype(jnp.float32).sum() for leaf in found), found

    closed, (_, found) = jax.make_jaxpr(jax.grad(total, has_aux=True), return_shape=True)(shapes)
    return list(steps(closed.jaxpr)), {leaf.dtype.name for leaf in found}


@pytest.mark.parametrize("name", with_slow(PARTS, quick=["map fusion"]))
def test_half_precision_multiplies_in_it_and_gives_float32(name):
    found, kinds = program(name, precision="bfloat16")
    assert kinds == {"float32"}
    assert halves(found)
    for step in found:  # norms and softmax
        if step.primitive.name in ("rsqrt", "exp"):
            assert step.outvars[0].aval.dtype == jnp.float32


@pytest.mark.parametrize("name", with_slow(PARTS, quick=["marker fusion"]))
def test_activations_are_recomputed_where_that_is_asked_for(name):
    *_, parts = PARTS[name]
    found, _ = program(name, remat=True)
    assert sum(step.primitive.name == "remat2" for step in found) >= parts
    assert not halves(found)


@pytest.mark.slow
@pytest.mark.parametrize("name", PARTS)
def test_recomputing_changes_no_number_and_half_precision_little(name):
    def run(variables=None, **settings):
        function, variables = outputs(name, variables, **settings)

        def total(variables):
            found = function(variables)
            return sum((leaf**2).sum() for leaf in jax.tree.leaves(found) if leaf.dtype != bool), found

        (_, found), gradient = jax.jit(jax.value_and_grad(total, has_aux=True))(variables)
        return jax.tree.leaves((found, gradient)), jax.tree.leaves(found), variables

    exact, answers, variables = run()
    largest = max(np.abs(leaf).max() for leaf in exact)  # some gradients are 0 but for rounding
    for again, expected in zip(run(variables, remat=True)[0], exact, strict=True):
        np.testing.assert_allclose(again, expected, rtol=1e-5, atol=1e-5 * largest)
    half = run(variables, precision="bfloat16")[1]
    for found, expected in zip(half, answers, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.1, atol=0.05 * np.abs(expected).max())
    assert name == "empty map, as published" or not np.array_equal(half[0], answers[0])
