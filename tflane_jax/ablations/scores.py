"""Scores of trained runs on test sets, kept beside each run.

An entry of a file of scores is valid for one checkpoint (its content), one data source, one evaluation setting, and one
state of the program's code, of the user's own modules, and of the files of maps and logs. Whatever else is in the file
is ignored. Scores by an earlier state of the code count where `Job.scored_by` says so. Those of a recorded run are in
its record.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import tflane_jax
from tflane_jax.ablations.held_out import load_test_data
from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.recorded import Measured, Which, evaluation_name
from tflane_jax.config import RunConfig
from tflane_jax.config_io import to_json
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets.sources import source_of
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import SceneRatio, SceneSamples
from tflane_jax.files.atomic import write_json
from tflane_jax.own_modules import own_content
from tflane_jax.runs import open_run
from tflane_jax.training.checkpoint import Checkpoints

CHECKPOINTS: tuple[Which, ...] = ("last", "best")
OWN_TEST = ""
"""Name of a configuration's own test split."""


def with_test_set(config: RunConfig, settings: Sequence[str]) -> RunConfig:
    """Return the configuration whose test split is a named test set; its own for no settings.

    Raises UserError for settings that are not of the data, for the others cannot change in a trained model, and for
    data that do not fit the model.
    """
    for name in settings:
        if name.startswith("--") and not name.startswith("--data"):
            raise UserError(f"a test set changes settings of the data (--data...), {name} is none")
    if not settings:
        return config
    training = replace(config.training, seeds=(0,), init_from=None)  # what all seeds share, for the cache
    data = with_settings(replace(config, training=training), tuple(settings)).data
    config.task.check_settings(data)
    return replace(config, data=data)


@functools.lru_cache(maxsize=256)
def with_settings(config: RunConfig, settings: tuple[str, ...]) -> RunConfig:
    """Apply settings; cached, because this takes a second and is the same for all seeds."""
    return apply_overrides(config, settings)


def measure_all(job: Job) -> None:
    """Evaluate a finished run on all of its test sets, so that the scores are at hand afterwards."""
    for config, which in evaluations(job):
        measure(job, config, which)


def is_measured(job: Job) -> bool:
    """Return whether a run is complete and its file holds everything that `measure_all` would measure."""
    if job.recorded is not None:
        return True
    if not job.is_complete():
        return False
    kept = dict(_read(_file(job)))
    try:
        checkpoints = [_checkpoint(job, config, which) for config, which in evaluations(job)]
    except UserError:  # a damaged checkpoint: `measure_all` tells it, as a failure of this run alone
        return False
    return all(_valid(kept, parts, job) is not None for _, parts in filter(None, checkpoints))


def evaluations(job: Job) -> Iterator[tuple[RunConfig, Which]]:
    """Yield everything that a run is to be evaluated by: configuration and checkpoint."""
    for settings in ((), *job.tests.values()):
        for which in CHECKPOINTS:
            yield with_test_set(job.config, settings), which
    for evaluation in job.further:
        yield replace(job.config, evaluation=evaluation), "last"


def measure(job: Job, config: RunConfig, which: Which) -> Measured | None:
    """Return the scores of a finished run on a test set, evaluated once.

    Args:
        job: the run.
        config: whose test split to evaluate on, see `with_test_set`.
        which: the last checkpoint, or the best one by `training.best_metric` on the validation split.

    Returns:
        None for "best" if no evaluation gave a finite best metric.
    """
    if job.recorded is not None:
        return job.recorded.measured[evaluation_name(which, config.evaluation, job.config.evaluation)]
    if (checkpoint := _checkpoint(job, config, which)) is None:
        return None
    (step, parts), path = checkpoint, _file(job)
    kept = dict(_read(path))
    if (entry := _valid(kept, parts, job)) is None:
        run = open_run(job.folder, step)
        task = run.config.task
        data = load_test_data(config)
        # Another evaluation than the run's own, such as with geometric topology, adds a column to the row as trained.
        own = config.evaluation == job.config.evaluation
        ways = {"": config.evaluation} | (task.interventions(data, config.evaluation) if own else {})
        found = {way: task.evaluate(run.params[0], data, evaluation) for way, evaluation in ways.items()}
        entry = {
            "code": code_digest(),
            "step": step,
            "protocol": found[""].protocol,
            "ways": {way: evaluation.scores() for way, evaluation in found.items()},
            "ratios": {way: _counts(evaluation.ratios) for way, evaluation in found.items()},
        }
        if own:  # nothing is tested by another one
            entry["samples"] = {way: _samples(evaluation.samples()) for way, evaluation in found.items()}
        if job.scored_by == "this code":
            kept = {name: other for name, other in kept.items() if other["code"] == code_digest()}
        write_json(path, kept | {_mark(parts, code_digest()): entry}, indent=None)
    ratios = {
        way: {name: SceneRatio(*map(tuple, counts)) for name, counts in of_way.items()}
        for way, of_way in entry["ratios"].items()
    }
    samples = {
        way: {name: SceneSamples(*map(tuple, values)) for name, values in of_way.items()}
        for way, of_way in entry.get("samples", {}).items()
    }
    return Measured(entry["step"], entry["protocol"], entry["ways"], ratios, entry["code"], samples)


def _file(job: Job) -> Path:
    return job.folder.with_name(f"{job.folder.name}.scores.json")


def _checkpoint(job: Job, config: RunConfig, which: Which) -> tuple[int, dict[str, Any]] | None:
    """Return step and parts of the mark of an evaluation; None if the run has no such checkpoint."""
    checkpoints = Checkpoints(job.folder / "checkpoints", best_metric=config.training.best_metric)
    step = checkpoints.best_step() if which == "best" else checkpoints.find("last")
    if step is None:
        return None
    source = config.data.source("test")
    # Left out where there is nothing of the kind: the marks of all other entries stay what they were.
    further = {
        "content": job.content,
        "files": source_of(source).content(source),
        "own modules": own_content(config),
    }
    return step, {
        "checkpoint": checkpoints.digest(step),
        "source": repr(source),
        "evaluation": to_json(config.evaluation),
        **{name: content for name, content in further.items() if content},
    }


def _valid(entries: dict[str, dict[str, Any]], parts: Mapping[str, Any], job: Job) -> dict[str, Any] | None:
    """Return the entry of an evaluation that counts for a job: by this state of the code, or else the latest other."""
    codes = [code_digest()]
    if job.scored_by == "any code":
        codes += dict.fromkeys(entry["code"] for entry in reversed(entries.values()))
    found = ((entries.get(_mark(parts, code)), code) for code in codes)
    return next((entry for entry, code in found if entry is not None and entry["code"] == code), None)


def _counts(ratios: Mapping[str, SceneRatio]) -> dict[str, list[Sequence[float]]]:
    return {name: [list(ratio.numerator), list(ratio.denominator)] for name, ratio in ratios.items()}


def _samples(samples: Mapping[str, SceneSamples]) -> dict[str, list[Sequence[float]]]:
    return {name: [list(each.lanes), list(each.values)] for name, each in samples.items()}


def _mark(parts: Mapping[str, Any], code: str) -> str:
    """Return the name of an entry: a hash of what is evaluated, and by which state of the code."""
    return hashlib.sha256(json.dumps({**parts, "code": code}, sort_keys=True).encode()).hexdigest()


def _read(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the entries of a file of scores that are complete."""
    with contextlib.suppress(OSError, ValueError, RecursionError):
        content = json.loads(path.read_text(encoding="utf-8"))
        for mark, entry in content.items() if isinstance(content, dict) else ():
            if _is_entry(entry):
                yield mark, entry


def _is_entry(entry: Any) -> bool:
    """Return whether an entry of a file of scores is one that `measure` wrote; others are measured again."""
    kinds = {"code": str, "step": int, "protocol": str, "ways": dict, "ratios": dict}
    if not isinstance(entry, dict) or not all(isinstance(entry.get(name), kind) for name, kind in kinds.items()):
        return False
    numbers = [value for scores in entry["ways"].values() for value in _values(scores)]
    by_way = [*entry["ratios"].values(), *_values(entry.get("samples", {}))]  # earlier programs measured no samples
    counts = [pair for of_way in by_way for pair in _values(of_way)]
    paired = [isinstance(pair, list) and [type(half) for half in pair] == [list, list] for pair in counts]
    return "" in entry["ways"] and all(type(value) in (int, float) for value in numbers) and all(paired)


def _values(mapping: Any) -> list[Any]:
    return list(mapping.values()) if isinstance(mapping, dict) else [None]


@functools.cache
def code_digest() -> str:
    """Return the hash of the package's source files."""
    package = Path(tflane_jax.__file__).parent
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
