"""State of a training between two steps: exactly what a bit-exact resume needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Int

from tflane_jax.devices import gathered, made_on_host
from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.startup import in_another_thread
from tflane_jax.training.rng import stream
from tflane_jax.training.task import Trainable
from tflane_jax.training.vectors import Vectors, is_vectors, layout_of, ravel


@struct.dataclass
class TrainState:
    """State of one seed after `step` updates.

    Attributes:
        step: () number of updates made.
        learned: the parameters that have a gradient.
        statistics: running statistics of batch norms, see `models.parameters`.
        ema_learned, ema_statistics: exponential moving averages of both.
        opt_state: of the optimizer; its moments are `Vectors` too.
        key: () root key of the run; it never changes, random streams are derived from it by name and step.
    """

    step: Int[Array, "*seeds"]
    learned: Vectors
    statistics: Params
    ema_learned: Vectors
    ema_statistics: Params
    opt_state: Any
    key: jax.Array

    @property
    def params(self) -> Params:
        """Return the task's parameters."""
        return _tree(gathered(self.learned)) | self.statistics

    @property
    def ema_params(self) -> Params:
        """Return their moving average, which is what gets evaluated."""
        return _tree(gathered(self.ema_learned)) | self.ema_statistics


@jax.jit
def _tree(vectors: Vectors) -> Params:
    return vectors.tree()


def init_state(task: Trainable, optimizer: optax.GradientTransformation, key: jax.Array, example: Any) -> TrainState:
    """Return the state before the first update."""
    return state_of(task.init(stream(key, "params"), example), optimizer, key)


def state_of(params: Params, optimizer: optax.GradientTransformation, key: jax.Array) -> TrainState:
    """Return the state before the first update of given parameters; it shares no buffer with them."""
    learned, statistics = split_statistics(params)
    vectors, statistics = ravel(learned, layout_of(learned)), jax.tree.map(jnp.array, statistics)
    vectors = jax.tree.map(jnp.array, vectors)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        learned=vectors,
        statistics=statistics,
        # The update donates its buffers, so none may be shared.
        ema_learned=jax.tree.map(jnp.copy, vectors),
        ema_statistics=jax.tree.map(jnp.copy, statistics),
        opt_state=optimizer.init(vectors),  # pyright: ignore[reportArgumentType]
        key=key,
    )


def init_states(
    task: Trainable, optimizer: optax.GradientTransformation, seeds: Sequence[int], example: Any
) -> list[TrainState]:
    """Return the state of every seed before the first update."""

    def init(key: jax.Array, example: Any) -> TrainState:
        return init_state(task, optimizer, key, example)

    def states() -> list[TrainState]:
        # Compiled without optimisation, because compiling takes longer than the calls.
        keys = [jax.random.key(seed) for seed in seeds]
        lowered = jax.jit(init).lower(keys[0], example)
        compiled = in_another_thread(lambda: lowered.compile({"xla_backend_optimization_level": "0"}))
        return [compiled(key, example) for key in keys]

    return made_on_host(states)


def per_seed(tree: Any, seeds: Sequence[int]) -> list[Any]:
    """Split a tree of a run as checkpoints hold it (state, parameters) into one per seed."""
    if len(seeds) == 1:
        return [tree]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(len(seeds))]


def of_all_seeds(trees: Sequence[Any]) -> Any:
    """Return trees of single seeds as one tree: without a seed axis for one seed, with a leading one for several."""
    return trees[0] if len(trees) == 1 else jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


# ---------------------------------------------------------------------------------------------------------------------
# The form in which checkpoints hold a state: trees instead of vectors.


def tree_of(state: TrainState) -> dict[str, Any]:
    """Return a state, with or without a leading seed axis, as trees: what `state_from` takes."""
    return {
        "step": state.step,
        "params": state.learned.tree() | state.statistics,
        "ema_params": state.ema_learned.tree() | state.ema_statistics,
        "opt_state": jax.tree.map(
            lambda node: node.tree() if is_vectors(node) else node, state.opt_state, is_leaf=is_vectors
        ),
        "key": state.key,
    }


def state_from(trees: dict[str, Any], like: TrainState) -> TrainState:
    """Return the state of given trees; `like` is a state of the same task and optimizer."""
    learned, statistics = split_statistics(trees["params"])
    ema_learned, ema_statistics = split_statistics(trees["ema_params"])
    return TrainState(
        step=trees["step"],
        learned=ravel(learned, like.learned.layout),
        statistics=statistics,
        ema_learned=ravel(ema_learned, like.learned.layout),
        ema_statistics=ema_statistics,
        opt_state=jax.tree.map(
            lambda node, part: ravel(part, node.layout) if is_vectors(node) else part,
            like.opt_state,
            trees["opt_state"],
            is_leaf=is_vectors,
        ),
        key=trees["key"],
    )
