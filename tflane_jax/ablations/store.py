"""A folder of runs that tables share: each run has the folder of its identity, so that equal runs are trained once."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.jobs import Job
from tflane_jax.config import RunConfig
from tflane_jax.config_io import to_json
from tflane_jax.training.records import read_records

NAME_LENGTH = 16
TOPOLOGY = {"all/TOP_ll", "all/TOP_lsls"}


def stored_jobs(
    configs: Mapping[str, RunConfig],
    seeds: Sequence[int],
    store: Path,
    *,
    threads: Mapping[str, Any],
    origins: Mapping[str, Sequence[Job]] | None = None,
) -> dict[str, list[Job]]:
    """Return the trainings of each configuration, one for each seed, in the folders of their identities.

    Args:
        configs: by the name that people see.
        seeds: of training.
        store: folder of the runs.
        threads: thread setting of the processes that train.
        origins: for rows that start from another run, that run for each seed.
    """
    plan: dict[str, list[Job]] = {}
    for name, config in configs.items():
        plan[name] = []
        for i, seed in enumerate(seeds):
            seeded = replace(config, training=replace(config.training, seeds=(seed,)))
            origin = (origins or {}).get(name, ())
            key = run_key(seeded, threads, origin[i].folder.name if origin else None)
            if origin:
                seeded = replace(seeded, training=replace(seeded.training, init_from=str(origin[i].folder)))
            further = (replace(config.evaluation, topology="geometric"),) if predicts_topology(config) else ()
            plan[name].append(Job(seeded, store / key, threads, label=f"{name}, seed {seed}", further=further))
    return plan


def predicts_topology(config: RunConfig) -> bool:
    """Return whether a model is measured by `TOPOLOGY`, to which the geometry of its lanes can be added."""
    return bool(TOPOLOGY & config.task.score_names(config.data, config.evaluation))


def run_key(config: RunConfig, threads: Mapping[str, Any], origin: str | None = None) -> str:
    """Return the name of a run's folder: a hash of its configuration, its thread setting and the run it starts from.

    Only settings that differ from their defaults count, so that a version with a new setting finds the runs of
    earlier ones. Where a default was changed, `Job.difference` tells that the folder holds another run.

    Args:
        config: with one seed.
        threads: see `training.provenance.thread_setting`.
        origin: key of the run that this one starts from, in place of `training.init_from`, so that the name does not
            depend on where the store is.
    """
    if origin is not None:
        config = replace(config, training=replace(config.training, init_from=origin))
    text = json.dumps([_chosen(config), dict(threads)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:NAME_LENGTH]


def _chosen(config: Any) -> dict[str, Any]:
    """Return the settings of a configuration that are not their defaults, as plain JSON with the names of classes."""
    plain = to_json(config)
    found: dict[str, Any] = {"class": type(config).__name__}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value == _default(field):
            continue
        found[field.name] = _chosen(value) if dataclasses.is_dataclass(value) else plain[field.name]
    return found


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def remaining_seconds(plan: Mapping[str, Sequence[Job]], minutes: float) -> tuple[float, int]:
    """Return the time that all incomplete trainings need on one core each, and how many of them are guesses.

    A run's rate is that of complete runs of the same row, or its own so far. Where there is none, a run takes
    `minutes`.
    """
    seconds, guesses, seen = 0.0, 0, set()
    for jobs in plan.values():
        rates = [rate for job in jobs if (rate := _seconds_per_step(job)) is not None]
        for job in jobs:
            if job.folder in seen or job.is_complete():
                continue
            seen.add(job.folder)
            left = job.config.training.steps - job.step()
            if rates:
                seconds += left * sum(rates) / len(rates)
            else:
                seconds, guesses = seconds + 60.0 * minutes * left / job.config.training.steps, guesses + 1
    return seconds, guesses


def _seconds_per_step(job: Job) -> float | None:
    """Return the time of an update of a run, from its last record; None without one."""
    if job.step() == 0:
        return None
    last = [record for record in read_records(job.folder / "metrics.jsonl") if record.get("split") == "train"][-1:]
    return last[0]["seconds"] / last[0]["step"] if last else None
