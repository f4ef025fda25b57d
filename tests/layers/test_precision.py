"""bfloat16 and recomputed activations: where they act, and what stays float32."""

from dataclasses import dataclass, replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.gpu.steps import everywhere
from tests.models.cases import WITH_TRAFFIC, make_example
from tflane_jax.config import load_config
from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.graph import RelationshipHead
from tflane_jax.layers.precision import Precision, computing, run_layer
from tflane_jax.scene import shapes_of
from tflane_jax.summary import shapes_of_params
from tflane_jax.tasks.lane_graph import LaneGraphTask


@dataclass(frozen=True)
class Settings:
    precision: Precision = "float32"
    remat: bool = False


class Block(nn.Module):
    @nn.compact
    def __call__(self, x, *, deterministic):
        attended = MultiHeadAttention(8, 2, name="attention")(x, x, x, deterministic=deterministic)
        return nn.LayerNorm(name="norm")(x + nn.Dropout(0.1, name="drop")(attended, deterministic=deterministic))


class Stack(nn.Module):
    config: Settings

    @nn.compact
    def __call__(self, x):
        x = run_layer(self, lambda: Block(name="block"), self.config, x, deterministic=False)
        return nn.Dense(3, name="head")(x)


X = np.random.default_rng(0).normal(size=(5, 8)).astype(np.float32)
VARIABLES = {"params": jax.eval_shape(Stack(Settings()).init, {"params": jax.random.key(0)}, X)["params"]}


def program(config):
    """Return a function of parameters and its gradient's steps."""

    def loss(params):
        return Stack(config).apply({"params": params}, X, rngs={"dropout": jax.random.key(1)}).sum()

    return loss, list(steps(jax.make_jaxpr(jax.grad(loss))(VARIABLES["params"]).jaxpr))


def steps(jaxpr):
    """Yield the steps of a program and of those inside it."""
    for step in jaxpr.eqns:
        yield step
        for value in step.params.values():
            for inner in value if isinstance(value, tuple | list) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from steps(inner)


def halves(found):
    return [s for s in found if s.primitive.name == "dot_general" and s.invars[0].aval.dtype == jnp.bfloat16]


@pytest.mark.parametrize("remat", [False, True])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_part_computes_as_its_settings_say(precision, remat):
    config = Settings(precision, remat)
    made = jax.eval_shape(Stack(config).init, {"params": jax.random.key(0), "dropout": jax.random.key(1)}, X)
    assert jax.tree.map(jnp.shape, made) == jax.tree.map(jnp.shape, VARIABLES)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(made)} == {"float32"}
    _, found = program(config)
    assert len(halves(found)) >= (12 if precision == "bfloat16" else 0)
    assert bool(halves(found)) == (precision == "bfloat16")
    assert any(step.primitive.name == "remat2" for step in found) == remat
    # The head behind the part and every norm are float32.
    assert all(s.outvars[0].aval.dtype == jnp.float32 for s in found if s.primitive.name == "rsqrt")
    outside = [s for s in found if s.primitive.name == "dot_general" and 3 in s.outvars[0].aval.shape]
    assert all(s.invars[0].aval.dtype == jnp.float32 for s in outside)


def test_the_default_is_the_program_without_settings():
    class Plain(nn.Module):
        @nn.compact
        def __call__(self, x):
            return nn.Dense(3, name="head")(Block(name="block")(x, deterministic=False))

    def loss(params):
        return Plain().apply({"params": params}, X, rngs={"dropout": jax.random.key(1)}).sum()

    expected, found = (jax.make_jaxpr(jax.grad(f))(VARIABLES["params"]) for f in (loss, program(Settings())[0]))
    assert str(found) == str(expected)


def test_a_layer_keeps_a_dtype_of_its_own():
    dense = nn.Dense(2, dtype=jnp.float32)
    with computing("bfloat16"):
        found = jax.eval_shape(lambda x: dense.init_with_output(jax.random.key(0), x)[0], X)
    assert found.dtype == jnp.float32


def test_edge_logits_are_not_rounded():
    """Of bfloat16 numbers there are 128 between 1 and 2: many pairs would have the same score."""
    lanes = np.random.default_rng(0).normal(size=(60, 16)).astype(np.float32)
    head = RelationshipHead(8)
    params = head.init(jax.random.key(0), lanes, lanes)
    with computing("bfloat16"):
        logits = np.asarray(head.apply(params, lanes, lanes))
    assert logits.dtype == np.float32
    assert (logits != logits.astype(jnp.bfloat16)).mean() > 0.9
    np.testing.assert_allclose(logits, head.apply(params, lanes, lanes), atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tf_lane/toponet_tfm", "tf_lane/lanesegnet", "tf_lane/maptr", "camera/toponet"])
def test_every_part_of_a_host_has_both(name):
    config = load_config(name)
    example = config.task.shapes(config.data)
    task = replace(config.task, model=everywhere(config.task.model, "bfloat16", remat=True))
    plain, params = (shapes_of_params(each, example) for each in (config.task, task))
    assert plain == params
    program = jax.make_jaxpr(jax.value_and_grad(task.loss, has_aux=True), return_shape=True)
    closed, ((loss, _), gradient) = program(params, shapes_of(example, 2), jax.random.key(0))
    assert {leaf.dtype.name for leaf in jax.tree.leaves((loss, gradient))} == {"float32"}
    found = list(steps(closed.jaxpr))
    assert halves(found)
    assert sum(step.primitive.name == "remat2" for step in found) >= config.task.model.decoder.layers


@pytest.mark.slow
def test_losses_in_half_precision_are_close_and_recomputing_changes_nothing():
    losses = {}
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), make_example())
    for settings in (Settings(), Settings(remat=True), Settings("bfloat16")):
        task = LaneGraphTask(everywhere(WITH_TRAFFIC, settings.precision, remat=settings.remat))
        params = LaneGraphTask(WITH_TRAFFIC).init(jax.random.key(0), make_example())
        losses[settings] = float(jax.jit(task.loss)(params, batch, jax.random.key(0))[0])
    exact, again, half = losses.values()
    assert again == pytest.approx(exact, rel=1e-6)
    assert half == pytest.approx(exact, rel=0.05)
    assert half != exact


class Biased(nn.Module):
    @nn.compact
    def __call__(self, x):
        dense = nn.Dense(2, name="dense")
        with computing("bfloat16"):
            return nn.Conv(4, (1,), name="convolution")(dense(dense(x)))


def test_gradients_of_biases_are_summed_in_float32():
    """Regression: sums of bfloat16 over many cells stop growing at some hundred terms of equal size."""
    x = jnp.ones((20_000, 2), jnp.float32)
    params = Biased().init(jax.random.key(0), x)
    _, passed = Biased().apply(params, x, capture_intermediates=True)
    assert {leaf.dtype for leaf in jax.tree.leaves(passed)} == {jnp.dtype(jnp.bfloat16)}
    gradient = jax.jit(jax.grad(lambda params: Biased().apply(params, x).astype(jnp.float32).sum()))
    np.testing.assert_array_equal(gradient(params)["params"]["convolution"]["bias"], 20_000)
    for step in steps(jax.make_jaxpr(gradient)(params).jaxpr):
        assert step.primitive.name != "reduce_sum" or step.outvars[0].aval.dtype == jnp.float32
