"""The trainings of a table: what they are, what is complete, and how long the rest takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.declaration import check
from tflane_jax.ablations.jobs import Job, check_rows
from tflane_jax.ablations.paper.table import PaperTable
from tflane_jax.ablations.store import remaining_seconds, runs_elsewhere, stored_jobs
from tflane_jax.ablations.workers import worker_threads
from tflane_jax.config import RunConfig


@dataclass(frozen=True)
class TablePlan:
    """The trainings of a table for given seeds.

    Attributes:
        table: of the paper.
        rows, hosts: configurations of the rows, and of what rows start from, by name.
        jobs, host_jobs: their trainings by name, one for each seed.
    """

    table: PaperTable
    rows: Mapping[str, RunConfig]
    hosts: Mapping[str, RunConfig]
    jobs: Mapping[str, Sequence[Job]]
    host_jobs: Mapping[str, Sequence[Job]]

    def named(self) -> dict[str, Sequence[Job]]:
        """Return all trainings; the names of hosts begin with "host"."""
        return {f"host {name}": jobs for name, jobs in self.host_jobs.items()} | dict(self.jobs)

    def every(self) -> list[Job]:
        """Return every run once, those of the hosts first."""
        return list({job.folder: job for jobs in (self.host_jobs, self.jobs) for job in seed_by_seed(jobs)}.values())

    def declared(self) -> dict[str, RunConfig]:
        """Return the configurations of all trainings; a row that starts from a host names it in place of its folder."""
        found = dict(self.rows)
        for row in self.table.rows:
            if row.start:
                started = replace(found[row.name].training, init_from=f"host {row.start}")
                found[row.name] = replace(found[row.name], training=started)
        return {f"host {name}": config for name, config in self.hosts.items()} | found


def plan_table(
    table: PaperTable,
    seeds: Sequence[int],
    out: Path,
    *,
    jobs: int = 1,
    cores: int | None = None,
    quick: bool = False,
) -> TablePlan:
    """Return the trainings of a table; the arguments are those of `table_run.run_table`.

    Raises UserError where one of them must fail.
    """
    rows, hosts = (table.configs(every, quick=quick) for every in (table.rows, table.hosts))
    check(table.declaration, rows)
    plan = _planned(table, rows, hosts, seeds, store_of(out, quick=quick), worker_threads(jobs, cores))
    check_rows(plan.named())
    return plan


def _planned(
    table: PaperTable,
    rows: Mapping[str, RunConfig],
    hosts: Mapping[str, RunConfig],
    seeds: Sequence[int],
    store: Path,
    threads: Mapping[str, Any],
) -> TablePlan:
    host_jobs = stored_jobs(hosts, seeds, store, threads=threads)
    origins = {row.name: host_jobs[row.start] for row in table.rows if row.start}
    return TablePlan(table, rows, hosts, stored_jobs(rows, seeds, store, threads=threads, origins=origins), host_jobs)


def store_of(out: Path, *, quick: bool) -> Path:
    """Return the folder of runs below the folder of all tables."""
    return (out / "quick" if quick else out) / "runs"


def seed_by_seed(plan: Mapping[str, Sequence[Job]]) -> list[Job]:
    """Return every run once, seed by seed, so that a table stopped early has pairs."""
    every = [job for of_seed in zip(*plan.values(), strict=True) for job in of_seed]
    return list({job.folder: job for job in every}.values())


def tell_work(plan: TablePlan, seeds: Sequence[int], store: Path, jobs: int) -> None:
    """Print how many runs are complete, how long the others take, and which exist with other thread settings.

    Args:
        plan: the trainings.
        seeds: of the plan.
        store: folder of its runs.
        jobs: trainings at a time.
    """
    every, table = plan.every(), plan.table
    complete = sum(job.is_complete() for job in every)
    text = f"{table.name}, {table.title}: {len(every)} runs, {complete} complete"
    if complete < len(every):
        seconds, guesses = remaining_seconds(plan.named(), table.minutes)
        basis = f"{guesses} of the runs by the table's own figure" if guesses else "measured on this machine"
        text += f"; the others take about {_duration(seconds / jobs)} ({jobs} at a time; {basis})"
    print(text, flush=True)

    def replan(threads: Mapping[str, Any]) -> list[Job]:
        return _planned(table, plan.rows, plan.hosts, seeds, store, threads).every()

    for line in runs_elsewhere(every, store, replan):
        print(line, flush=True)


def _duration(seconds: float) -> str:
    minutes = max(1, round(seconds / 60))
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
