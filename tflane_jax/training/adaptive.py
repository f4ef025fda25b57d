"""Rule for extending or leaving a cycle of the learning rate (GTN paper, section 2.2, which states it in words only).

"If a model performs exceptionally well within a certain cycle, then the length of that cycle can be appropriately
extended [...]; if the model becomes stuck or performs poorly, then the cycle can be restarted prematurely, and
adjustments can be made to the rate or magnitude of the learning rate decrease." `judge` turns this into a rule on the
evaluations of one seed, and `training.restarts` applies its verdict. It runs on the host, on plain numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from tflane_jax.limits import Count, CountOrZero, Factor, Fraction, FractionBelowOne, PositiveOrZero

Verdict = Literal["go on", "extend", "restart"]


@dataclass(frozen=True)
class AdaptiveConfig:
    """Settings of the rule.

    An evaluation after `elapsed` of the `length` steps of a cycle counts if elapsed / length > `grace`. The run and
    each cycle have a reference: their first value that counted, then each value that improves on the reference by more
    than `threshold` times the reference's size. Smaller gains add up until they do. Only a value that becomes its
    cycle's reference can become the run's.

    1. Extend: the evaluation becomes the run's reference, the cycle is in its last `fraction` but has not ended, and it
       was extended fewer than `max_extensions` times. The rest of the cycle then takes 1 + `extend` times as long, at
       most up to the end of the run (`RestartsConfig.last_cycle` may let it take all of that). The learning rate
       continues without a jump. The first reference of the run, and a cycle whose rest would not grow, extend nothing.
    2. Restart: none of the last `patience` evaluations became the cycle's reference, the cycle has not ended, and the
       run has at least as many steps left as the cycle has had (so that no run ends at the high rates of a new cycle;
       an extension stretches the steps already made, too, see `judge`). The next update begins a cycle with this
       one's period. From then on the peak is only `shrink` times as high above the floor as before.

    Attributes:
        metric: a score of the evaluation, "group/name". The scores of lane graphs have no loss: choose another one, and
            `mode` "max".
        mode: whether a lower ("min") or a higher ("max") value is better.
        threshold: least relative improvement that counts, in [0, 1).
        fraction: last part of a cycle, relative to its length, in which it can be extended.
        extend: steps added, relative to those left.
        max_extensions: of one cycle.
        grace: first part of a cycle, relative to its length, that does not count: the learning rate is high there.
        patience: evaluations without improvement after which a cycle is stuck.
        shrink: factor on the cycle's height after a stuck cycle, in (0, 1].
    """

    metric: str = "all/loss"
    mode: Literal["min", "max"] = "min"
    threshold: FractionBelowOne = 0.01
    fraction: Fraction = 0.5
    extend: PositiveOrZero = 0.5
    max_extensions: CountOrZero = 1
    grace: Fraction = 0.25
    patience: Count = 3
    shrink: Factor = 0.7


@dataclass(frozen=True)
class Memory:
    """What the rule remembers of one seed's evaluations; plain JSON, because checkpoints hold it.

    Attributes:
        best: the run's reference, None before the first evaluation that counted.
        number: the cycle that the following attributes describe.
        cycle_best: the cycle's reference.
        stale: evaluations since then.
        extensions: of the cycle.
    """

    best: float | None = None
    number: int = 0
    cycle_best: float | None = None
    stale: int = 0
    extensions: int = 0


def judge(
    config: AdaptiveConfig, memory: Memory, value: float, *, number: int, elapsed: int, length: int, left: int
) -> tuple[Memory, Verdict]:
    """Return the memory after an evaluation, and the verdict on the cycle; `AdaptiveConfig` describes the rule.

    Args:
        config: settings.
        memory: after the previous evaluation.
        value: of the metric; a value that is not finite is no improvement.
        number: of the cycle.
        elapsed: steps since the cycle's start, which an extension moves back (`restarts.extended_cycle`); 0 or less
            before the first cycle.
        length: steps of the cycle.
        left: steps left in the run.
    """
    if memory.number != number:
        memory = Memory(best=memory.best, number=number)
    if elapsed <= config.grace * length:
        return memory, "go on"
    if _is_better(config, value, memory.cycle_best):
        leads = memory.best is not None and _is_better(config, value, memory.best)
        if memory.best is None or leads:
            memory = replace(memory, best=value)
        memory = replace(memory, cycle_best=value, stale=0)
        late = (1.0 - config.fraction) * length <= elapsed < length
        rest = length - elapsed
        longer = extended_rest(rest, left, config.extend) > rest
        if leads and late and longer and memory.extensions < config.max_extensions:
            return replace(memory, extensions=memory.extensions + 1), "extend"
        return memory, "go on"
    memory = replace(memory, stale=memory.stale + 1)
    stuck = memory.stale >= config.patience and elapsed < length
    return memory, "restart" if stuck and left >= elapsed else "go on"


def extended_rest(rest: Any, left: Any, extend: float) -> Any:
    """Return how many steps an extension makes of the rest of a cycle (numpy, whole); `left` are left in the run."""
    return np.maximum(np.minimum(np.round(rest * (1.0 + extend)), left), rest)


def _is_better(config: AdaptiveConfig, value: float, best: float | None) -> bool:
    if best is None or not math.isfinite(value):
        return math.isfinite(value)
    gain = best - value if config.mode == "min" else value - best
    return gain > config.threshold * abs(best)
