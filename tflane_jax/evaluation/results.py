"""What an evaluation is asked for, and what it found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tflane_jax.metrics.topology import Version


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluation while training and after it.

    Attributes:
        batch_size: examples predicted at a time; changes no number.
        pictures: examples of the validation split that are drawn, spread evenly over it.
        versions: of OpenLane-V2's metrics. The first one gives the columns without a version in their names; the
            others add columns where their numbers differ, say "OLS_v1.0".
    """

    batch_size: int = 16
    pictures: int = 4
    versions: tuple[Version, ...] = ("v2.1",)


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        protocol: of the metrics, with its version.
        groups: numbers by name, for each group that was measured ("all", "occluded", ...).
        counts: names of numbers that count examples instead of rating them.
    """

    protocol: str
    groups: Mapping[str, Mapping[str, float]]
    counts: tuple[str, ...] = ("frames", "lanes")

    def scores(self) -> dict[str, float]:
        """Return the numbers as "group/name", without counts: what runs record and checkpoints are chosen by."""
        return {
            f"{group}/{name}": value
            for group, values in self.groups.items()
            for name, value in values.items()
            if name not in self.counts
        }
