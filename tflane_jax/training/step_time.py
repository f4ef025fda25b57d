"""How long the steps of a training take, and which fraction of that time they wait for examples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax

from tflane_jax import processes
from tflane_jax.datasets.streaming import Streamed

_MUCH = 0.2  # of the time
_LEAST_SECONDS = 1.0  # steps of a few milliseconds vary


@dataclass
class StepTime:
    """Time of steps; evaluations and checkpoints do not count.

    Attributes:
        seconds: of all steps of the run, also in earlier processes.
        own: of the steps of this process, seconds.
        told: whether `notices` has said that steps wait.
    """

    seconds: float = 0.0
    own: float = 0.0
    told: bool = False
    _before: float = 0.0  # `own` at the last record
    _waited: float = 0.0  # since then
    _last: tuple[float, float] = (0.0, 0.0)  # waiting in the last record: its fraction, and seconds

    def add(self, seconds: float, waited: float) -> None:
        """Add a step that took so long, and the part of it in which this process waited for the next batch."""
        self.seconds, self.own, self._waited = self.seconds + seconds, self.own + seconds, self._waited + waited

    def record(self) -> dict[str, float]:
        """Return `seconds`, and the fraction `waiting` of this process's time since the last record."""
        since = self.own - self._before
        self._last = (self._waited / since if since else 0.0, self._waited)
        self._before, self._waited = self.own, 0.0
        return {"seconds": self.seconds, "waiting": self._last[0]}

    def shown(self) -> str:
        """Return `waiting` of the last record for the progress bar, behind the loss; "" where it is little."""
        return f", waiting={self._last[0]:.0%}" if self._last[0] > _MUCH else ""

    def notices(self, step: int, arrays: Any) -> list[str]:
        """Return what to say after the last record, once: that steps wait for examples that workers load.

        Args:
            step: of the record.
            arrays: training examples.
        """
        fraction, waited = self._last
        if self.told or fraction <= _MUCH or waited < _LEAST_SECONDS or not isinstance(arrays, Streamed):
            return []
        self.told, (threads, _), others = True, arrays.config.workers(), arrays.config.processes
        place = f"process {jax.process_index()}, " if processes.process_count() > 1 else ""
        workers = f"{threads} threads" + (f" in each of {others} processes" if others else "")
        return [
            f"{place}step {step}: {fraction:.0%} of the time, training waits for examples, which {workers} load: raise "
            "data.loading.threads where cores are idle, or give this process more cores (docs/scale.md, Loading)"
        ]
