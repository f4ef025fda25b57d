"""When to extend and when to leave a cycle of the learning rate (GTN paper, section 2.2, which says it in words only).

"If a model performs exceptionally well within a certain cycle, then the length of that cycle can be appropriately
extended [...]; if the model becomes stuck or performs poorly, then the cycle can be restarted prematurely, and
adjustments can be made to the rate or magnitude of the learning rate decrease." `judge` makes this a rule on the
evaluations of one seed; `training.restarts` carries its verdict out. It runs on the host, on plain numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from tflane_jax.errors import UserError

Verdict = Literal["go on", "extend", "restart"]


@dataclass(frozen=True)
class AdaptiveConfig:
    """The rule's settings.

    An evaluation after `elapsed` of the `length` steps of a cycle is looked at where elapsed / length > `grace`. It is
    better than an earlier one where it differs from it, to the good side, by more than `threshold` times its size.

    1. Extend: the evaluation is better than all that were looked at in the run, the cycle has entered its last `share`
       but not ended, and was extended less than `max_extensions` times. What is left of it, at most up to the end of
       the run, then takes 1 + `extend` times as long; the learning rate goes on from where it is.
    2. Restart: the last `patience` evaluations are not better than the best one of this cycle before them, the cycle
       has not ended, and the run has at least as many steps left as the cycle has had (so that no run ends in the high
       rates of a cycle just begun). The next update begins a cycle of the period of this one. From then on the peak
       stands only `shrink` times as high above the floor as before.

    Attributes:
        metric: name in the evaluation's results.
        mode: whether less ("min") or more ("max") of it is better.
        threshold: least relative improvement that counts, in [0, 1).
        share: end of a cycle, relative to its length, in which it can be extended.
        extend: steps added, relative to those left.
        max_extensions: of one cycle.
        grace: beginning of a cycle, relative to its length, which is not looked at: the learning rate is high there.
        patience: evaluations without improvement that make a cycle stuck.
        shrink: of the decrease's magnitude after a cycle that was stuck, in (0, 1].
    """

    metric: str = "loss"
    mode: Literal["min", "max"] = "min"
    threshold: float = 0.01
    share: float = 0.5
    extend: float = 0.5
    max_extensions: int = 1
    grace: float = 0.25
    patience: int = 3
    shrink: float = 0.7


@dataclass(frozen=True)
class Memory:
    """What the rule remembers of one seed's evaluations; plain JSON, so that a checkpoint can carry it.

    Attributes:
        best: of the run, None before the first evaluation that was looked at.
        number: of the cycle which the following are about.
        cycle_best: best of the cycle.
        stale: evaluations since then.
        extensions: of the cycle.
    """

    best: float | None = None
    number: int = 0
    cycle_best: float | None = None
    stale: int = 0
    extensions: int = 0


def check_adaptive(config: AdaptiveConfig) -> None:
    """Raise UserError where a setting cannot work."""
    for name, fits, wanted in (
        ("threshold", 0.0 <= config.threshold < 1.0, "at least 0 and below 1"),
        ("share", 0.0 <= config.share <= 1.0, "from 0 to 1"),
        ("extend", 0.0 <= config.extend < math.inf, "at least 0"),
        ("max_extensions", config.max_extensions >= 0, "at least 0"),
        ("grace", 0.0 <= config.grace <= 1.0, "from 0 to 1"),
        ("patience", config.patience >= 1, "at least 1"),
        ("shrink", 0.0 < config.shrink <= 1.0, "above 0 and at most 1"),
    ):
        if not fits:
            value = getattr(config, name)
            raise UserError(f"optim.restarts.adaptive.{name} is {value}: it must be {wanted}")


def judge(
    config: AdaptiveConfig, memory: Memory, value: float, *, number: int, elapsed: int, length: int, left: int
) -> tuple[Memory, Verdict]:
    """Return what is remembered after an evaluation, and what becomes of the cycle; the rule is in `AdaptiveConfig`.

    Args:
        config: settings.
        memory: after the evaluation before.
        value: of the metric; one that is not finite is no improvement.
        number: of the cycle.
        elapsed: steps made in it; 0 or less before the first cycle.
        length: its steps.
        left: steps left of the run.
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
        late = (1.0 - config.share) * length <= elapsed < length
        if leads and late and memory.extensions < config.max_extensions:
            return replace(memory, extensions=memory.extensions + 1), "extend"
        return memory, "go on"
    memory = replace(memory, stale=memory.stale + 1)
    stuck = memory.stale >= config.patience and elapsed < length
    return memory, "restart" if stuck and left >= elapsed else "go on"


def _is_better(config: AdaptiveConfig, value: float, best: float | None) -> bool:
    if best is None or not math.isfinite(value):
        return math.isfinite(value)
    gain = best - value if config.mode == "min" else value - best
    return gain > config.threshold * abs(best)
