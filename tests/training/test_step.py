"""The update step: one trace, safety against non-finite numbers, averaging, several seeds."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.training.stub import LineTask, line_arrays
from tflane_jax.datasets.batches import batch_indices
from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.models.parameters import split_statistics
from tflane_jax.training.rng import stream
from tflane_jax.training.schedule import OptimConfig, make_optimizer, make_schedule
from tflane_jax.training.state import init_states
from tflane_jax.training.step import UpdateForm, compiled_update, make_update_step, moving_average, update_all

OPTIM = OptimConfig(lr=0.01, warmup_steps=2)
STEPS = 20
ARRAYS = line_arrays()


def fresh(seeds=(0,)):
    example = jax.tree.map(lambda leaf: leaf[0], ARRAYS)
    return init_states(LineTask(), make_optimizer(OPTIM, STEPS), seeds, example)


def alone(seed=0):
    return fresh((seed,))[0]


def batch_of(seed, step, size=4):
    return jax.tree.map(lambda leaf: leaf[batch_indices(seed, step, 20, size)], ARRAYS)


def test_trainings_of_one_model_share_a_compiled_update():
    batch, other = batch_of(0, 0), batch_of(0, 0, size=3)
    first = compiled_update(LineTask(), OPTIM, STEPS, alone(), batch)
    assert compiled_update(LineTask(), OPTIM, STEPS, alone(7), batch) is first
    assert compiled_update(LineTask(), OPTIM, STEPS, alone(), other) is not first
    assert compiled_update(LineTask(blow_up=3.0), OPTIM, STEPS, alone(), batch) is not first
    expected = make_update_step(LineTask(), OPTIM, STEPS)(alone(), batch)
    jax.tree.map(np.testing.assert_array_equal, first(alone(), batch)[0].params, expected[0].params)


def test_steps_are_plain_adamw_on_the_tasks_gradient():
    task = LineTask()
    loss_of = lambda params, statistics, batch, key: task.loss(params | statistics, batch, key)  # noqa: E731
    decay = lambda params: {"line": {"kernel": True, "bias": False}}  # noqa: E731
    optimizer = optax.adamw(make_schedule(OPTIM, STEPS), weight_decay=OPTIM.weight_decay, mask=decay)
    state, update = alone(), make_update_step(task, OPTIM, STEPS)
    value_and_grad, optimizer_update = jax.jit(jax.value_and_grad(loss_of, has_aux=True)), jax.jit(optimizer.update)
    params, average = split_statistics(jax.tree.map(jnp.copy, state.params))[0], jax.tree.map(jnp.copy, state.params)
    opt_state = optimizer.init(params)
    for step in range(4):
        batch = batch_of(0, step)
        key = stream(jax.random.key(0), "dropout", step)
        (loss, terms), grads = value_and_grad(params, state.statistics, batch, key)
        updates, opt_state = optimizer_update(grads, opt_state, params)
        params = optax.apply_updates(params, updates)
        decay = min(OPTIM.ema_decay, (1 + step) / (10 + step))
        whole = params | split_statistics(terms)[1]
        average = jax.tree.map(lambda a, p, d=decay: d * a + (1 - d) * p, average, whole)

        state, metrics = update(state, batch)
        np.testing.assert_allclose(metrics["loss"], loss, rtol=1e-5)
        np.testing.assert_allclose(metrics["loss/fit"], terms["fit"], rtol=1e-5)
        norm = np.sqrt(sum(np.square(np.asarray(g)).sum() for g in jax.tree.leaves(grads)))
        np.testing.assert_allclose(metrics["grad_norm"], norm, rtol=1e-5)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4), state.params, whole)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4), state.ema_params, average)
    assert state.step == 4


def test_learning_rate_is_that_of_the_update():
    state, update = alone(), make_update_step(LineTask(), OPTIM, STEPS)
    rates = []
    for step in range(3):
        state, metrics = update(state, batch_of(0, step))
        rates.append(float(metrics["learning_rate"]))
    np.testing.assert_allclose(rates, [0.01 / 3, 0.01 * 2 / 3, 0.01], rtol=1e-5)


def test_one_trace_and_an_error_for_a_second():
    states, update = fresh((0, 1)), make_update_step(LineTask(), OPTIM, STEPS, UpdateForm(donate=False))
    for step in range(3):
        states, _ = update_all(update, states, [batch_of(0, step), batch_of(1, step)])
    with pytest.raises(AssertionError, match="traced"):
        update(states[0], batch_of(0, 0, size=5))


@pytest.mark.parametrize("poison", ["loss", "gradient"])
def test_non_finite_numbers_leave_the_state_as_it_was(poison):
    class Poisoned(LineTask):
        def loss(self, params, batch, key):
            loss, terms = super().loss(params, batch, key)
            if poison == "loss":
                return loss + jnp.where(batch["bad"].any(), jnp.nan, 0.0), terms
            # sqrt(0) is finite, its gradient is not.
            return loss + jnp.sqrt(jnp.where(batch["bad"].any(), 0.0 * loss, 1.0)), terms

    state, update = alone(), make_update_step(Poisoned(), OPTIM, STEPS)
    good, bad = ({**batch_of(0, 0), "bad": np.full(4, flag)} for flag in (False, True))
    state, metrics = update(state, good)
    assert metrics["finite"]
    before = jax.tree.map(np.array, state.replace(key=jax.random.key_data(state.key)))
    state, metrics = update(state, bad)
    assert not metrics["finite"]
    assert np.isfinite(metrics["loss"]) == (poison == "gradient")
    after = jax.tree.map(np.array, state.replace(key=jax.random.key_data(state.key)))
    jax.tree.map(np.testing.assert_array_equal, after, before)


def test_one_non_finite_seed_stops_the_update_of_all_seeds():
    states = fresh((0, 1))
    update = make_update_step(LineTask(blow_up=100.0), OPTIM, STEPS, UpdateForm(donate=False))
    batches = [batch_of(0, 0), batch_of(1, 0)]
    batches[1]["x"][0, 0] = 1000.0
    after, metrics = update_all(update, states, batches)
    assert metrics["finite"].tolist() == [True, False]
    for before, now in zip(states, after, strict=True):
        assert now.step == 0
        jax.tree.map(np.testing.assert_array_equal, now.params, before.params)


def test_several_seeds_each_equal_a_single_seed():
    seeds = (3, 8)
    states, update = fresh(seeds), make_update_step(LineTask(), OPTIM, STEPS, UpdateForm(donate=False))
    singles, single = [alone(seed) for seed in seeds], make_update_step(LineTask(), OPTIM, STEPS)
    for step in range(4):
        batches = [batch_of(seed, step) for seed in seeds]
        states, metrics = update_all(update, states, batches)
        results = [single(state, batch) for state, batch in zip(singles, batches, strict=True)]
        singles = [state for state, _ in results]
        np.testing.assert_array_equal(metrics["loss"], [m["loss"] for _, m in results])
    for one, same in zip(singles, states, strict=True):
        jax.tree.map(np.testing.assert_array_equal, (one.params, one.ema_params), (same.params, same.ema_params))


class Quiet(LineTask):
    """The stub without dropout: its loss is a mean over examples. Statistics count calls, too."""

    def init(self, key, example):
        params = super().init(key, example)
        return params | {STATISTICS: params[STATISTICS] | {"calls": jnp.zeros(())}}

    def loss(self, params, batch, key):
        error = jax.vmap(lambda x: self._apply(params, x))(batch["x"]) - batch["y"][:, None]
        new, fit = self._statistics(params, batch)[STATISTICS], (error**2).mean()
        return fit, {"fit": fit, STATISTICS: new | {"calls": params[STATISTICS]["calls"] + 1}}


def test_parts_of_a_batch_give_the_step_of_the_whole_where_the_loss_is_a_mean_over_examples():
    example = jax.tree.map(lambda leaf: leaf[0], ARRAYS)
    batch, results = batch_of(0, 0, size=6), []
    for parts in (1, 3):
        [state] = init_states(Quiet(), make_optimizer(OPTIM, STEPS), [0], example)
        results.append(make_update_step(Quiet(), OPTIM, STEPS, UpdateForm(accumulate=parts))(state, batch))
    (whole, metrics), (parts, of_parts) = results
    assert metrics.keys() == of_parts.keys()
    for name, value in metrics.items():
        np.testing.assert_allclose(of_parts[name], value, rtol=1e-6, err_msg=name)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-6), whole.learned, parts.learned)
    # Running statistics move with every part, in order; part p has the examples p, p + 3.
    expected = 0.0
    for part in range(3):
        expected = 0.5 * expected + 0.5 * batch["y"][part::3].mean()
    assert parts.statistics[STATISTICS]["calls"] == 3
    np.testing.assert_allclose(parts.statistics[STATISTICS]["mean"], expected, rtol=1e-6)


class Draws(Quiet):
    """The stub with a random number for its loss."""

    def loss(self, params, batch, key):
        loss, terms = super().loss(params, batch, key)
        return 0.0 * loss + jax.random.normal(key), terms


def test_parts_of_a_batch_have_random_numbers_of_their_own():
    """Their mean over 32 parts is far smaller than one of them nearly always is; each step draws others."""
    example = jax.tree.map(lambda leaf: leaf[0], ARRAYS)
    [state] = init_states(Draws(), make_optimizer(OPTIM, STEPS), [0], example)
    update, found = make_update_step(Draws(), OPTIM, STEPS, UpdateForm(donate=False, accumulate=32)), []
    for step in range(4):
        state, metrics = update(state, batch_of(0, step, size=32))
        found.append(float(metrics["loss"]))
    assert len(set(found)) == 4
    assert np.sqrt(np.mean(np.square(found))) < 0.45  # expected 0.18; 1 with the same number in all parts


@pytest.mark.parametrize(
    ("step", "decay", "expected"), [(0, 0.999, 0.1), (8, 0.999, 0.5), (10**6, 0.999, 0.999), (5, 0.0, 0.0)]
)
def test_moving_average(step, decay, expected):
    before, after = ({"w": jnp.array([w]), "count": jnp.array(count)} for w, count in ((1.0, 3), (0.0, 4)))
    average = moving_average(before, after, step, decay)
    np.testing.assert_allclose(average["w"], [expected], rtol=1e-6)
    assert (average["count"], average["count"].dtype) == (4, before["count"].dtype)  # of a model that counts batches
