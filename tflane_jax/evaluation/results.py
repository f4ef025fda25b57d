"""Settings and results of an evaluation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from tflane_jax.evaluation.geometric_topology import Topology
from tflane_jax.limits import DIFFERENT, NOT_EMPTY, Count, CountOrZero
from tflane_jax.metrics.groups import COUNTS, shown_of_part
from tflane_jax.metrics.map_matching import Measure
from tflane_jax.metrics.topology import Version

Traffic = Literal["own", "none", "other-scene"]
"""Traffic flow at inference: that of the frame, none, or that of a frame of another scene."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of the evaluation, during and after training.

    Attributes:
        batch_size: examples predicted at a time; does not affect the metrics.
        pictures: number of validation examples that are drawn, spread evenly over the split.
        versions: versions of OpenLane-V2's metrics. Columns of the first one have no version in their names; the others
            add columns for metrics that differ, such as "OLS_v1.0".
        traffic: traffic flow that the model sees: that of the frame, none, or that of a frame of another scene.
        topology: which lane follows which: as predicted ("learned"), or that plus the geometry of the predicted lanes
            ("geometric", see `evaluation.geometric_topology`).
        map_measures: of the lines of vector maps: MapTR's AP by "chamfer" distance, always measured; "iou" adds its
            optional AP by overlap as the group "lines IoU" (slow, needs shapely).
    """

    batch_size: Count = 16
    pictures: CountOrZero = 4
    versions: Annotated[tuple[Version, ...], NOT_EMPTY, DIFFERENT] = ("v2.1",)
    traffic: Traffic = "own"
    topology: Topology = "learned"
    map_measures: Annotated[tuple[Measure, ...], DIFFERENT] = ("chamfer",)


def in_all_versions(scores: Iterable[str]) -> list[str]:
    """Return names of scores, each followed by the names that it has as a score of a further version (`versions`)."""
    return [name for score in scores for name in (score, *(f"{score}_{version}" for version in get_args(Version)))]


@dataclass(frozen=True)
class SceneRatio:
    """A score that is the ratio of two sums over scenes, for bootstraps over scenes.

    Attributes:
        numerator, denominator: of each scene; the score is the ratio of their sums.
    """

    numerator: tuple[float, ...]
    denominator: tuple[int, ...]


@dataclass(frozen=True)
class SceneSamples:
    """A score that ranks detections over all scenes, in bootstrap samples that all runs share (`evaluation.by_scene`).

    Attributes:
        lanes: true lanes of each scene, times the number of thresholds; runs with the same lanes have the same samples.
        values: the score in each sample.
    """

    lanes: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Evaluation:
    """Results of an evaluation.

    Attributes:
        protocol: name and version of the metrics.
        groups: metrics by name, for each measured group ("all", "occluded", ...).
        counts: names of the entries that are counts, not scores.
        ratios: parts of the scores that are ratios of sums over scenes, by "group/name".
        samples: returns the other scores in samples of the scenes, by "group/name"; takes a second.
    """

    protocol: str
    groups: Mapping[str, Mapping[str, float]]
    counts: tuple[str, ...] = COUNTS
    ratios: Mapping[str, SceneRatio] = field(default_factory=dict)
    samples: Callable[[], Mapping[str, SceneSamples]] = field(default=dict, compare=False)

    def shown(self, group: str) -> dict[str, float]:
        """Return the numbers of a group for a table; a part of the lanes or lines as `shown_of_part`."""
        values = self.groups[group]
        whole = group.removeprefix("segments ") in ("all", "lines", "lines IoU")
        return dict(values) if whole else shown_of_part(values)

    def scores(self) -> dict[str, float]:
        """Return the scores by "group/name", without counts; NaN where a table shows none, see `shown`."""
        shown = self.recorded()
        return {name: shown.get(name, math.nan) for name in self._named(self.groups)}

    def recorded(self) -> dict[str, float]:
        """Return the scores that runs record and rate checkpoints by: those of `scores` that a table shows."""
        return self._named({group: self.shown(group) for group in self.groups})

    def _named(self, groups: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
        return {
            f"{group}/{name}": value
            for group, values in groups.items()
            for name, value in values.items()
            if name not in self.counts
        }
