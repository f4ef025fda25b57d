"""Settings and results of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tflane_jax.metrics.topology import Version


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of the evaluation, during and after training.

    Attributes:
        batch_size: examples predicted at a time; does not affect the metrics.
        pictures: number of validation examples that are drawn, spread evenly over the split.
        versions: versions of OpenLane-V2's metrics. Columns of the first one have no version in their names; the others
            add columns for metrics that differ, such as "OLS_v1.0".
    """

    batch_size: int = 16
    pictures: int = 4
    versions: tuple[Version, ...] = ("v2.1",)


@dataclass(frozen=True)
class Evaluation:
    """Results of an evaluation.

    Attributes:
        protocol: name and version of the metrics.
        groups: metrics by name, for each measured group ("all", "occluded", ...).
        counts: names of the entries that are counts, not scores.
    """

    protocol: str
    groups: Mapping[str, Mapping[str, float]]
    counts: tuple[str, ...] = ("frames", "lanes")

    def scores(self) -> dict[str, float]:
        """Return the scores by "group/name", without counts. Runs record them and rate checkpoints by them."""
        return {
            f"{group}/{name}": value
            for group, values in self.groups.items()
            for name, value in values.items()
            if name not in self.counts
        }
