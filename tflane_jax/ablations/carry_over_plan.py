"""The trainings of `carry_over`: which model leaves out which logs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.paper.table import shortened
from tflane_jax.ablations.store import stored_jobs
from tflane_jax.config import RunConfig, load_config
from tflane_jax.datasets.real_maps import RealMapData
from tflane_jax.datasets.road_maps import find_maps
from tflane_jax.errors import UserError
from tflane_jax.files.wording import counted

ROWS: Mapping[str, str] = {
    "generated": "real_maps:generated",
    "generated, right-hand traffic": "real_maps:generated_right_hand",
    "generated on city": "real_maps:generated_city",
    "maps": "real_maps",
    "mixed": "real_maps:mixed",
    "mixed + BEV": "real_maps:mixed_bev",
    "generated without traffic": "real_maps:generated_no_traffic",
    "mixed without traffic": "real_maps:mixed_no_traffic",
}
"""Models by name: roads that they are trained on, and whether traffic flow enters the queries, the BEV features too
(+ BEV), or neither."""

# Characters of a log's name that tell it apart: ids of Argoverse 2 have 36.
_START = 12


@dataclass(frozen=True)
class Settings:
    """What is left out, trained and tested.

    Attributes:
        maps: folder of logs.
        logs: names of those to leave out, one after the other; empty for all.
        rows: of `ROWS`; empty for all.
        seeds: of training.
        steps, scenes: updates and training scenes of each run; None for those of the configurations.
        folds: number of groups into which all logs of the folder are divided; a training leaves a whole group out. None
            leaves each log out alone, which costs more trainings and leaves more maps in each.
        parallel: trainings at a time.
        cores: of each training; None shares all between the trainings.
        quick: few updates on few scenes: a smoke test, no result.
    """

    maps: Path
    logs: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)
    steps: int | None = None
    scenes: int | None = None
    folds: int | None = None
    parallel: int = 1
    cores: int | None = None
    quick: bool = False


@dataclass
class Plan:
    """The trainings: by model, by the log that it leaves out ("" for none), one for each seed.

    Logs of one fold share their trainings.

    Attributes:
        logs: that are left out and tested on.
        every: all recorded logs.
        content: hash of the files of each map in the folder, on which every run depends.
    """

    logs: tuple[str, ...]
    every: tuple[str, ...]
    content: Mapping[str, str]
    jobs: dict[str, dict[str, list[Job]]] = field(default_factory=dict)

    def of(self, row: str, log: str) -> list[Job]:
        """Return the runs of a model that have not seen a log."""
        return self.jobs[row].get(log) or self.jobs[row][""]

    def fold(self, log: str, folds: int | None) -> tuple[str, ...]:
        """Return the logs that are left out with a log: every `folds`-th by name, whichever of them are tested."""
        return (log,) if folds is None else self.every[self.every.index(log) % folds :: folds]

    def label(self, row: str, left_out: Sequence[str]) -> str:
        """Return the name of a model's runs that leave logs out; the starts of the logs' names where these differ."""
        differ = len({log[:_START] for log in self.every}) == len(self.every)
        names = ", ".join(log[:_START] if differ else log for log in left_out)
        return f"{row}, without {names}" if names else row

    def flat(self) -> list[Job]:
        """Return every run once, log by log, so that an experiment stopped early has whole logs."""
        order = [job for log in ("", *self.logs) for by_log in self.jobs.values() for job in by_log.get(log, ())]
        return list({job.folder: job for job in order}.values())

    def by_row(self) -> dict[str, list[Job]]:
        """Return the runs of each model, each once: logs of a fold share them."""
        return {
            row: list({job.folder: job for jobs in by_log.values() for job in jobs}.values())
            for row, by_log in self.jobs.items()
        }

    def other(self, log: str) -> str:
        """Return the log whose traffic a log gets: the next one by name."""
        return self.every[(self.every.index(log) + 1) % len(self.every)]


def model_configs(settings: Settings) -> dict[str, RunConfig]:
    """Return the configuration of each model; its data leave nothing out yet."""
    if unknown := set(settings.rows) - set(ROWS):
        raise UserError(f"there is no model {min(unknown)}: choose of {', '.join(ROWS)}")
    configs = {}
    for row, reference in ROWS.items():
        if settings.rows and row not in settings.rows:
            continue
        config = load_config(reference)
        data = replace(map_data(config), maps=settings.maps, test_on="recordings")
        if settings.scenes is not None:
            data = replace(data, train=settings.scenes)
        config = replace(config, data=data)
        if settings.steps is not None:
            config = replace(config, training=replace(config.training, steps=settings.steps))
        configs[row] = shortened(config) if settings.quick else config
    return configs


def map_data(config: RunConfig) -> RealMapData:
    """Return the data of a model of `ROWS`."""
    assert isinstance(config.data, RealMapData)
    return config.data


def plan_without_trainings(settings: Settings) -> Plan:
    """Return the logs of a folder as a plan that has no trainings yet; raise UserError where logs are missing."""
    maps = find_maps(settings.maps)
    names = tuple(one.name for one in maps if one.recorded)
    if len(names) < 2:
        raise UserError(
            f"{settings.maps} has {counted(len(names), 'recorded log')}: to leave one out, there must be two or more"
        )
    if settings.folds is not None and not 2 <= settings.folds <= len(names):
        raise UserError(f"--folds {settings.folds}: {settings.maps} has {len(names)} logs, so 2 to {len(names)} folds")
    if unknown := set(settings.logs) - set(names):
        raise UserError(f"{settings.maps} has no recorded log {min(unknown)}, only {', '.join(names)}")
    return Plan(tuple(sorted(settings.logs or names)), names, {one.name: one.content() for one in maps})


def with_trainings(
    untrained: Plan, settings: Settings, configs: Mapping[str, RunConfig], out: Path, threads: Mapping[str, Any]
) -> Plan:
    """Return a plan of `plan_without_trainings` with its trainings."""
    plan, store = replace(untrained, jobs={}), out / "runs"
    content = hashlib.sha256(json.dumps(plan.content, sort_keys=True).encode()).hexdigest()
    for row, config in configs.items():
        data = map_data(config)
        left_out = {"": ()} if data.generated == 1.0 else {log: plan.fold(log, settings.folds) for log in plan.logs}
        labels = {log: plan.label(row, logs) for log, logs in left_out.items()}
        named = {labels[log]: replace(config, data=replace(data, test_logs=logs)) for log, logs in left_out.items()}
        jobs = stored_jobs(named, settings.seeds, store, threads=threads, content=content)
        plan.jobs[row] = {log: jobs[label] for log, label in labels.items()}
    return plan


def on_log(config: RunConfig, log: str, traffic: str = "") -> RunConfig:
    """Return the configuration tested on a log, with the traffic of another one if it is named."""
    data = map_data(config)
    fold = tuple(other for other in data.test_logs if other != log)  # no training maps either
    data = replace(data, test_logs=(log,), without=fold, test_on="recordings", test_traffic=traffic)
    return replace(config, data=data)
