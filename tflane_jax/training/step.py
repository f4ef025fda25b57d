"""The update step: loss, gradient, optimiser, moving average. It is traced once.

Several seeds share one compiled update of a single seed. One program for all of them (`vmap`) would be slower, because
XLA turns convolutions with a kernel for each seed into grouped ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from tflane_jax.devices import active, everywhere
from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.training.rng import stream
from tflane_jax.training.schedule import OptimConfig, make_optimizer, make_rate
from tflane_jax.training.state import TrainState
from tflane_jax.training.task import Trainable
from tflane_jax.training.vectors import Vectors, norm, ravel

Metrics = dict[str, jax.Array]
UpdateStep = Callable[[TrainState, Any], tuple[TrainState, Metrics]]


def make_update_step(
    task: Trainable, optim: OptimConfig, steps: int, *, donate: bool = True, mesh: Mesh | None = None
) -> UpdateStep:
    """Return the jitted update (state, batch) -> (state, metrics) of one seed.

    Metrics: `loss`, the task's terms as `loss/<term>` (a name with a group, "matching/lanes", stays as it is),
    `grad_norm` before clipping, `learning_rate`, and `finite`.
    If the loss or a gradient is not finite, `finite` is False and the state is returned unchanged.
    A second trace (a batch of another shape) raises AssertionError.

    Args:
        task, optim: what to train, and how.
        steps: of the whole run.
        donate: give the memory of the input state to the new one; the input state cannot be used again.
        mesh: of several devices, on each of which the new state and the metrics are.
    """
    update = _traced_once(_update(task, optim, steps))
    placed: Any = {} if mesh is None else {"out_shardings": everywhere(mesh)}
    return jax.jit(update, donate_argnums=0 if donate else (), **placed)


def update_all(
    update: UpdateStep, states: Sequence[TrainState], batches: Sequence[Any]
) -> tuple[list[TrainState], dict[str, np.ndarray]]:
    """Return the states of all seeds after an update with a batch for each, and metrics (numpy).

    Metrics have a leading seed axis if there are several seeds. A number that is not finite in one seed leaves all
    states unchanged, which needs an `update` that donates nothing if there are several.
    """
    results = [update(state, batch) for state, batch in zip(states, batches, strict=True)]
    metrics = jax.device_get([metrics for _, metrics in results])
    if len(states) > 1 and not all(each["finite"] for each in metrics):
        results = [(state, None) for state in states]
    whole = {name: np.stack([each[name] for each in metrics]) for name in metrics[0]}
    return [state for state, _ in results], whole if len(states) > 1 else metrics[0]


def compiled_update(
    task: Trainable,
    optim: OptimConfig,
    steps: int,
    state: TrainState,
    batch: Any,
    *,
    donate: bool = True,
    mesh: Mesh | None = None,
) -> UpdateStep:
    """Return the update of one seed, compiled for the shapes of a state and a batch.

    A process compiles it once: trainings that differ only in seeds or starting parameters use the same program.

    Args:
        task, optim, steps, donate: see `make_update_step`.
        state, batch: with `mesh` as `devices.replicated` and `devices.divided` return them.
        mesh: see `devices.training_mesh`.
    """
    leaves, tree = jax.tree.flatten((state, batch))
    placed = tuple(leaf.sharding if mesh is not None else None for leaf in leaves)
    return _compiled(task, optim, steps, donate, tree, tuple(jax.typeof(leaf) for leaf in leaves), placed, mesh)


@functools.lru_cache(maxsize=16)
def _compiled(
    task: Trainable,
    optim: OptimConfig,
    steps: int,
    donate: bool,
    tree: Any,
    types: tuple[Any, ...],
    placed: tuple[Any, ...],
    mesh: Mesh | None,
) -> UpdateStep:
    update: Any = make_update_step(task, optim, steps, donate=donate, mesh=mesh)
    shapes = [
        jax.ShapeDtypeStruct(each.shape, each.dtype, weak_type=each.weak_type, sharding=where)
        for each, where in zip(types, placed, strict=True)
    ]
    with active(mesh):
        return update.lower(*jax.tree.unflatten(tree, shapes)).compile()


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

        def loss_of(learned: Params):
            return task.loss(learned | state.statistics, batch, key)

        (loss, aux), grads = jax.value_and_grad(loss_of, has_aux=True)(state.learned.tree())
        terms, statistics = split_statistics(aux)
        gradient = ravel(grads, state.learned.layout)
        grad_norm = norm(gradient)
        updates, opt_state = optimizer.update(gradient, state.opt_state, state.learned)  # pyright: ignore
        learned: Vectors = optax.apply_updates(state.learned, updates)  # pyright: ignore
        new = TrainState(
            step=state.step + 1,
            learned=learned,
            statistics=statistics,
            ema_learned=moving_average(state.ema_learned, learned, state.step, optim.ema_decay),
            ema_statistics=moving_average(state.ema_statistics, statistics, state.step, optim.ema_decay),
            opt_state=opt_state,
            key=state.key,
        )
        metrics = {name if "/" in name else f"loss/{name}": value for name, value in terms.items()} | {
            "loss": loss,
            "grad_norm": grad_norm,
            "learning_rate": rate(state.opt_state, state.step),
            "finite": jnp.isfinite(loss) & jnp.isfinite(grad_norm),
        }
        return jax.tree.map(lambda after, before: jnp.where(metrics["finite"], after, before), new, state), metrics

    return update


def moving_average(average: Any, params: Any, step: int | Int[Array, ""], decay: float | Float[Array, ""]) -> Any:
    """Return d * average + (1 - d) * params with d = min(decay, (1 + step) / (10 + step)).

    The second bound removes the initial parameters from the average early, so that it can evaluate short runs.
    """
    d = jnp.minimum(decay, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda a, p: d * a + (1.0 - d) * p, average, params)
