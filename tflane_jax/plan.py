"""An estimate of a training on accelerators: memory, operations and time, from shapes and public peak numbers.

Nothing is measured. Memory of the state follows from shapes; that of gradients and activations is what XLA's compiler
for this machine plans. Time is operations over an assumed fraction of the peak. `Plan.assumptions` says what enters.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from tflane_jax.errors import UserError
from tflane_jax.scene import shapes_of
from tflane_jax.summary import Program, any_steps, training_program
from tflane_jax.tasks.base import AnyTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig, make_optimizer, scaled_to_batch
from tflane_jax.training.state import TrainState, init_state

GIB = 2**30


@dataclass(frozen=True)
class Accelerator:
    """Peak numbers of an accelerator, from the maker's data sheet (dense matrices, no sparsity).

    Attributes:
        memory: GB (10^9 bytes).
        float32, bfloat16: TFLOP/s of matrix products of such inputs; float32 as XLA computes them by default (TF32 on
            NVIDIA GPUs).
        link: GB/s to the other devices of its host, in one direction.
    """

    memory: float
    float32: float
    bfloat16: float
    link: float


ACCELERATORS = {
    "a100": Accelerator(80, 156, 312, 300),
    "h100": Accelerator(80, 494, 989, 450),
    "h200": Accelerator(141, 494, 989, 450),
    "rtx3090": Accelerator(24, 35.6, 71, 32),
    "rtx4090": Accelerator(24, 82.6, 165, 32),
}
"""The SXM forms with 80 and 141 GB, linked by NVLink; the RTX cards are linked by PCI Express 4.0 x16."""

UTILISATION = 0.04
"""Fraction of the peak that computing reaches, where none is given: what LaneSegNet and MapTRv2 reached at their
papers' sizes on one H200, in bfloat16, one example at a time (docs/benchmarks.md, "On a GPU")."""


@dataclass(frozen=True)
class Plan:
    """The estimate. Memory is of one device, GiB; time in seconds.

    Attributes:
        rows: quantity and value, for a table.
        assumptions: one sentence each.
        memory: all parts together; None if nothing was compiled.
        learned: parameters that have a gradient, all of them.
        step_s: of an update.
    """

    rows: tuple[dict[str, str], ...]
    assumptions: tuple[str, ...]
    memory: float | None
    learned: float
    step_s: float


def make_plan(
    task: AnyTask,
    example: Any,
    optim: OptimConfig,
    training: TrainingConfig,
    *,
    devices: int,
    kind: str,
    utilisation: float,
    compiled: bool = True,
) -> Plan:
    """Return the estimate for a training of one seed.

    Args:
        task, optim, training: of the run.
        example: shapes of an example.
        devices: how many devices share each batch.
        kind: of the devices, a name in `ACCELERATORS`.
        utilisation: assumed fraction of the peak.
        compiled: compile the step of one device for its memory; else its memory is not estimated.

    Raises:
        UserError: the batch cannot be shared, or a number is out of range.
    """
    _check_range(devices, utilisation)
    per_pass = _examples_per_pass(training, devices)
    device, optim = ACCELERATORS[kind], scaled_to_batch(optim, training.batch_size)
    program = training_program(task, example, per_pass, optim, compiled=compiled)
    frames = example if task.frames == 1 else shapes_of(example, task.frames)
    state: Any = jax.eval_shape(
        partial(init_state, task, make_optimizer(optim, any_steps(optim))), jax.random.key(0), frames
    )
    batch = _gib(shapes_of(frames, per_pass * training.accumulate))
    by_use = _memory(state, batch, program, training, devices)
    memory = None if None in by_use.values() else sum(value for value in by_use.values() if value is not None)

    sharded, learned, bfloat16 = _is_sharded(training, devices), _gib(state.learned), _in_bfloat16(task)
    peak = device.bfloat16 if bfloat16 else device.float32
    operations = program.gflop * training.accumulate
    compute = operations / (1e3 * peak * utilisation)
    exchange = (3 if sharded else 2) * (devices - 1) / devices * learned * GIB / (1e9 * device.link)
    step = compute + exchange
    rows = {
        **{f"memory: {name}, GiB": _number(value) for name, value in by_use.items()},
        f"memory of a device, GiB (it has {device.memory * 1e9 / GIB:.0f})": _number(memory),
        "operations of a step on a device, GFLOP": f"{operations:,.0f}",
        "computing, s a step": _number(compute),
        f"exchange of gradients{' and parameters' if sharded else ''}, s a step": _number(exchange),
        "time of a step, s": _number(step),
        "examples a second, all devices": f"{training.batch_size / step:,.1f}" if step else "-",
        f"time of {training.steps:,} steps, hours": _number(step * training.steps / 3600),
    }
    return Plan(
        tuple({"estimate": name, "value": value} for name, value in rows.items()),
        (
            f"{kind}: {device.memory:g} GB, {peak:g} TFLOP/s of {'bfloat16' if bfloat16 else 'float32 (TF32)'} "
            f"products, {device.link:g} GB/s to the others; peak numbers of the data sheet",
            f"computing reaches {utilisation:.0%} of the peak (--utilisation); measured for single examples of "
            f"LaneSegNet and MapTRv2 in bfloat16 on an H200: {UTILISATION:.0%}",
            "operations are XLA's count before fusion; frames of a clip and parts of a batch all count",
            "gradients and activations need what the compiler for this machine plans; a GPU's plan differs",
            "gradients are exchanged after computing, in a ring, at full speed of the link",
            *(("gathering what Muon needs whole takes neither memory nor time",) if sharded else ()),
            "loading, evaluation, checkpoints and compiling take no time",
        ),
        memory,
        learned,
        step,
    )


def _check_range(devices: int, utilisation: float) -> None:
    if devices < 1:
        raise UserError(f"--plan {devices}: at least 1 device")
    if not 0.0 < utilisation <= 1.0:
        raise UserError(f"--utilisation {utilisation:g}: above 0 and at most 1")


def _examples_per_pass(training: TrainingConfig, devices: int) -> int:
    """Return how many examples pass through the model of one device at once; raise UserError for unequal parts."""
    passes = devices * training.accumulate
    if training.batch_size % passes:
        raise UserError(
            f"training.batch_size is {training.batch_size}, which {devices} devices and {training.accumulate} parts "
            f"(training.accumulate) cannot share evenly: choose a multiple of {passes}"
        )
    return training.batch_size // passes


def _is_sharded(training: TrainingConfig, devices: int) -> bool:
    return training.shard_state and devices > 1


def _memory(
    state: TrainState, batch: float, program: Program, training: TrainingConfig, devices: int
) -> dict[str, float | None]:
    """Return GiB of one device by what they hold; `batch` is that of its examples, None what was not compiled."""
    learned, sharded = _gib(state.learned), _is_sharded(training, devices)
    temporary = None if program.temporary is None else program.temporary / 1024
    # Parts add up in a further gradient.
    activations = None if temporary is None else temporary + (learned if training.accumulate > 1 else 0.0)
    holders = devices if sharded else 1
    return {
        "parameters": learned / holders + _gib(state.statistics),
        "their moving average": _gib(state.ema_learned) / holders + _gib(state.ema_statistics),
        "optimizer": _gib(state.opt_state) / holders,
        **({"parameters, gathered for the loss": learned} if sharded else {}),
        "batch": batch,
        "gradients and activations": activations,
    }


def _gib(tree: Any) -> float:
    """Return the size of arrays given by their shapes; random keys count nothing."""
    plain = [leaf for leaf in jax.tree.leaves(tree) if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)]
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in plain) / GIB


def _number(value: float | None) -> str:
    return "not compiled" if value is None else f"{value:.3g}"


def _in_bfloat16(task: AnyTask) -> bool:
    """Return whether all parts of a task that have a precision compute in bfloat16."""
    found: list[str] = []

    def visit(config: Any) -> None:
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            if field.name == "precision":
                found.append(value)
            elif dataclasses.is_dataclass(value):
                visit(value)

    visit(task)
    return bool(found) and set(found) == {"bfloat16"}
