"""The trainings of a table: what they are, what is complete, and how long the rest takes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.archive import Archive
from tflane_jax.ablations.declaration import check
from tflane_jax.ablations.jobs import Job, ScoredBy, check_rows
from tflane_jax.ablations.paper.table import PaperTable
from tflane_jax.ablations.reuse import thread_settings, with_recorded
from tflane_jax.ablations.store import remaining_seconds, runs_elsewhere, settings_in, stored_jobs
from tflane_jax.ablations.workers import worker_threads
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.files.wording import counted


@dataclass(frozen=True)
class TablePlan:
    """The trainings of a table for given seeds.

    Attributes:
        table: of the paper.
        rows, hosts: configurations of the rows, and of what rows start from, by name.
        jobs: the trainings of the rows by name, one for each seed, or recorded runs in their place.
        host_jobs: those of the hosts from which a row still has to start.
    """

    table: PaperTable
    rows: Mapping[str, RunConfig]
    hosts: Mapping[str, RunConfig]
    jobs: Mapping[str, Sequence[Job]]
    host_jobs: Mapping[str, Sequence[Job]]

    def named(self) -> dict[str, Sequence[Job]]:
        """Return all trainings; the names of hosts begin with "host"."""
        return {f"host {name}": jobs for name, jobs in self.host_jobs.items()} | dict(self.jobs)

    def minutes(self) -> dict[str, float]:
        """Return how long a training of each of `named` takes, by the table's own figures."""
        hosts = dict.fromkeys((f"host {name}" for name in self.host_jobs), self.table.host_minutes)
        return hosts | dict.fromkeys(self.jobs, self.table.minutes)

    def every(self) -> list[Job]:
        """Return every run once, those of the hosts first."""
        return list({job.folder: job for jobs in (self.host_jobs, self.jobs) for job in seed_by_seed(jobs)}.values())

    def seeds(self) -> list[int]:
        """Return the seeds of the rows."""
        return [job.seed for job in next(iter(self.jobs.values()))]

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
    parallel: int = 1,
    cores: int | None = None,
    quick: bool = False,
    finished: bool = False,
    device: str | None = None,
    archive: Archive | None = None,
    scored_by: ScoredBy = "this code",
) -> TablePlan:
    """Return the trainings of a table; the arguments are those of `table_run.begin_table`.

    Raises UserError where one of them must fail; with `finished`, where none is complete.
    """
    rows, hosts = (table.configs(every, quick=quick) for every in (table.rows, table.hosts))
    check(table.declaration, rows)
    archive, store = archive or Archive(table.name, None, {}), store_of(out, quick=quick)
    settings = thread_settings(archive, worker_threads(parallel, cores))
    if finished:
        settings += [setting for setting in settings_in(store) if setting not in settings]
    plans = [_planned(table, rows, hosts, seeds, store, threads) for threads in settings]
    chosen = with_recorded([plan.jobs for plan in plans], archive, table.declaration, finished=finished, device=device)
    trained = {name: [replace(job, scored_by=scored_by) for job in of_row] for name, of_row in chosen.items()}
    if finished:
        return _of_finished(replace(plans[0], jobs=trained, host_jobs={}), store)
    # Hosts are trained only for rows that still start from them: retraining the host of a complete row would make it
    # another run.
    starts = {job.config.training.init_from for of_row in trained.values() for job in of_row if not job.is_complete()}
    needed = {
        name: [job for job in of_host if str(job.folder) in starts] for name, of_host in plans[0].host_jobs.items()
    }
    plan = replace(plans[0], jobs=trained, host_jobs=needed)
    check_rows(plan.named())
    return plan


def _of_finished(plan: TablePlan, store: Path) -> TablePlan:
    """Return the plan with the seeds that any row has finished; raise UserError if there are none."""
    number = len(next(iter(plan.jobs.values())))
    kept = [i for i in range(number) if any(jobs[i].is_complete() for jobs in plan.jobs.values())]
    if not kept:
        raise UserError(f"no run of {plan.table.name} is finished in {store}: leave out --finished to train them")
    return replace(plan, jobs={name: [jobs[i] for i in kept] for name, jobs in plan.jobs.items()})


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


def with_seeds(plan: TablePlan, seeds: Sequence[int], store: Path, threads: Mapping[str, Any]) -> dict[str, list[Job]]:
    """Return the trainings of the rows of a plan, and those of further seeds."""
    further = _planned(plan.table, plan.rows, plan.hosts, seeds, store, threads).jobs
    return {
        name: list({job.folder: job for job in (*further[name], *jobs)}.values()) for name, jobs in plan.jobs.items()
    }


def store_of(out: Path, *, quick: bool) -> Path:
    """Return the folder of runs below the folder of all tables."""
    return (out / "quick" if quick else out) / "runs"


def seed_by_seed(plan: Mapping[str, Sequence[Job]]) -> list[Job]:
    """Return every run once, seed by seed, so that a table stopped early has pairs.

    Of a run that one table takes from a record and another one has to train, the training.
    """
    found: dict[Path, Job] = {}
    for job in (job for of_seed in itertools.zip_longest(*plan.values()) for job in of_seed if job is not None):
        if job.folder not in found or job.recorded is None:
            found[job.folder] = job
    return list(found.values())


def _other_hosts(plan: TablePlan) -> list[str]:
    """Return a notice for each host from which recorded runs and runs to be trained of one seed start."""
    found: dict[str, dict[int, set[bool]]] = {}
    for row in plan.table.rows:
        if not row.start:
            continue
        by_seed = found.setdefault(row.start, {})
        for job in plan.jobs[row.name]:
            if job.recorded is not None or not job.is_complete():
                by_seed.setdefault(job.seed, set()).add(job.recorded is not None)
    return [
        f"recorded runs of seed{'s' if len(mixed) > 1 else ''} {', '.join(map(str, mixed))} start from an earlier "
        f"training of {host}, the others from one of this machine, which may differ: without --from, all start from one"
        for host, by_seed in found.items()
        if (mixed := sorted(seed for seed, kinds in by_seed.items() if len(kinds) > 1))
    ]


def tell_work(plan: TablePlan, seeds: Sequence[int], store: Path, parallel: int, *, quick: bool = False) -> None:
    """Print how many runs are complete, how long the others take, and which exist with other thread settings.

    Args:
        plan: the trainings.
        seeds: of the plan.
        store: folder of its runs.
        parallel: trainings at a time.
        quick: few updates, for which there are no figures.
    """
    every, table = plan.every(), plan.table
    complete = sum(job.is_complete() for job in every)
    text = f"{table.name}, {table.title}: {counted(len(every), 'run')}, {complete} complete"
    if recorded := sum(job.recorded is not None for job in every):
        text += f" ({recorded} of them recorded)"
    if complete < len(every) and quick:
        text += "; the others compile, train a few updates and are measured in minutes"
    elif complete < len(every):
        seconds, guesses = remaining_seconds(plan.named(), plan.minutes())
        basis = f"{guesses} of the runs by the table's own figure" if guesses else "measured on this machine"
        text += f"; the updates of the others take about {_duration(seconds / parallel)} ({parallel} at a time; "
        text += f"{basis}), evaluation and compiling come on top"
    print(text, flush=True)
    for line in _other_hosts(plan):
        print(line, flush=True)

    def replan(threads: Mapping[str, Any]) -> list[Job]:
        return _planned(table, plan.rows, plan.hosts, seeds, store, threads).every()

    trained = [job for job in every if job.recorded is None]
    same = replan(trained[0].threads) if trained else []
    places = [i for i, job in enumerate(same) if job.folder in {job.folder for job in trained}]
    for line in runs_elsewhere([same[i] for i in places], store, lambda setting: [replan(setting)[i] for i in places]):
        print(line, flush=True)


def tell_unfinished(plan: TablePlan) -> list[Job]:
    """Print which runs are not complete, where only complete ones count, and return them."""
    every = plan.every()
    waiting = [job for job in every if not job.is_complete()]
    text = f"{plan.table.name}, {plan.table.title}: {len(every) - len(waiting)} of {len(every)} runs are finished"
    print(text + (f"; not yet: {'; '.join(job.label for job in waiting)}" if waiting else ""), flush=True)
    return waiting


def _duration(seconds: float) -> str:
    minutes = max(1, round(seconds / 60))
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
