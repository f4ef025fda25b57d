"""`tflane tables`."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tflane_jax import accelerators
from tflane_jax.ablations.paper.cost import core_minutes
from tflane_jax.ablations.paper.table import Conversion, PaperTable
from tflane_jax.ablations.published import record, summaries
from tflane_jax.ablations.tables import TABLES, find_table
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder
from tflane_jax.plots.tables import format_table
from tflane_jax.progress import write
from tflane_jax.training.run_folder import is_locked
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Run the named tables, or list all; without names, --record writes the page of results anew.

    A table that fails does not stop the others; those that are complete are recorded. Each is written before the next
    one begins; with --together, all are trained first.
    """
    _check_together(options)
    parallel = _parallel(options)
    if options.names:
        tables = _chosen(options)
        _prepare(tables, options, parallel)
        if options.search:
            _search(tables, options, parallel)
        else:
            _train(tables, options, parallel)
    elif options.record is not None:
        _check_results(options.record)
        print("written:", record([], options.record))
    else:
        print(format_table([_listed(name) for name in TABLES], digits=0))
        print(f"\n{_totals()}")
    return 0


def _parallel(options: argparse.Namespace) -> int:
    """Return how many trainings run at a time; raises UserError if it or the cores of each are fewer than one."""
    parallel = (2 if options.quick else 1) if options.jobs is None else options.jobs
    if parallel < 1:
        raise UserError(f"--jobs {parallel}: at least one training runs at a time")
    if options.cores is not None and options.cores < 1:
        raise UserError(f"--cores {options.cores}: at least one")
    return parallel


def _chosen(options: argparse.Namespace) -> list[PaperTable]:
    """Return the named tables with as many updates as asked for; raises UserError for names that cannot be."""
    if options.steps_factor < 1:
        raise UserError(f"--steps-factor {options.steps_factor}: at least 1")
    if options.steps_factor > 1 and options.record is not None:
        raise UserError("--record keeps the tables as they are declared: leave out --steps-factor")
    if twice := [name for name in options.names if options.names.count(name) > 1]:
        raise UserError(f"{twice[0]} is named twice: once is enough")
    return [find_table(name).lengthened(options.steps_factor) for name in options.names]


def _check_results(folder: Path) -> None:
    """Raise UserError unless a folder holds results of tables."""
    if not folder.is_dir():
        raise UserError(f"--record {folder} is no folder of results, such as docs/results")
    if not any(folder.glob("*.json")):
        raise UserError(f"--record {folder} holds no results of tables (NAME.json): name docs/results")


def _prepare(tables: Sequence[PaperTable], options: argparse.Namespace, parallel: int) -> None:
    """Check the folders, set up JAX, and convert the published weights from which rows start."""
    check_folder(options.out)
    if options.record is not None:
        check_folder(options.record)
        if options.record.is_dir():
            summaries(options.record)  # a file of something else would end the command after the trainings
    configure_jax()
    if parallel > 1 or options.cores is not None:
        accelerators.leave_to_workers()  # before converting uses a device
    if not options.finished:
        for table in tables:
            _convert(table.conversions)


def _search(tables: Sequence[PaperTable], options: argparse.Namespace, parallel: int) -> None:
    """Search the learning rates of tables."""
    from tflane_jax.ablations.rate_search import plan_search, search_rates

    how: dict[str, Any] = {"parallel": parallel, "cores": options.cores, "quick": options.quick}
    for table in tables:  # errors of the last one come before the first one is trained
        plan_search(table, options.out, **how)
    for table in tables:
        search_rates(table, options.out, **how)


def _train(tables: Sequence[PaperTable], options: argparse.Namespace, parallel: int) -> None:
    """Train what is missing, write the tables and record them."""
    from tflane_jax.ablations.reuse import find_archives
    from tflane_jax.ablations.table_plan import plan_table
    from tflane_jax.ablations.table_run import begin_table, finish_table, train_tables

    how: dict[str, Any] = {
        "parallel": parallel,
        "cores": options.cores,
        "quick": options.quick,
        "finished": options.finished,
        "device": options.device,
        "scored_by": "any code" if options.earlier_scores else "this code",
    }
    seeds = {table.name: options.seeds or range(2 if options.quick else table.seeds) for table in tables}
    archives = {} if options.source is None else find_archives(options.source, [table.name for table in tables])
    if len(tables) > 1 and not options.finished:  # errors of the last one come before the first one is trained
        for table in tables:
            plan_table(table, seeds[table.name], options.out, archive=archives.get(table.name), **how)
    written: list[Path] = []
    failed: list[str] = []
    noted = partial(_noted, failed, last=tables[-1])
    groups = [tables] if options.together else [[table] for table in tables]
    for group in groups:
        begun = []
        for table in group:
            with noted(table):
                archive = archives.get(table.name)
                begun.append(begin_table(table, seeds[table.name], options.out, archive=archive, **how))
        failures = train_tables(begun, parallel, options.cores)
        for each in begun:
            with noted(each.table):
                written.append(finish_table(each, failures))
    if options.record is not None and written:
        print("written:", record([path.with_name("summary.json") for path in written], options.record))
    if failed:
        raise UserError("\n".join(failed))


@contextlib.contextmanager
def _noted(failed: list[str], table: PaperTable, *, last: PaperTable) -> Iterator[None]:
    """Add an error inside the block to those of the tables that failed; the others go on."""
    try:
        yield
    except UserError as error:
        failed.append(f"{table.name}: {error}")
        if table is not last:
            write(f"{failed[-1]}\nthe other tables go on")


def _convert(conversions: Sequence[Conversion]) -> None:
    """Make the runs of published weights that are not there yet."""
    from tflane_jax.commands.convert import convert

    for wanted in conversions:
        out = Path(wanted.out)
        if (out / "config.json").exists():
            continue
        try:
            convert(wanted.config, out, Path(wanted.weights), wanted.edge_weight)
        except UserError:
            if not _made_by_another(out):
                raise
        else:
            print(f"converted {wanted.weights} to {wanted.out}, from which rows start", flush=True)


def _made_by_another(out: Path) -> bool:
    """Return whether another process that runs the same table has made a run, after waiting for it."""
    while is_locked(out):
        time.sleep(1.0)
    return (out / "config.json").exists()


def _check_together(options: argparse.Namespace) -> None:
    """Raise UserError for options that do nothing together, or without the name of a table."""
    given = {
        "--seeds": options.seeds is not None,
        "--record": options.record is not None,
        "--from": options.source is not None,
        "--earlier-scores": options.earlier_scores,
        "--together": options.together,
        "--jobs": options.jobs is not None,
        "--cores": options.cores is not None,
        "--steps-factor": options.steps_factor != 1,
        "--quick": options.quick,
        "--search": options.search,
        "--finished": options.finished,
    }
    names = [name for name, is_given in given.items() if is_given]
    if not options.names and (idle := [name for name in names if name != "--record"]):
        raise UserError(f"{idle[0]} is about a table: name one (tflane tables lists all)")
    if options.quick and (idle := [name for name in names if name in ("--record", "--from")]):
        raise UserError(f"--quick runs are no results and never recorded: leave out {idle[0]} or --quick")
    if options.finished and (idle := [name for name in names if name in ("--jobs", "--cores")]):
        raise UserError(f"--finished trains nothing: leave out {idle[0]}")
    if options.device is not None and not options.finished:
        raise UserError("--device is about runs that exist: add --finished; trainings use the device that JAX finds")
    of_runs = ("--seeds", "--record", "--from", "--earlier-scores", "--finished", "--together")
    if options.search and (idle := [name for name in names if name in of_runs]):
        raise UserError(f"--search trains other runs than the table's, with its own seeds: leave out {idle[0]}")


def _listed(name: str) -> dict[str, str | int | float]:
    table = TABLES[name]
    return {
        "table": name,
        "shows": table.title,
        "rows": len(table.rows),
        "claims": len(table.claims),
        "seeds": table.seeds,
        "decided by": table.primary,
        "one core": f"{core_minutes([table]) / 60:.0f} h",
    }


def _totals() -> str:
    """Return what the tables of each paper cost together, in words."""
    systems: dict[str, list[PaperTable]] = {}
    for table in TABLES.values():
        systems.setdefault(table.name.split(".")[0], []).append(table)
    hours = {name: f"{core_minutes(tables) / 60:.0f} h" for name, tables in systems.items()}
    listed = ", ".join(f"{name} {cost}" for name, cost in hours.items())
    return (
        f"In one --out, runs that tables share are trained once. Together on one core: {listed}; all "
        f"{core_minutes(TABLES.values()) / 60:.0f} h. Updates alone: evaluation and compiling come on top."
    )
