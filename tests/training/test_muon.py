"""Muon by shape equals optax's Muon, which orthogonalises every kernel apart."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from optax.contrib import MuonDimensionNumbers, muon

from tests.training.test_schedule import as_vectors, updates_of
from tflane_jax.training.muon import orthogonal, scale_by_muon
from tflane_jax.training.schedule import OptimConfig, make_optimizer

SHAPES = {"wide": (3, 7), "tall": (7, 3), "again": (3, 7), "square": (4, 4), "row": (1, 5), "column": (5, 1)}
CONVOLUTIONS = {"conv": (3, 3, 2, 5), "narrow": (3, 3, 1, 2), "pointwise": (1, 1, 3, 7)}


def gradients(shapes, step):
    rng = np.random.default_rng(step)
    return {
        name: {"kernel": jnp.asarray(10.0 ** rng.integers(-3, 3) * rng.normal(size=shape), jnp.float32)}
        for name, shape in shapes.items()
    }


@pytest.mark.parametrize(
    "shapes", [pytest.param(SHAPES, marks=pytest.mark.slow), CONVOLUTIONS, SHAPES | CONVOLUTIONS, {"one": (1, 1)}]
)
def test_updates_are_optaxs(shapes):
    dimensions = {n: {"kernel": MuonDimensionNumbers(tuple(range(len(s) - 1)), len(s) - 1)} for n, s in shapes.items()}
    theirs = muon(1.0, consistent_rms=0.2, muon_weight_dimension_numbers=dimensions)
    ours = scale_by_muon()
    params = gradients(shapes, 99)
    states = [ours.init(as_vectors(params)), theirs.init(params)]
    ours_update, theirs_update = jax.jit(ours.update), jax.jit(theirs.update)
    for step in range(4):
        grads = gradients(shapes, step)
        found, states[0] = ours_update(as_vectors(grads), states[0])
        expected, states[1] = theirs_update(grads, states[1], params)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, -b, atol=2e-5), found.tree(), expected)


@pytest.mark.parametrize("shape", [pytest.param((6, 40), marks=pytest.mark.slow), (40, 6), (3, 3, 8, 8)])
def test_long_kernels_are_optaxs_also_with_tiny_singular_values(shape):
    rows, columns = int(np.prod(shape[:-1])), shape[-1]
    left, _, right = np.linalg.svd(np.random.default_rng(0).normal(size=(rows, columns)), full_matrices=False)
    kernel = left @ (np.logspace(0, -6, min(rows, columns))[:, None] * right)
    grads = {"kernel": jnp.asarray(kernel.reshape(shape), jnp.float32)}
    found = orthogonal(as_vectors(grads).padded(4)).tree()["kernel"].reshape(rows, columns)
    steps = muon(1.0, consistent_rms=0.2, nesterov=False, beta=0.0)
    matrix = grads["kernel"].reshape(rows, columns)
    expected, _ = steps.update(matrix, steps.init(matrix), matrix)
    assert np.linalg.norm(found + expected) < 2e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("shape", [(6, 40), (6, 6)])
def test_products_are_those_of_float32_on_every_device(shape):
    """Regression: TF32, a GPU's default, made the updates of long kernels up to 20 times too long."""
    program = str(jax.make_jaxpr(orthogonal)(as_vectors({"kernel": jnp.ones(shape)})))
    assert program.count("dot_general[") == program.count("precision=(Precision.HIGHEST, Precision.HIGHEST)") > 0


def test_one_iteration_for_all_kernels_of_a_shape():
    def products(shapes):
        return str(jax.make_jaxpr(orthogonal)(as_vectors(gradients(shapes, 0)))).count("dot_general")

    assert products(SHAPES) == products({name: SHAPES[name] for name in ("wide", "square", "row")})


def test_a_kernel_without_gradient_is_not_updated():
    grads = {"learned": {"kernel": jnp.ones((2, 3))}, "frozen": {"kernel": jnp.zeros((2, 3))}}
    found = orthogonal(as_vectors(grads)).tree()
    np.testing.assert_array_equal(found["frozen"]["kernel"], 0.0)
    assert np.isfinite(found["learned"]["kernel"]).all()


@pytest.mark.parametrize("kernels", ["dense", "dense_and_convolution"])
def test_only_the_kernels_that_are_named_are_muons(kernels):
    config = OptimConfig(lr=0.1, warmup_steps=0, weight_decay=0.0, clip_norm=np.inf, muon_kernels=kernels)
    grads = gradients(SHAPES | CONVOLUTIONS | {"graph": (2, 3, 4)}, 0) | {"queries": {"embedding": jnp.ones((5, 3))}}
    params = jax.tree.map(jnp.zeros_like, grads)
    found, adam = (
        updates_of(make_optimizer(dataclasses.replace(config, optimizer=kind), 10), grads, params)[0]
        for kind in ("muon", "adam")
    )
    changed = {name for name in grads if not optax.tree.allclose(found[name], adam[name], rtol=1e-5)}
    expected = set(SHAPES) | (set(CONVOLUTIONS) if kernels == "dense_and_convolution" else set())
    assert changed == expected
