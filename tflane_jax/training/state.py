"""State of a training between two steps: exactly what a bit-exact resume needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Int

from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.training.rng import stream
from tflane_jax.training.task import Trainable


@struct.dataclass
class TrainState:
    """State after `step` updates; with several seeds, every leaf has a leading seed axis.

    Attributes:
        step: () number of updates made.
        params: the task's parameters, running statistics included.
        ema_params: their exponential moving average, which is what gets evaluated.
        opt_state: of the optimiser.
        key: () root key of the run; it never changes, random streams are derived from it by name and step.
    """

    step: Int[Array, "*seeds"]
    params: Params
    ema_params: Params
    opt_state: Any
    key: jax.Array


def init_state(task: Trainable, optimizer: optax.GradientTransformation, key: jax.Array, example: Any) -> TrainState:
    """Return the state before the first update."""
    params = task.init(stream(key, "params"), example)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        ema_params=jax.tree.map(jnp.copy, params),  # the update donates its buffers, so none may be shared
        opt_state=optimizer.init(split_statistics(params)[0]),
        key=key,
    )


def init_states(
    task: Trainable, optimizer: optax.GradientTransformation, seeds: Sequence[int], example: Any
) -> TrainState:
    """Return the state of a run: without a seed axis for one seed, with a leading one for several."""
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])

    def init(key: jax.Array, example: Any) -> TrainState:
        return init_state(task, optimizer, key, example)

    if len(seeds) == 1:
        return _run_once(init, keys[0], example)
    return _run_once(jax.vmap(init, in_axes=(0, None)), keys, example)


def _run_once(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function compiled without optimisation, because compiling takes longer than one call."""
    compiled = jax.jit(function).lower(*arguments).compile({"xla_backend_optimization_level": "0"})
    return compiled(*arguments)


def with_params(state: TrainState, given: Sequence[Params], optimizer: optax.GradientTransformation) -> TrainState:
    """Return the state of a run that starts from given parameters, one tree for each seed (fine-tuning)."""
    params: Params = jax.tree.map(lambda *leaves: jnp.stack(leaves), *given) if state.step.ndim else given[0]
    learned, _ = split_statistics(params)
    opt_state = jax.vmap(optimizer.init)(learned) if state.step.ndim else optimizer.init(learned)
    params = jax.tree.map(jnp.array, params)
    ema_params = jax.tree.map(jnp.copy, params)
    return state.replace(params=params, ema_params=ema_params, opt_state=opt_state)  # pyright: ignore


def per_seed(tree: Any, seeds: Sequence[int]) -> list[Any]:
    """Split a tree of a run (state, parameters, metrics) into one per seed."""
    if len(seeds) == 1:
        return [tree]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(len(seeds))]
