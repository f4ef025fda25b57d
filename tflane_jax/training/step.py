"""The update step: loss, gradient, optimiser, moving average. It is traced once, and its input state is donated."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.training.rng import stream
from tflane_jax.training.schedule import OptimConfig, make_optimizer, make_rate
from tflane_jax.training.state import TrainState
from tflane_jax.training.task import Trainable

Metrics = dict[str, jax.Array]
UpdateStep = Callable[[TrainState, Any], tuple[TrainState, Metrics]]


def make_update_step(task: Trainable, optim: OptimConfig, steps: int) -> UpdateStep:
    """Return the jitted update (state, batch) -> (state, metrics); the input state is donated.

    Metrics: `loss`, the task's terms as `loss/<term>` (a name with a group, "matching/lanes", stays as it is),
    `grad_norm` before clipping, `learning_rate`, and `finite`.
    If the loss or a gradient is not finite, `finite` is False and the state is returned unchanged.
    A second trace (a batch of another shape) raises AssertionError.
    """
    return _guarded(_update(task, optim, steps))


def make_multi_seed_step(
    task: Trainable, optim: OptimConfig, steps: int, *, batch: Literal["shared", "per_seed"]
) -> UpdateStep:
    """Return the update of several seeds at once: state and metrics have a leading seed axis.

    Each seed trains as it would alone, up to float rounding (batched products round differently). A number that is not
    finite in one seed leaves the states of all seeds unchanged.

    Args:
        task, optim, steps: as for `make_update_step`.
        batch: "per_seed" batches have a leading seed axis, a "shared" batch serves every seed.
    """
    update = _update(task, optim, steps)
    return _guarded(jax.vmap(update, in_axes=(0, 0 if batch == "per_seed" else None)))


def compiled_update(
    task: Trainable, optim: OptimConfig, steps: int, seeds: int, state: TrainState, batch: Any
) -> UpdateStep:
    """Return the update of one or several seeds (with a batch for each), compiled for these shapes.

    A process compiles it once: trainings that differ only in seeds or starting parameters use the same program.
    """
    leaves, tree = jax.tree.flatten((state, batch))
    return _compiled(task, optim, steps, seeds, tree, tuple(jax.typeof(leaf) for leaf in leaves))


@functools.lru_cache(maxsize=16)
def _compiled(
    task: Trainable, optim: OptimConfig, steps: int, seeds: int, tree: Any, types: tuple[Any, ...]
) -> UpdateStep:
    if seeds == 1:
        update: Any = make_update_step(task, optim, steps)
    else:
        update = make_multi_seed_step(task, optim, steps, batch="per_seed")
    shapes = [jax.ShapeDtypeStruct(each.shape, each.dtype, weak_type=each.weak_type) for each in types]
    return update.lower(*jax.tree.unflatten(tree, shapes)).compile()


def _guarded(update: UpdateStep) -> UpdateStep:
    """Compile an update that keeps the old state (of every seed) unless all numbers are finite."""

    def guarded(state: TrainState, batch: Any) -> tuple[TrainState, Metrics]:
        new, metrics = update(state, batch)
        finite = metrics["finite"].all()
        return jax.tree.map(lambda after, before: jnp.where(finite, after, before), new, state), metrics

    return jax.jit(_traced_once(guarded), donate_argnums=0)


def _traced_once(update: UpdateStep) -> UpdateStep:
    """Raise on a second trace of this function.

    `chex.assert_max_traces` counts by source and call stack: two models trained from one line of a script would fail.
    """
    traces = 0

    def checked(state: TrainState, batch: Any) -> tuple[TrainState, Metrics]:
        nonlocal traces
        traces += 1
        if traces > 1:
            raise AssertionError("the update step was traced twice: shapes or types of state or batch have changed")
        return update(state, batch)

    return checked


def _update(task: Trainable, optim: OptimConfig, steps: int) -> UpdateStep:
    optimizer, rate = make_optimizer(optim, steps), make_rate(optim, steps)

    def update(state: TrainState, batch: Any) -> tuple[TrainState, Metrics]:
        key = stream(state.key, "dropout", state.step)
        learned, statistics = split_statistics(state.params)

        def loss_of(learned: Params):
            return task.loss(learned | statistics, batch, key)

        (loss, aux), grads = jax.value_and_grad(loss_of, has_aux=True)(learned)
        terms, statistics = split_statistics(aux)
        grad_norm = optax.tree.norm(grads)
        updates, opt_state = optimizer.update(grads, state.opt_state, learned)
        params: Params = optax.apply_updates(learned, updates) | statistics  # pyright: ignore
        new = TrainState(
            step=state.step + 1,
            params=params,
            ema_params=moving_average(state.ema_params, params, state.step, optim.ema_decay),
            opt_state=opt_state,
            key=state.key,
        )
        metrics = {name if "/" in name else f"loss/{name}": value for name, value in terms.items()} | {
            "loss": loss,
            "grad_norm": grad_norm,
            "learning_rate": rate(state.opt_state, state.step),
            "finite": jnp.isfinite(loss) & jnp.isfinite(grad_norm),
        }
        return new, metrics

    return update


def moving_average(
    average: Params, params: Params, step: int | Int[Array, ""], decay: float | Float[Array, ""]
) -> Params:
    """Return d * average + (1 - d) * params with d = min(decay, (1 + step) / (10 + step)).

    The second bound removes the initial parameters from the average early, so that it can evaluate short runs.
    """
    d = jnp.minimum(decay, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda a, p: d * a + (1.0 - d) * p, average, params)
