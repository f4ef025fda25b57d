"""What a resumed run goes on with beside its state: the entry "progress" of its latest checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, TypedDict

from tflane_jax.errors import UserError
from tflane_jax.training.adaptive import Memory
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.records import Window
from tflane_jax.training.step_time import StepTime

# What the entry raises where it is not what was written.
_WRONG = (KeyError, TypeError, ValueError, AttributeError, OverflowError)


class Latest(TypedDict):
    """Step of the latest checkpoint and its progress, both plain JSON."""

    step: int
    progress: dict[str, Any]


@dataclass
class Carried:
    """What the loop carries from step to step beside its state, and checkpoints hold.

    Attributes:
        memories: of the adaptive schedule, one a seed; none without it.
        window: sums since the last record.
        metrics: of the last evaluation.
        times: of the steps so far.
        due: whether the evaluation of this step is still to be made.
    """

    memories: list[Memory]
    window: Window = field(default_factory=Window)
    metrics: dict[str, float] = field(default_factory=dict)
    times: StepTime = field(default_factory=StepTime)
    due: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the entry "progress" of a checkpoint; `carried` reads it."""
        entry = {"window": asdict(self.window), "seconds": self.times.seconds, "metrics": self.metrics}
        if self.memories:
            entry["cycles"] = [asdict(memory) for memory in self.memories]
        return entry | {"due": True} if self.due else entry


def latest(checkpoints: Checkpoints) -> Latest | None:
    """Return the latest checkpoint, None if there is none; raises UserError if any is damaged."""
    # All are read, because the next save looks for the best one: a damaged one would end the run there.
    found = [Latest(step=step, progress=checkpoints.manifest(step).progress) for step in checkpoints.steps()]
    return found[-1] if found else None


def check_resumable(checkpoints: Checkpoints) -> None:
    """Raise UserError if the latest checkpoint is damaged: before the data are read, which may take long."""
    if (saved := latest(checkpoints)) is not None:
        carried(checkpoints, saved, ())
        checkpoints.check(saved["step"])


def carried(checkpoints: Checkpoints, saved: Latest, fresh: Sequence[Memory]) -> Carried:
    """Return what to go on with; raises UserError if it is not what was written, or was written without a training.

    Args:
        checkpoints: of the run, to name the damaged one.
        saved: the latest of them.
        fresh: memories for a run that had no adaptive schedule so far.
    """
    progress = saved["progress"]
    if "window" not in progress and saved["step"] == 0:
        folder = checkpoints.path(0).parent.parent
        raise UserError(
            f"{folder} holds weights that no training wrote, so that there is none to resume: start one from them, "
            f"--training.init-from {folder}, in another folder"
        )
    try:
        sums = {name: list(map(float, values)) for name, values in progress["window"]["sums"].items()}
        return Carried(
            memories=[Memory(**one) for one in progress.get("cycles", [])] or list(fresh),
            window=Window(int(progress["window"]["steps"]), sums),
            metrics={name: float(value) for name, value in progress["metrics"].items()},
            times=StepTime(seconds=float(progress["seconds"])),
            due=bool(progress.get("due")),
        )
    except _WRONG as error:
        raise checkpoints.damaged_progress(saved["step"], error) from error
