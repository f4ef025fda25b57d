"""What a table needs of a run, so that the run's folder may be gone: scores, validation curve, where it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tflane_jax.ablations.comparison import Scores
from tflane_jax.config_io import to_json
from tflane_jax.evaluation.results import EvaluationConfig, SceneRatio, SceneSamples
from tflane_jax.training.records import Record

Which = Literal["last", "best"]


@dataclass(frozen=True)
class Measured:
    """Scores of one checkpoint on one test set.

    Attributes:
        step: of the checkpoint.
        protocol: of the metrics, with its version.
        ways: scores of each way to use the run: "" as trained, others as `Task.interventions` names them.
        ratios: parts of the scores that are ratios of sums over scenes, by way and score.
        code: hash of the program that measured, see `scores.code_digest`.
        samples: other scores in samples of the scenes, by way and score; earlier programs measured none.
    """

    step: int
    protocol: str
    ways: dict[str, Scores]
    ratios: dict[str, dict[str, SceneRatio]]
    code: str = ""
    samples: Mapping[str, Mapping[str, SceneSamples]] = field(default_factory=dict)


@dataclass(frozen=True)
class Facts:
    """Provenance, duration and validation curve of a run.

    Attributes:
        commits: of the code that trained it, nine digits each, in order; one whose code was changed says so.
        devices: that trained it, in order.
        seconds: of all updates, without evaluation and compiling; None if the run has no record of it.
        validation: records of the validation split, see `training.records`.
        origins: hashes of the checkpoints that it started from; () for random parameters, and in earlier records.
        gives: hashes that stand in `origins` of runs that start from this one; () where that is not known.
    """

    commits: tuple[str, ...]
    devices: tuple[str, ...]
    seconds: float | None
    validation: tuple[Record, ...]
    origins: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordedRun:
    """A run that stands in a record of scores (`ablations.archive`).

    Attributes:
        key: see `store.run_key`.
        row: name in the table that recorded it, for messages.
        seed: of training.
        config: the resolved configuration as JSON; `training.init_from` is the key of a run that it starts from.
        threads: thread setting of the process that trained it.
        facts: see there.
        measured: by `evaluation_name`; None for "best" if no evaluation gave a finite best metric.
        time: of recording, ISO 8601 in UTC.
    """

    key: str
    row: str
    seed: int
    config: Mapping[str, Any]
    threads: Mapping[str, Any]
    facts: Facts
    measured: Mapping[str, Measured | None]
    time: str


def evaluation_name(which: Which, evaluation: EvaluationConfig, own: EvaluationConfig) -> str:
    """Return the name of an evaluation: the checkpoint, and the settings that are not the run's own."""
    settings = to_json(own)
    changed = [f"{name} {value}" for name, value in to_json(evaluation).items() if value != settings.get(name)]
    return ", ".join([which, *changed])
