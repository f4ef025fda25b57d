"""A folder of runs that tables share: each run has the folder of its identity, so that equal runs are trained once."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.jobs import Job
from tflane_jax.config import RunConfig
from tflane_jax.config_io import first_difference, to_json
from tflane_jax.training.provenance import listed_setting, read_provenance, threads_of
from tflane_jax.training.records import read_records

NAME_LENGTH = 16
TOPOLOGY = {"all/TOP_ll", "all/TOP_ll_v1.0", "all/TOP_lsls"}


def stored_jobs(
    configs: Mapping[str, RunConfig],
    seeds: Sequence[int],
    store: Path,
    *,
    threads: Mapping[str, Any],
    origins: Mapping[str, Sequence[Job]] | None = None,
    content: str = "",
) -> dict[str, list[Job]]:
    """Return the trainings of each configuration, one for each seed, in the folders of their identities.

    Args:
        configs: by the name that people see.
        seeds: of training.
        store: folder of the runs.
        threads: thread setting of the processes that train.
        origins: for rows that start from another run, that run for each seed.
        content: see `Job`.
    """
    plan: dict[str, list[Job]] = {}
    for name, config in configs.items():
        plan[name] = []
        for i, seed in enumerate(seeds):
            seeded = replace(config, training=replace(config.training, seeds=(seed,)))
            origin = (origins or {}).get(name, ())
            key = run_key(seeded, threads, origin[i].folder.name if origin else None, content)
            if origin:
                seeded = replace(seeded, training=replace(seeded.training, init_from=str(origin[i].folder)))
            further = (replace(config.evaluation, topology="geometric"),) if predicts_topology(config) else ()
            job = Job(seeded, store / key, threads, label=f"{name}, seed {seed}", further=further, content=content)
            plan[name].append(job)
    return plan


def predicts_topology(config: RunConfig) -> bool:
    """Return whether a model is measured by `TOPOLOGY`, to which the geometry of its lanes can be added."""
    return bool(TOPOLOGY & config.task.score_names(config.data, config.evaluation))


def run_key(config: RunConfig, threads: Mapping[str, Any], origin: str | None = None, content: str = "") -> str:
    """Return the name of a run's folder: a hash of its configuration, its thread setting and the run it starts from.

    Only settings that differ from their defaults count, so that a version with a new setting finds the runs of
    earlier ones. Where a default was changed, `Job.difference` tells that the folder holds another run.

    Args:
        config: with one seed.
        threads: see `training.provenance.thread_setting`.
        origin: key of the run that this one starts from, in place of `training.init_from`, so that the name does not
            depend on where the store is.
        content: see `Job`.
    """
    if origin is not None:
        config = replace(config, training=replace(config.training, init_from=origin))
    text = json.dumps([_chosen(config), dict(threads), *filter(None, [content])], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:NAME_LENGTH]


def is_key(name: str) -> bool:
    """Return whether a folder has the name that `run_key` gives."""
    return re.fullmatch(rf"[0-9a-f]{{{NAME_LENGTH}}}", name) is not None


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


def runs_elsewhere(plan: Sequence[Job], store: Path, replan: Callable[[Mapping[str, Any]], Sequence[Job]]) -> list[str]:
    """Return a line for each other thread setting that has runs of this plan which do not exist under its own.

    Args:
        plan: every run once.
        store: folder of the runs.
        replan: returns the same runs, in the same order, as they are called with another thread setting.
    """
    missing = [i for i, job in enumerate(plan) if not job.exists()]
    if not missing:
        return []
    lines = []
    for setting in settings_in(store):
        there, here = replan(setting), plan[0].threads
        found = [there[i] for i in missing if there[i].exists()]
        if found:
            complete = sum(job.is_complete() for job in found)
            same = first_difference({**setting, "cores": 0}, {**here, "cores": 0}) == ""
            remedy = (
                f"add --cores {setting['cores']} to use them" if same else "start in the same environment to use them"
            )
            lines.append(
                f"{len(found)} of these runs exist with {listed_setting(setting)} ({complete} complete), but numbers "
                f"depend on it, and here is {listed_setting(here)}: {remedy}"
            )
    return lines


def settings_in(store: Path) -> list[dict[str, Any]]:
    """Return the thread settings with which runs in a store began, each once."""
    starts = (read_provenance(path.parent)[:1] for path in sorted(store.glob("*/provenance.json")))
    found = (threads_of(start) for first in starts for start in first)
    return list(
        {json.dumps(setting, sort_keys=True): setting for setting in found if setting and "cores" in setting}.values()
    )


def remaining_seconds(plan: Mapping[str, Sequence[Job]], minutes: Mapping[str, float]) -> tuple[float, int]:
    """Return the time of all updates that are left, each run on one core, and how many of the runs are guesses.

    Evaluation and compiling are not in it: `metrics.jsonl` has the time of updates alone.

    A run's rate is that of complete runs of the same row, or its own so far. Where there is none, a run takes the
    `minutes` of its row.
    """
    seconds, guesses, seen = 0.0, 0, set()
    for name, jobs in plan.items():
        rates = [rate for job in jobs if (rate := _seconds_per_step(job)) is not None]
        for job in jobs:
            if job.folder in seen or job.is_complete():
                continue
            seen.add(job.folder)
            left = job.config.training.steps - job.resumes_at()
            if rates:
                seconds += left * sum(rates) / len(rates)
            else:
                seconds, guesses = seconds + 60.0 * minutes[name] * left / job.config.training.steps, guesses + 1
    return seconds, guesses


def _seconds_per_step(job: Job) -> float | None:
    """Return the time of an update of a run, from its last record; None without one."""
    if job.step() == 0:
        return None
    last = [record for record in read_records(job.folder / "metrics.jsonl") if record.get("split") == "train"][-1:]
    return last[0]["seconds"] / last[0]["step"] if last else None
