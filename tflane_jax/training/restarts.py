"""Cosine annealing with warm restarts (SGDR; GTN paper, section 2.2, Eq. 2) as a state that the optimizer carries.

Eq. (2) as printed has the peak rate on its left and closes the cosine's parenthesis before pi. The text around it
describes the SGDR paper's formula, which is used here:

    eta_t = eta_min + (eta_max - eta_min) (1 + cos(pi T_cur / T_i)) / 2

from eta_max at T_cur = 0 to eta_min at T_cur = T_i. Then the next cycle begins, `factor` times as long. The position in
the cycle is data, not a function of the step, so that cycles can change during training (`training.adaptive`) without
another compilation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from tflane_jax.limits import Fraction, at_least, below
from tflane_jax.training.adaptive import AdaptiveConfig, Memory, extended_rest, judge

_LONGEST = 2**29  # steps; twice that still is an int32


@dataclass(frozen=True)
class RestartsConfig:
    """Cycles of the learning rate.

    A run of steps = warmup + cycle_steps (1 + factor + factor^2 + ...) ends at the end of a cycle.

    Attributes:
        cycle_steps: steps of the first cycle, T_0.
        factor: length of a cycle relative to the one before it, at least 1.
        floor: least learning rate, eta_min, relative to the peak, eta_max.
        last_cycle: "cut": the run may end within a cycle. "fit": a cycle after which the next one could not be
            completed takes all steps that are left; so does one that is extended and leaves less than half of the next.
        adaptive: rule that changes cycles by the evaluations; None for fixed cycles.
    """

    cycle_steps: Annotated[int, at_least(1), below(_LONGEST)] = 1000
    factor: Annotated[float, at_least(1)] = 2.0
    floor: Fraction = 0.0
    last_cycle: Literal["cut", "fit"] = "cut"
    adaptive: AdaptiveConfig | None = None


def doubling_cycles(steps: int, *, warmup_steps: int, cycles: int = 3, metric: str = "all/loss") -> RestartsConfig:
    """Return cycles, each twice as long as the one before, that fill a run, with the adaptive rule.

    There are `cycles` where none is extended. An extension before the last two leaves room for one less: the next to
    last one then takes all steps that are left.

    Args:
        steps: of the run.
        warmup_steps: before the first cycle.
        cycles: in the run.
        metric: by which the rule judges; lower is better.
    """
    first = (steps - warmup_steps) // (2**cycles - 1)
    return RestartsConfig(first, factor=2.0, last_cycle="fit", adaptive=AdaptiveConfig(metric=metric))


class Cycle(NamedTuple):
    """Position in the cycle of the learning rate; with several seeds, every leaf has a leading seed axis.

    Attributes:
        count: updates made.
        start: first update of the cycle (it moves back when a cycle is extended).
        length: its steps, T_i.
        period: its steps before it was extended or fitted to the run; the next cycle has `factor` times as many.
        magnitude: eta_max - eta_min of this cycle, relative to that of the first.
        number: of the cycle, from 0.
    """

    count: Int[Array, "*seeds"]
    start: Int[Array, "*seeds"]
    length: Int[Array, "*seeds"]
    period: Int[Array, "*seeds"]
    magnitude: Float[Array, "*seeds"]
    number: Int[Array, "*seeds"]


def first_cycle(config: RestartsConfig, start: int, steps: int) -> Cycle:
    """Return the state before the first update; the first cycle begins with update `start` of a run of `steps`."""
    period = jnp.asarray(config.cycle_steps, jnp.int32)
    return Cycle(
        count=jnp.zeros((), jnp.int32),
        start=jnp.asarray(start, jnp.int32),
        length=fitted_length(config, start, period, steps),
        period=period,
        magnitude=jnp.ones((), jnp.float32),
        number=jnp.zeros((), jnp.int32),
    )


def fitted_length(
    config: RestartsConfig, start: Int[ArrayLike, ""], period: Int[Array, ""], steps: int
) -> Int[Array, ""]:
    """Return the steps of a cycle of `period` steps that begins with update `start` of a run of `steps`."""
    if config.last_cycle == "cut":
        return period
    ends = start + period + next_period(config, period)
    return jnp.where(ends <= steps, period, jnp.maximum(steps - start, 1)).astype(jnp.int32)


def next_period(config: RestartsConfig, period: Int[Array, ""]) -> Int[Array, ""]:
    """Return the steps of the cycle that follows one of `period` steps: T_{i+1} = factor T_i, rounded."""
    return jnp.minimum(jnp.round(period * config.factor), _LONGEST).astype(jnp.int32)


def current_cycle(config: RestartsConfig, cycle: Cycle, steps: int) -> Cycle:
    """Return the cycle of the next update: a new one if `cycle` has ended.

    A cycle is not replaced earlier, so that an evaluation at its end still finds it.
    """
    period = next_period(config, cycle.period)
    new = Cycle(
        count=cycle.count,
        start=cycle.count,
        length=fitted_length(config, cycle.count, period, steps),
        period=period,
        magnitude=cycle.magnitude,
        number=cycle.number + 1,
    )
    ended = cycle.count - cycle.start >= cycle.length
    return jax.tree.map(lambda after, before: jnp.where(ended, after, before), new, cycle)


def relative_rate(config: RestartsConfig, cycle: Cycle) -> Float[Array, ""]:
    """Return the learning rate of the next update relative to the first peak, Eq. (2); 1 before the first cycle."""
    elapsed = jnp.maximum(cycle.count - cycle.start, 0)
    return config.floor + (1.0 - config.floor) * cycle.magnitude * half_cosine(elapsed, cycle.length)


def half_cosine(elapsed: ArrayLike, length: ArrayLike) -> Float[Array, "..."]:
    """Return (1 + cos(pi elapsed / length)) / 2 for counts, precise relative to its value also near its end at 0."""
    # sin^2(pi/2 (1 - elapsed / length)) is the same without the difference of nearly equal numbers, and exactly 1 and
    # 0 at the two ends.
    return jnp.sin(jnp.pi / 2 * (jnp.subtract(length, elapsed) / jnp.asarray(length))) ** 2


def _is_cycle(node: Any) -> bool:
    return isinstance(node, Cycle)


def cycle_of(opt_state: Any) -> Cycle:
    """Return the cycle in the state of an optimizer that restarts."""
    (cycle,) = filter(_is_cycle, jax.tree.leaves(opt_state, is_leaf=_is_cycle))
    return cycle


def with_cycle(opt_state: Any, cycle: Cycle) -> Any:
    """Return an optimizer's state with another cycle (numpy) in it."""
    new = jax.tree.map(jnp.asarray, cycle)
    return jax.tree.map(lambda node: new if _is_cycle(node) else node, opt_state, is_leaf=_is_cycle)


# ---------------------------------------------------------------------------------------------------------------------
# Cycles changed by evaluations: on the host, between two updates.


def adapt(
    config: RestartsConfig,
    opt_state: Any,
    memories: Sequence[Memory],
    evaluations: Sequence[Mapping[str, float]],
    steps: int,
) -> tuple[Any, list[Memory], dict[str, list[Any]]]:
    """Judge the cycle of every seed by its evaluation, and extend or restart it by the verdict.

    Args:
        config: with `adaptive`.
        opt_state: of the optimizer, with a leading seed axis where there are several seeds.
        memories, evaluations: one per seed; an evaluation without the rule's metric is no improvement.
        steps: of the run.

    Returns:
        The optimizer's new state (same shapes and types: no compilation), the new memories, and the cycles as they
        are now, for the record: `number`, `length`, `magnitude` and `extensions`, one value per seed.
    """
    adaptive = config.adaptive
    assert adaptive is not None
    cycle: Any = jax.device_get(cycle_of(opt_state))
    count, start, length, number = (np.atleast_1d(v) for v in (cycle.count, cycle.start, cycle.length, cycle.number))
    judged = [
        judge(
            adaptive,
            memory,
            evaluation.get(adaptive.metric, math.nan),
            number=int(number[i]),
            elapsed=int(count[i] - start[i]),
            length=int(length[i]),
            left=int(steps - count[i]),
        )
        for i, (memory, evaluation) in enumerate(zip(memories, evaluations, strict=True))
    ]
    memories, verdicts = [memory for memory, _ in judged], np.array([verdict for _, verdict in judged])
    for verdict, change in (
        ("extend", extended_cycle(config, cycle, adaptive.extend, steps)),
        ("restart", restarted_cycle(config, cycle, adaptive.shrink, steps)),
    ):
        chosen = np.reshape(verdicts == verdict, cycle.count.shape)
        cycle = jax.tree.map(lambda after, before, chosen=chosen: np.where(chosen, after, before), change, cycle)
    values = {name: np.atleast_1d(getattr(cycle, name)).tolist() for name in ("number", "length", "magnitude")}
    return with_cycle(opt_state, cycle), memories, values | {"extensions": [m.extensions for m in memories]}


def extended_cycle(config: RestartsConfig, cycle: Any, extend: float, steps: int) -> Any:
    """Return a cycle (numpy) whose rest takes longer, see `extended_rest`.

    The elapsed steps are stretched by the same factor, so that the learning rate does not jump (up to the rounding to
    whole steps).
    """
    elapsed, run_left = cycle.count - cycle.start, steps - cycle.count
    left = cycle.length - elapsed
    longer = extended_rest(left, run_left, extend)
    if config.last_cycle == "fit":
        # Else the run could end with a few steps at the peak of a new cycle.
        too_few = 2 * (run_left - longer) < np.asarray(next_period(config, cycle.period))
        longer = np.where(too_few, np.maximum(run_left, left), longer)
    stretched = np.minimum(np.round(elapsed * (longer / np.maximum(left, 1))), _LONGEST)
    start, length = cycle.count - stretched, stretched + longer
    return cycle._replace(start=start.astype(np.int32), length=length.astype(np.int32))


def restarted_cycle(config: RestartsConfig, cycle: Any, shrink: float, steps: int) -> Any:
    """Return the cycle (numpy) that begins now after a stuck one: the same period, a lower peak."""
    return cycle._replace(
        start=cycle.count,
        length=np.asarray(fitted_length(config, cycle.count, cycle.period, steps)),
        magnitude=cycle.magnitude * np.float32(shrink),
        number=cycle.number + np.int32(1),
    )
