"""What a model costs, from shapes alone: parameters by part, operations and memory of prediction and training step.

Nothing is computed and no data are read, so that a paper-size model can be looked at on a laptop.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax

from tflane_jax.scene import shapes_of
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.state import init_state
from tflane_jax.training.step import make_update_step
from tflane_jax.training.task import Trainable

MIB = 2**20


@dataclass(frozen=True)
class Program:
    """One compiled program.

    Attributes:
        name: what it computes.
        batch: examples at a time.
        gflop: floating-point operations, 10^9 (a multiplication with its addition counts two).
        memory: MiB that must be there at once: arguments, results and what lies between; None if not compiled.
        between: MiB of it that are intermediate results.
        compile_s: seconds that compiling took.
    """

    name: str
    batch: int
    gflop: float
    memory: float | None = None
    between: float | None = None
    compile_s: float | None = None


def parameter_counts(params: Any, depth: int = 1) -> dict[str, int]:
    """Return the number of parameters under each path of `depth` names, in order; leaves need a shape only."""
    counts: dict[str, int] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        name = ".".join(str(key.key) for key in path[:depth])
        counts[name] = counts.get(name, 0) + math.prod(leaf.shape)
    return counts


def shapes_of_params(task: Trainable, example: Any) -> Any:
    """Return the shapes of a task's parameters; raises as the model does where an example does not fit it."""
    return jax.eval_shape(task.init, jax.random.key(0), _trained_on(task, example))


def _trained_on(task: Trainable, example: Any) -> Any:
    """Return the shapes of what a task trains on: the example, or a clip of them."""
    clip = getattr(task, "clip", 1)
    return example if clip == 1 else shapes_of(example, clip)


def prediction_program(task: Trainable, example: Any, *, compiled: bool = True) -> Program:
    """Return what one answer costs; `example` holds shapes."""
    lowered = jax.jit(task.predict).lower(shapes_of_params(task, example), example)
    return _program("prediction", 1, lowered, compiled)


def training_program(
    task: Trainable, example: Any, batch_size: int, optim: OptimConfig, *, compiled: bool = True
) -> Program:
    """Return what a whole update costs: loss, gradient, optimiser, moving average; of clips for a task of clips."""
    example = _trained_on(task, example)
    optimizer, step = make_optimizer(optim, 1000), make_update_step(task, optim, 1000)
    state = jax.eval_shape(partial(init_state, task, optimizer), jax.random.key(0), example)
    lowered = jax.jit(step).lower(state, shapes_of(example, batch_size))
    return _program("training step", batch_size, lowered, compiled)


def _program(name: str, batch: int, lowered: Any, compiled: bool) -> Program:
    cost = lowered.cost_analysis() or {}
    gflop = float(cost.get("flops", math.nan)) / 1e9
    if not compiled:
        return Program(name, batch, gflop)
    began = time.perf_counter()
    memory = lowered.compile().memory_analysis()
    seconds = time.perf_counter() - began
    # Arguments that are donated come back as results in the same place.
    whole = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    between = memory.temp_size_in_bytes
    return Program(name, batch, gflop, (whole + between) / MIB, between / MIB, seconds)
