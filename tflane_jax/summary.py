"""The cost of a model from its shapes: parameters by part, operations and memory of prediction and training step.

Nothing is computed and no data are read, so a model of the paper's size can be summarised on a laptop.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax

from tflane_jax.run_checks import shapes_of_params, training_shapes
from tflane_jax.scene import shapes_of
from tflane_jax.tasks.base import AnyTask
from tflane_jax.training.schedule import OptimConfig, make_optimizer, scaled_to_batch
from tflane_jax.training.state import init_state
from tflane_jax.training.step import UpdateForm, make_update_step

MIB = 2**20


@dataclass(frozen=True)
class Program:
    """One compiled program.

    Attributes:
        name: what it computes.
        batch: examples at a time.
        gflop: floating-point operations, 10^9 (a multiplication with its addition counts two).
        memory: peak MiB of arguments, results and intermediate results; None if not compiled.
        temporary: MiB of intermediate results.
        compile_s: duration of compilation, seconds.
    """

    name: str
    batch: int
    gflop: float
    memory: float | None = None
    temporary: float | None = None
    compile_s: float | None = None


def parameter_counts(params: Any, depth: int = 1) -> dict[str, int]:
    """Return the number of parameters under each path of `depth` names, in order; leaves need a shape only."""
    counts: dict[str, int] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        name = ".".join(str(key.key) for key in path[:depth])
        counts[name] = counts.get(name, 0) + math.prod(leaf.shape)
    return counts


def prediction_program(task: AnyTask, example: Any, *, compiled: bool = True) -> Program:
    """Return the cost of predicting one example; `example` holds shapes."""
    lowered = jax.jit(task.predict).lower(shapes_of_params(task, example), example)
    return _program("prediction", 1, lowered, compiled)


def training_program(
    task: AnyTask, example: Any, batch_size: int, optim: OptimConfig, *, accumulate: int = 1, compiled: bool = True
) -> Program:
    """Return the cost of an update: loss, gradient, optimizer, moving average; of clips if the task is one of clips.

    With `accumulate`, the batch passes in that many parts; operations are those of all of them.
    """
    shapes, optim = training_shapes(task, example), scaled_to_batch(optim, batch_size)
    steps = any_steps(optim)
    optimizer = make_optimizer(optim, steps)
    step = make_update_step(task, optim, steps, UpdateForm(accumulate=accumulate))
    state = jax.eval_shape(partial(init_state, task, optimizer), jax.random.key(0), shapes)
    lowered = step.lower(state, shapes_of(shapes, batch_size))
    program = _program("training step", batch_size, lowered, compiled)
    # XLA counts the operations of a loop once.
    if accumulate > 1:
        return replace(program, gflop=training_program(task, example, batch_size, optim, compiled=False).gflop)
    if not getattr(task, "loops", False):
        return program
    step = make_update_step(task.unrolled, optim, steps)
    lowered = step.lower(state, shapes_of(shapes, batch_size))
    return replace(program, gflop=_program(program.name, batch_size, lowered, False).gflop)


def any_steps(optim: OptimConfig) -> int:
    """Return a number of steps that a run may have; it changes no cost of a step."""
    return optim.warmup_steps + 1000


def _program(name: str, batch: int, lowered: Any, compiled: bool) -> Program:
    cost = lowered.cost_analysis() or {}
    gflop = float(cost.get("flops", math.nan)) / 1e9
    if not compiled:
        return Program(name, batch, gflop)
    began = time.perf_counter()
    memory = lowered.compile().memory_analysis()
    seconds = time.perf_counter() - began
    # Donated arguments and the results that take their place share memory.
    whole = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    temporary = memory.temp_size_in_bytes
    return Program(name, batch, gflop, (whole + temporary) / MIB, temporary / MIB, seconds)
