"""Recorded runs (`ablations.archive`) that replace trainings, and the record of a table's own runs.

A recorded run replaces a training with the same configuration, seed and thread setting. If none has the thread setting
of this process, one with another setting does, because a table is made from what was trained, wherever that was. A run
that another table recorded is used only if this table has no record of it and this machine has not trained it. Where
the rows of a seed start from one host, and that was trained more than once, runs from the training that most rows have
come before all others. Runs of a CPU and of an accelerator do not meet in a table, see `with_recorded`.
"""

from __future__ import annotations

import datetime
import itertools
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.archive import Archive, merged, read_archive, write_archive
from tflane_jax.ablations.declaration import Claim, Declaration, model_of_row
from tflane_jax.ablations.facts import facts, given_hashes
from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.recorded import Measured, RecordedRun, evaluation_name
from tflane_jax.ablations.scores import evaluations, is_measured, measure
from tflane_jax.config_io import first_difference, to_json
from tflane_jax.errors import UserError
from tflane_jax.files.locks import take
from tflane_jax.runs import current_form

FILE = "scores.json.gz"
"""Name of the record in a table's folder."""

_FOLDER, _SUFFIX = "scores", ".json.gz"

Plan = Mapping[str, Sequence[Job]]


def archive_path(folder: Path, table: str) -> Path:
    """Return the file of a table in a folder of results."""
    return folder / _FOLDER / f"{table}{_SUFFIX}"


def find_archives(folder: Path, tables: Collection[str]) -> dict[str, Archive]:
    """Return the record of each table in a folder of results or of tables; an empty one, with a message, for none.

    Raises UserError if there is no such folder, or a record in it is damaged or of another table.
    """
    if not folder.is_dir():
        raise UserError(
            f"--from {folder} is no folder: give that of results, such as docs/results, or of tables (--out)"
        )
    every: dict[str, Archive] = {}
    for path in (*sorted(folder.glob(f"*/{FILE}")), *sorted((folder / _FOLDER).glob(f"*{_SUFFIX}"))):
        archive = read_archive(path)
        if path not in (archive_path(folder, archive.table), folder / archive.table / FILE):
            raise UserError(f"{path} is the record of {archive.table}")
        every[archive.table] = archive
    runs = {key: run for archive in every.values() for key, run in archive.runs.items()}
    found = {}
    for table in tables:
        if table not in every:
            print(f"{archive_path(folder, table)} does not exist: no run of {table} is recorded there")
        own = every.get(table, Archive(table, None, {}))
        found[table] = replace(own, shared={key: run for key, run in runs.items() if key not in own.runs})
    return found


def thread_settings(archive: Archive, own: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the thread settings that a run may have: that of this process, then those in the record."""
    found: list[Mapping[str, Any]] = [own]
    for run in (*archive.runs.values(), *archive.shared.values()):
        if run.threads not in found:
            found.append(run.threads)
    return found


def with_recorded(
    plans: Sequence[Plan],
    archive: Archive,
    declaration: Declaration,
    *,
    finished: bool = False,
    device: str | None = None,
) -> dict[str, list[Job]]:
    """Return the first plan with recorded runs in the place of trainings.

    Recorded runs of another device than that of this process are taken only if no training and no run of a third
    device remains.

    Args:
        plans: the same trainings with different thread settings, that of this process first.
        archive: what is recorded.
        declaration: what the table tests; a recorded run that lacks one of its scores is trained.
        finished: nothing is going to be trained, so that complete runs of any thread setting are taken; of several
            devices, those of the one that tests the most: with the most pairs of runs for the claims, then the most
            runs.
        device: with `finished`, the kind of device ("cpu", "gpu") whose runs are taken; None for that choice.

    Raises UserError where no run of that kind of device is known.
    """

    def candidates(same: Sequence[Job]) -> Iterator[Job]:
        def recorded(runs: Mapping[str, RecordedRun]) -> Iterator[Job]:
            for job in same:
                run = runs.get(job.folder.name)
                if run is not None and not _why_not(run, job, declaration.scores):
                    yield replace(job, recorded=run)

        # A run at hand can be measured for this table; what another one recorded has the parts by scene of its scores.
        at_hand = (job for job in (same if finished else same[:1]) if job.is_complete())
        return itertools.chain(recorded(archive.runs), at_hand, recorded(archive.shared), same)

    def chosen(allowed: Sequence[Plan]) -> dict[str, list[Job]]:
        return _from_one_host(
            {
                name: [list(candidates([plan[name][i] for plan in allowed])) for i in range(len(jobs))]
                for name, jobs in plans[0].items()
            }
        )

    by_device: dict[Any, list[Plan]] = {}
    for plan in plans:
        by_device.setdefault(_device(next(iter(plan.values()))[0]), []).append(plan)
    if finished:
        wanted = [same for same in by_device.values() if device in (None, _kind(next(iter(same[0].values()))[0]))]
        if not wanted:
            raise UserError(f"no run of {archive.table} on a {device} is known: leave --device out, or name its record")
        return max(map(chosen, wanted), key=lambda found: _tested(found, declaration.claims))
    found = chosen(plans)
    if len({_device(job) for jobs in found.values() for job in jobs}) == 1:
        return found
    of_this_process, *_ = by_device.values()  # its plans come first
    return chosen(of_this_process)


def _from_one_host(candidates: Mapping[str, Sequence[Sequence[Job]]]) -> dict[str, list[Job]]:
    """Return the run that each row takes: one from the training of its host that most rows have, else the first.

    Rows of one host and seed name the same folder in `training.init_from`; from which training of it a run started,
    `Facts.origins` tells. Of two trainings that as many rows have, the one that is met first counts. A row that is the
    host itself takes that training too, where it is known.

    Args:
        candidates: for each row and seed the runs that can be taken, best first, at least one.
    """

    def origins(job: Job) -> tuple[str, ...]:
        return facts(job).origins if job.is_complete() else ()

    counts: dict[str, Counter[tuple[str, ...]]] = {}
    for each in itertools.chain.from_iterable(candidates.values()):
        if host := _host(each):
            known = dict.fromkeys(origins(job) for job in each)  # each once, in their order
            counts.setdefault(host, Counter()).update([one for one in known if one])
    most = {host: count.most_common(1)[0][0] for host, count in counts.items() if count}

    def best(each: Sequence[Job]) -> Job:
        if wanted := most.get(_host(each)):
            return next((job for job in each if origins(job) == wanted), each[0])
        if given := most.get(str(each[-1].folder)):
            return next((job for job in each if job.is_complete() and set(given) & set(given_hashes(job))), each[0])
        return each[0]

    return {name: [best(each) for each in of_row] for name, of_row in candidates.items()}


def _host(same: Sequence[Job]) -> str:
    """Return the folder of the host from which a run would start if it was trained now; "" for no host."""
    return same[-1].config.training.init_from or ""


def _tested(plan: Plan, claims: Sequence[Claim]) -> tuple[int, int]:
    """Return how many pairs of runs test a claim, and how many runs there are; of complete ones."""
    complete = {name: [job.is_complete() for job in jobs] for name, jobs in plan.items()}
    pairs = 0
    for claim in claims:
        rows = {model_of_row(row, complete) for row in (claim.treatment, claim.control) if row is not None}
        pairs += sum(all(of_seed) for of_seed in zip(*(complete[row] for row in rows), strict=True))
    return pairs, sum(map(sum, complete.values()))


def _kind(job: Job) -> str:
    """Return the kind of device of a training: "cpu", "gpu", ..."""
    return str(_device(job) or "cpu").partition(":")[0]


def _device(job: Job) -> Any:
    """Return the accelerator of a training; None for a CPU."""
    return job.threads.get("device")


def unused(plan: Plan, archive: Archive, scores: Collection[str]) -> list[str]:
    """Return a line for each training of a plan of which the record has another run, with the first difference."""
    by_name = {(run.row, run.seed): run for run in archive.runs.values()}
    lines = []
    for name, jobs in plan.items():
        for job in jobs:
            seed = job.seed
            run = archive.runs.get(job.folder.name) or by_name.get((name, seed))
            if job.recorded is None and run is not None:
                reason = _why_not(run, job, scores) or "runs of different devices do not meet in a table"
                lines.append(f"the recorded run of {name}, seed {seed}, is not used: {reason}")
    return lines


def _why_not(run: RecordedRun, job: Job, scores: Collection[str]) -> str:
    """Return why a recorded run cannot have the place of a training; "" if it can."""
    try:
        saved, _ = current_form(dict(run.config))
    except UserError as error:
        return str(error)
    if difference := first_difference(saved, portable(job)):
        return difference
    names = [evaluation_name(which, config.evaluation, job.config.evaluation) for config, which in evaluations(job)]
    if lacking := [name for name in names if name not in run.measured]:
        return f"it was not measured by: {lacking[0]}"
    # Without a best checkpoint there is None; the last one is always measured.
    if any(run.measured[name] is None for name in names if name != "best"):
        return "it has no scores of its last checkpoint"
    every = [scores for measured in run.measured.values() if measured for scores in measured.ways.values()]
    lacking = [score for score in scores if not all(score in of_way for of_way in every)]
    return f"it has no {lacking[0]}" if lacking else ""


def portable(job: Job) -> dict[str, Any]:
    """Return the configuration of a stored run as JSON; a run that it starts from is named by its key."""
    config, start = job.config, job.config.training.init_from
    if start is not None and Path(start).parent == job.folder.parent:
        config = replace(config, training=replace(config.training, init_from=Path(start).name))
    return to_json(config)


def archive_of(
    table: str, declaration: Mapping[str, Any], trained: Plan, scores: Collection[str], curves: Collection[str]
) -> Archive:
    """Return the record of finished runs, which are measured if they are not yet.

    Args:
        table: name.
        declaration: content of the file in which the comparison was declared.
        trained: the runs, by row.
        scores: that are tested; only their parts by scene are kept.
        curves: scores of the validation split that are kept.
    """
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    runs: dict[str, RecordedRun] = {}
    for name, jobs in trained.items():
        for job in jobs:
            key = job.folder.name
            if key not in runs:
                kept = None if job.recorded is None else replace(job.recorded, row=name)
                runs[key] = kept or _recorded(key, name, job, scores, curves, now)
    return Archive(table, declaration, runs)


class InterimRecord:
    """The record of a table while it is trained: its file is written anew after each run.

    Whatever ends the machine, the small file holds all runs that had finished, with their scores. Another machine
    takes them by `--from`. What the file held before, such as other seeds or runs of another process, stays.

    Args:
        path: of the file.
        table, declaration, scores, curves: see `archive_of`.
        plan: trainings of each row; those that are complete and measured enter at once.

    Raises UserError for a file that is there and damaged.
    """

    def __init__(
        self,
        path: Path,
        table: str,
        declaration: Mapping[str, Any],
        plan: Plan,
        scores: Collection[str],
        curves: Collection[str],
    ) -> None:
        self._path, self._table, self._declaration = path, table, declaration
        _recorded_before(path)  # raises before the trainings if the file is damaged
        self._kept = scores, curves
        # Of equal rows, the first names the run, as in `archive_of`.
        self._rows = {job.folder: name for name, jobs in reversed([*plan.items()]) for job in jobs}
        known = {name: [job for job in jobs if is_measured(job)] for name, jobs in plan.items()}
        self._runs = archive_of(table, declaration, known, scores, curves).runs

    def add(self, job: Job) -> None:
        """Add a finished run, unless it is a host, which is in no row.

        Raises OSError or UserError if the file cannot be written, or what was there cannot be read.
        """
        if (row := self._rows.get(job.folder)) is None:
            return
        (run,) = archive_of(self._table, self._declaration, {row: [job]}, *self._kept).runs.values()
        self._runs = {**self._runs, run.key: run}
        add_to_record(self._path, Archive(self._table, self._declaration, self._runs))


def add_to_record(path: Path, archive: Archive) -> None:
    """Add runs to those of a file, which need not exist; several processes may do so at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f"{path.name}.lock").open("w") as lock:
        take(lock, wait=True)
        there = _recorded_before(path)
        write_archive(path, archive if there is None else merged(there, archive))


def _recorded_before(path: Path) -> Archive | None:
    return read_archive(path) if path.exists() else None


def _recorded(key: str, row: str, job: Job, scores: Collection[str], curves: Collection[str], now: str) -> RecordedRun:
    own, found = facts(job), {}
    for config, which in evaluations(job):
        measured = measure(job, config, which)
        name = evaluation_name(which, config.evaluation, job.config.evaluation)
        found[name] = None if measured is None else _of_scores(measured, scores)
    wanted = ("step", "split", *curves)
    validation = tuple({n: record[n] for n in wanted if n in record} for record in own.validation)
    return RecordedRun(
        key=key,
        row=row,
        seed=job.seed,
        config=portable(job),
        threads=dict(job.threads),
        # Runs that start from another one are no hosts.
        facts=replace(own, validation=validation, gives=() if own.origins else given_hashes(job)),
        measured=found,
        time=now,
    )


def _of_scores(measured: Measured, scores: Collection[str]) -> Measured:
    """Return what was measured with the parts by scene of some scores alone."""
    ratios, samples = (
        {way: {name: part for name, part in of_way.items() if name in scores} for way, of_way in parts.items()}
        for parts in (measured.ratios, measured.samples)
    )
    return replace(measured, ratios=ratios, samples=samples)
