"""The update step: loss, gradient, optimizer, moving average. It is traced once.

A batch may pass through the model in parts, one after the other, so that only the activations of one part are held at a
time. Loss and gradient are then means over the parts. This equals the whole batch for what is a mean over examples;
docs/scale.md names what is not: normalisers counted per batch, statistics of batch norms, dropout.

Several seeds share one compiled update of a single seed. One program for all of them (`vmap`) would be slower, because
XLA turns convolutions with a kernel for each seed into grouped ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from tflane_jax.devices import active, everywhere
from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.startup import compiled
from tflane_jax.training.loop_convolutions import with_fast_convolutions
from tflane_jax.training.rng import stream
from tflane_jax.training.schedule import OptimConfig, make_optimizer, make_rate
from tflane_jax.training.sharding import Division
from tflane_jax.training.state import TrainState
from tflane_jax.training.task import Trainable
from tflane_jax.training.vectors import Vectors, norm, ravel

Metrics = dict[str, jax.Array]
UpdateStep = Callable[[TrainState, Any], tuple[TrainState, Metrics]]


@dataclass(frozen=True)
class UpdateForm:
    """How an update runs on the devices.

    Attributes:
        donate: give the memory of the input state to the new one; the input state cannot be used again.
        mesh: devices on which the new state and the metrics are replicated; None for one device. (For a state that they
            share, see `shard_state`.)
        accumulate: parts of a batch, see `TrainingConfig.accumulate`.
        shard_state: the devices share the state, see `sharding.placed`.
    """

    donate: bool = True
    mesh: Mesh | None = None
    accumulate: int = 1
    shard_state: bool = False


def make_update_step(task: Trainable, optim: OptimConfig, steps: int, form: UpdateForm = UpdateForm()) -> UpdateStep:
    """Return the jitted update (state, batch) -> (state, metrics) of one seed.

    Metrics: `loss`, the task's terms as `loss/<term>` (a name with a group, "matching/lanes", stays as it is),
    `grad_norm` before clipping, `learning_rate`, and `finite`.
    If the loss or a gradient is not finite, `finite` is False and the state is returned unchanged.
    A second trace (a batch of another shape) raises AssertionError.

    Args:
        task, optim: what to train, and how.
        steps: of the whole run.
        form: see `UpdateForm`.
    """
    division = Division(form.mesh if form.shard_state else None)
    update = _update(task, optim, steps, form.accumulate, division)
    loops = form.accumulate > 1 or getattr(task, "loops", False)
    update = _traced_once(with_fast_convolutions(update) if loops else update)
    placed: Any = {} if form.mesh is None or form.shard_state else {"out_shardings": everywhere(form.mesh)}
    return jax.jit(update, donate_argnums=0 if form.donate else (), **placed)


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
    form: UpdateForm = UpdateForm(),
) -> UpdateStep:
    """Return the update of one seed, compiled for the shapes of a state and a batch.

    A process compiles it once: trainings that differ only in seeds or starting parameters use the same program.

    Args:
        task, optim, steps: see `make_update_step`.
        state, batch: with `form.mesh` as `sharding.placed` and `devices.divided` return them.
        form: see `UpdateForm`; its mesh, `devices.training_mesh`.
    """
    leaves, tree = jax.tree.flatten((state, batch))
    placed = tuple(leaf.sharding if form.mesh is not None else None for leaf in leaves)
    types = tuple(jax.typeof(leaf) for leaf in leaves)
    return _compiled(task, optim, steps, form, tree, types, placed)


@functools.lru_cache(maxsize=16)
def _compiled(
    task: Trainable,
    optim: OptimConfig,
    steps: int,
    form: UpdateForm,
    tree: Any,
    types: tuple[Any, ...],
    placed: tuple[Any, ...],
) -> UpdateStep:
    update: Any = make_update_step(task, optim, steps, form)
    shapes = [
        jax.ShapeDtypeStruct(each.shape, each.dtype, weak_type=each.weak_type, sharding=where)
        for each, where in zip(types, placed, strict=True)
    ]
    arguments = jax.tree.unflatten(tree, shapes)
    return compiled(update, *arguments, what="the update step", context=functools.partial(active, form.mesh))


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


def _update(task: Trainable, optim: OptimConfig, steps: int, accumulate: int, division: Division) -> UpdateStep:
    optimizer, rate = make_optimizer(optim, steps, gather=division.gathered), make_rate(optim, steps)

    def update(state: TrainState, batch: Any) -> tuple[TrainState, Metrics]:
        key, params = stream(state.key, "dropout", state.step), division.gathered(state.learned).tree()

        def of_part(statistics: Params, batch: Any, key: jax.Array) -> tuple[Vectors, Any, Params]:
            def loss_of(learned: Params):
                return task.loss(learned | statistics, batch, key)

            (loss, aux), grads = jax.value_and_grad(loss_of, has_aux=True)(params)
            terms, statistics = split_statistics(aux)
            # Whole first: parts of the vectors alone would divide the leaves too, each at other places.
            whole = division.gathered(ravel(grads, state.learned.layout))
            return division.at_rest(whole), (loss, terms), statistics

        if accumulate == 1:
            gradient, (loss, terms), statistics = of_part(state.statistics, batch, key)
        else:
            gradient, (loss, terms), statistics = _over_parts(of_part, state, batch, key, accumulate)
        grad_norm = norm(gradient)
        updates, opt_state = optimizer.update(gradient, state.opt_state, state.learned)  # pyright: ignore
        changed: Vectors = optax.apply_updates(state.learned, updates)  # pyright: ignore
        new = TrainState(
            step=state.step + 1,
            learned=changed,
            statistics=statistics,
            ema_learned=moving_average(state.ema_learned, changed, state.step, optim.ema_decay),
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
        kept = jax.tree.map(lambda after, before: jnp.where(metrics["finite"], after, before), new, state)
        return division.at_rest((kept, metrics))

    return update


def _over_parts(
    of_part: Callable[[Params, Any, jax.Array], tuple[Vectors, Any, Params]],
    state: TrainState,
    batch: Any,
    key: jax.Array,
    parts: int,
) -> tuple[Vectors, Any, Params]:
    """Return mean gradient and mean loss terms over the parts of a batch, and the statistics after the last part.

    Example i belongs to part i mod `parts`: where devices divide the batch, each has the same number of every part.
    """

    def split(leaf: jax.Array) -> jax.Array:
        return leaf.reshape(leaf.shape[0] // parts, parts, *leaf.shape[1:]).swapaxes(0, 1)

    def body(carry: tuple[Vectors, Params], part: tuple[Any, jax.Array]) -> tuple[tuple[Vectors, Params], Any]:
        total, statistics = carry
        gradient, found, updated = of_part(statistics, *part)
        return (jax.tree.map(jnp.add, total, gradient), updated), found

    start = jax.tree.map(jnp.zeros_like, state.learned), state.statistics
    (total, statistics), found = jax.lax.scan(body, start, (jax.tree.map(split, batch), jax.random.split(key, parts)))
    gradient = jax.tree.map(lambda leaf: leaf / parts, total)
    return gradient, jax.tree.map(lambda leaf: leaf.mean(0), found), statistics


def moving_average(average: Any, params: Any, step: int | Int[Array, ""], decay: float | Float[Array, ""]) -> Any:
    """Return d * average + (1 - d) * params with d = min(decay, (1 + step) / (10 + step)).

    The second bound removes the initial parameters from the average early, so that it can evaluate short runs. Leaves
    that are not floats, such as a count of batches among the statistics, are taken from `params`.
    """
    d = jnp.minimum(decay, (1.0 + step) / (10.0 + step))

    def mean(a: Any, p: Any) -> Any:
        return d * a + (1.0 - d) * p if jnp.issubdtype(p.dtype, jnp.floating) else p

    return jax.tree.map(mean, average, params)
