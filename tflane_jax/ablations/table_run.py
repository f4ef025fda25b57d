"""Train, evaluate and test a table of a paper; every file that a reader wants is in the table's folder.

<out>/runs/KEY                    the runs, shared by all tables that have a row with this configuration
<out>/TABLE/declaration.json      claims and primary measure, written before the trainings
<out>/TABLE/table.md, .json, .tex scores of all rows and the paper's own numbers
<out>/TABLE/effects.md, .json     the claims: shown, not shown, or contradicted
<out>/TABLE/curves.png            validation over training, mean and range over seeds
<out>/TABLE/comparison.png        test frames in which the first claim's rows differ
<out>/TABLE/scores.json.gz        the record of the runs' scores, written anew after each of them: the table can be made
                                  from it, as `--from <out>` does, without the runs
<out>/TABLE/summary.json          what docs/results.md is made of
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.archive import Archive
from tflane_jax.ablations.comparison import compact
from tflane_jax.ablations.declaration import FILE as DECLARATION
from tflane_jax.ablations.declaration import Declared, declare
from tflane_jax.ablations.effect_records import effect_records
from tflane_jax.ablations.effects import Tested, judged_claims
from tflane_jax.ablations.facts import facts, mixed_hosts, row_minutes
from tflane_jax.ablations.findings import findings, save_effects
from tflane_jax.ablations.finished_runs import (
    commits,
    draw_models,
    evaluate_and_note,
    first_models,
    measured_elsewhere,
    save_plan,
    summary_of,
)
from tflane_jax.ablations.jobs import Failure, Job, ScoredBy
from tflane_jax.ablations.paper.table import PaperTable
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.reuse import FILE, InterimRecord, add_to_record, archive_of, unused
from tflane_jax.ablations.scores import CHECKPOINTS, OWN_TEST, measure
from tflane_jax.ablations.store import TOPOLOGY
from tflane_jax.ablations.table_plan import (
    TablePlan,
    plan_table,
    seed_by_seed,
    store_of,
    tell_unfinished,
    tell_work,
    with_seeds,
)
from tflane_jax.ablations.workers import train_all, worker_threads
from tflane_jax.datasets.sources import source_of
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json, write_text
from tflane_jax.files.fields import load_json
from tflane_jax.plots.curves import save_comparison_curves
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.tables import PERCENT, format_table, latex_table, latex_text, save_table
from tflane_jax.progress import progress_bar

GEOMETRIC = ", geometric"
"""Suffix of a topology score's name: with the score of `evaluation.geometric_topology` added to the learned one."""


@dataclass(frozen=True)
class TableRun:
    """A table that is planned and declared, whose runs are to be trained and evaluated.

    Attributes:
        table: of the paper.
        planned: its trainings.
        folder: of the table.
        declared: what is tested.
        interim: record of the runs that are finished; None where nothing is trained.
        began: when, seconds of the monotonic clock.
        quick: see `begin_table`.
    """

    table: PaperTable
    planned: TablePlan
    folder: Path
    declared: Declared
    interim: InterimRecord | None
    began: float
    quick: bool


def run_table(
    table: PaperTable, seeds: Sequence[int], out: Path, *, parallel: int = 1, cores: int | None = None, **how: Any
) -> Path:
    """Train what is missing, evaluate, test the claims, and write the table's folder.

    The same command resumes a table that was stopped. Several processes, also of several machines that share the
    folder, may run the same table. The arguments are those of `begin_table`.

    Returns:
        The file of the table.

    Raises:
        UserError: trainings failed, after the files of the others were written; with `finished`, no run is.
    """
    run = begin_table(table, seeds, out, parallel=parallel, cores=cores, **how)
    return finish_table(run, train_tables([run], parallel, cores))


def begin_table(
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
) -> TableRun:
    """Plan the trainings of a table, declare what is tested, and print what there is to do.

    Args:
        table: of the paper.
        seeds: of training.
        out: folder of all tables and their runs.
        parallel: trainings at a time.
        cores: of each training; None shares all between the trainings.
        quick: few updates on few data, below `<out>/quick`: a smoke test, no result.
        finished: train nothing; the table is of the runs that are complete, with any number of cores and on any one
            device.
        device: with `finished`, the kind of device whose runs are taken, "cpu" or "gpu"; None for the one that tests
            the most.
        archive: recorded runs, which are taken instead of trained; None for none.
        scored_by: state of the code whose scores count where they are kept beside a run, see `Job`.

    Raises UserError for a table that must fail.
    """
    began, folder, interim = time.monotonic(), store_of(out, quick=quick).parent / table.name, None
    how: dict[str, Any] = {"quick": quick, "finished": finished, "device": device}
    how |= {"archive": archive, "scored_by": scored_by}
    planned = plan_table(table, seeds, out, parallel=parallel, cores=cores, **how)
    plan = planned.jobs
    # Fewer seeds than the table has are an interim look at it.
    every = sorted({*seeds, *range(0 if quick else table.seeds)})
    # Runs of declared seeds that this command leaves out may have begun, too.
    of_all = with_seeds(planned, every, store_of(out, quick=quick), worker_threads(parallel, cores))

    def declared_in(place: Path) -> Declared:
        return declare(table.declaration, of_all, planned.declared(), every, place)

    if archive is not None:
        _adopt_declaration(archive, folder, declared_in)
        for line in unused(plan, archive, table.declaration.scores):
            print(line)
    try:
        declared = declared_in(folder)
    except UserError:
        if not quick:
            raise
        (folder / DECLARATION).unlink()  # that of an earlier smoke test, which was no result
        declared = declared_in(folder)
    if not finished:
        tell_work(planned, planned.seeds(), store_of(out, quick=quick), parallel, quick=quick)
        content, tested = load_json(folder / DECLARATION), table.declaration.scores
        interim = InterimRecord(folder / FILE, table.name, content, plan, tested, _curves(table))
    return TableRun(table, planned, folder, declared, interim, began, quick)


def train_tables(runs: Sequence[TableRun], parallel: int = 1, cores: int | None = None) -> list[Failure]:
    """Train what is missing of some tables together, so that no worker waits for another table; return what failed.

    Args:
        runs: the tables.
        parallel, cores: see `begin_table`.
    """
    records = [run.interim for run in runs if run.interim is not None]
    plans = {run.table.name: run.planned.named() for run in runs if run.interim is not None}
    every = {f"{table}: {row}": of_row for table, plan in plans.items() for row, of_row in plan.items()}

    def record(job: Job) -> None:
        for one in records:
            one.add(job)

    return train_all(seed_by_seed(every), parallel, cores, record) if every else []


def finish_table(run: TableRun, failures: Sequence[Failure]) -> Path:
    """Evaluate the runs of a table, test the claims, and write the table's folder.

    Args:
        run: the table.
        failures: trainings that failed, also those of other tables.

    Returns:
        The file of the table.

    Raises UserError like `run_table`.
    """
    table, planned, folder, quick = run.table, run.planned, run.folder, run.quick
    configs, plan = planned.rows, planned.jobs
    results, own = Results(tuple(configs), tuple(planned.seeds()), {}), {job.folder for job in planned.every()}
    unfinished = [Failure(job, "not finished") for job in tell_unfinished(planned)] if run.interim is None else []
    known = unfinished or [failure for failure in failures if failure.job.folder in own]
    trained, failures = evaluate_and_note(plan, known, results)
    _add_geometric(trained, results)
    save_plan(plan, failures, results, folder)
    if not results.scores:
        raise UserError(summary_of(failures, len(planned.every())))
    scores = archive_of(table.name, load_json(folder / DECLARATION), trained, table.declaration.scores, _curves(table))
    add_to_record(folder / FILE, scores)
    first = next(iter(configs.values()))
    path = _save_scores(table, results, folder, quick=quick)
    tested = judged_claims(results, run.declared.declaration, OWN_TEST, first.task.errors)
    no_drives = source_of(first.data.source("test")).no_drives
    save_effects(results, run.declared, OWN_TEST, tested, folder / "effects", no_drives=no_drives)
    pair = (table.claims[0].control or table.rows[0].name, table.claims[0].treatment)
    models = first_models(trained, results)
    if can_draw():
        if {results.owners.get(row, row) for row in pair} <= models.keys():  # recorded runs have no parameters
            draw_models(first, models, pair, folder / "comparison.png")
        _draw_curves(table, trained, folder / "curves.png")
    _save_summary(table, run.declared, results, trained, tested, folder, quick=quick)
    print(f"\n{table.name}: {folder} has tables, tests, curves and pictures ({time.monotonic() - run.began:.0f} s)")
    if failed := [failure for failure in failures if failure not in unfinished]:
        raise UserError(summary_of(failed, len(planned.every())))
    return path


def _adopt_declaration(archive: Archive, folder: Path, check_in: Callable[[Path], Declared]) -> None:
    """Let a table that was recorded keep its declaration, unless it is another one or the folder's is the earlier.

    Args:
        archive: of the table.
        folder: of the table.
        check_in: declares the table in a folder; raises UserError if that holds another declaration.
    """
    if archive.declaration is None:
        return
    own = folder / DECLARATION
    with tempfile.TemporaryDirectory() as trial:
        write_json(Path(trial) / DECLARATION, archive.declaration)
        try:
            recorded = check_in(Path(trial))
        except UserError:
            if not own.exists():
                print("the recorded declaration is another one, so that the table is declared anew")
            return
    if not own.exists() or recorded.time < check_in(folder).time:
        write_json(own, archive.declaration)


def _rows(table: PaperTable, results: Results) -> list[dict[str, Any]]:
    """Return the rows of the table: mean and spread of the scores, at the last and at the best checkpoint."""
    rows = []
    for which in CHECKPOINTS:
        for name, by_seed in results.rows(OWN_TEST, which).items():
            wanted = [score for column in table.columns for score in (column, column + GEOMETRIC)]
            columns = [score for score in wanted if all(score in scores for scores in by_seed.values())]
            (cells,) = compact({name: by_seed.values()}, columns)
            rows.append({"model": name, "checkpoint": which, "seeds": len(by_seed)} | cells)
    return rows


def _add_geometric(trained: Mapping[str, Sequence[Job]], results: Results) -> None:
    """Add to every row that predicts topology its score with the geometric topology, at the last checkpoint."""
    pairs = [(name, job) for name, jobs in trained.items() for job in jobs]
    for name, job in progress_bar(pairs, desc="evaluate with geometric topology", unit="run"):
        scores = results.scores[OWN_TEST, "last"][name][job.seed]
        for evaluation in job.further:
            measured = measure(job, replace(job.config, evaluation=evaluation), "last")
            if measured is not None:
                found = measured.ways[""]  # earlier records have none of v1.0, which were wrong
                for score in TOPOLOGY & scores.keys() & found.keys():
                    scores[score + GEOMETRIC] = found[score]


def _save_scores(table: PaperTable, results: Results, folder: Path, *, quick: bool) -> Path:
    """Print the table and the paper's own numbers, and save both as Markdown, JSON and LaTeX."""
    rows = _rows(table, results)
    title = f"{table.name}: {table.title}. {results.protocol()}, test split, percent (mean ± std over seeds)"
    if quick:
        title = f"SMOKE TEST, a few updates on a few scenes: no result. {title}"
    meta = {"table": table.name, "protocol": results.protocol(), "seeds": list(results.seeds), "quick": quick}
    path, _ = save_table(folder / "table", rows, meta | {"quoted": asdict(table.quoted), "unit": PERCENT}, title=title)
    text, tex = path.read_text(encoding="utf-8"), latex_table(rows, caption=title)
    if table.note:
        text += f"\n{table.note}\n"
        tex += f"\n{latex_text(table.note)}\n"
    if table.quoted.rows:
        paper = f"The paper's own numbers, not comparable with these: {table.quoted.source}"
        text += "\n" + format_table(table.quoted.rows, title=paper) + "\n"
        tex += "\n" + latex_table(table.quoted.rows, caption=paper)
    write_text(path, text)
    write_text(folder / "table.tex", tex)
    print("\n" + text)
    return path


def _draw_curves(table: PaperTable, trained: Mapping[str, Sequence[Job]], path: Path) -> None:
    """Draw validation scores over training, one panel a score; nothing without evaluations."""
    records = {name: [facts(job).validation for job in jobs] for name, jobs in trained.items() if jobs}
    save_comparison_curves(path, records, _curves(table))


def _curves(table: PaperTable) -> list[str]:
    """Return the scores whose validation curves are drawn."""
    return list(dict.fromkeys((table.primary, *table.columns)))


def _save_summary(
    table: PaperTable,
    declared: Declared,
    results: Results,
    trained: Mapping[str, Sequence[Job]],
    tested: Tested,
    folder: Path,
    *,
    quick: bool,
) -> None:
    """Write what docs/results.md is made of."""
    runs = [job for jobs in trained.values() for job in jobs]
    write_json(
        folder / "summary.json",
        {
            "table": table.name,
            "title": table.title,
            "quick": quick,
            **({"steps factor": table.steps_factor} if table.steps_factor > 1 else {}),
            "protocol": results.protocol(),
            "declared": declared.sentence(),
            "runs begun": declared.begun,
            "note": table.note,
            "models": list(results.models),
            "seeds": list(results.seeds),
            "declared seeds": len(declared.seeds),
            "steps": {name: jobs[0].config.training.steps for name, jobs in trained.items() if jobs},
            "cores of a run": sorted({job.threads["cores"] for job in runs}),
            "commits": [*commits(runs), *measured_elsewhere(runs)],
            "mixed hosts": mixed_hosts(table.rows, trained),
            "devices": sorted({device for job in runs for device in facts(job).devices}),
            "core minutes of a run": row_minutes(trained),
            "rows": _rows(table, results),
            "findings": findings(tested),
            "effects": effect_records(tested),
            "quoted": asdict(table.quoted),
        },
    )
