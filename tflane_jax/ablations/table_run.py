"""Train, evaluate and test a table of a paper; every file that a reader wants is in the table's folder.

<out>/runs/KEY                    the runs, shared by all tables that have a row with this configuration
<out>/TABLE/declaration.json      claims and primary measure, written before the trainings
<out>/TABLE/table.md, .json, .tex scores of all rows and the paper's own numbers
<out>/TABLE/effects.md, .json     the claims: shown, not shown, or contradicted
<out>/TABLE/curves.png            validation over training, mean and range over seeds
<out>/TABLE/comparison.png        test frames in which the first claim's rows differ
<out>/TABLE/summary.json          what docs/results.md is made of
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tflane_jax.ablations.compare import (
    draw_models,
    evaluate_runs,
    first_models,
    save_plan,
    summary_of,
    without_failures,
)
from tflane_jax.ablations.comparison import Variant, compact
from tflane_jax.ablations.declaration import Declared, check, declare
from tflane_jax.ablations.effects import effects, findings, save_effects
from tflane_jax.ablations.jobs import Job, check_rows
from tflane_jax.ablations.paper.table import PaperTable
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.scores import CHECKPOINTS, OWN_TEST, measure
from tflane_jax.ablations.store import TOPOLOGY, remaining_seconds, stored_jobs
from tflane_jax.ablations.workers import train_all, worker_threads
from tflane_jax.accelerators import leave_to_workers
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json, write_text
from tflane_jax.plots.tables import format_table, latex_table, save_table
from tflane_jax.training.provenance import read_provenance
from tflane_jax.training.records import read_records

GEOMETRIC = ", geometric"
"""Suffix of a topology score's name: with the score of `evaluation.geometric_topology` added to the learned one."""


def run_table(table: PaperTable, seeds: Sequence[int], out: Path, *, jobs: int = 1, quick: bool = False) -> Path:
    """Train what is missing, evaluate, test the claims, and write the table's folder.

    The same command resumes a table that was stopped. Several processes, also of several machines that share the
    folder, may run the same table.

    Args:
        table: of the paper.
        seeds: of training.
        out: folder of all tables and their runs.
        jobs: trainings at a time.
        quick: few updates on few data, below `<out>/quick`: a smoke test, no result.

    Returns:
        The file of the table.

    Raises:
        UserError: trainings failed, after the files of the others were written.
    """
    began, root = time.monotonic(), out / "quick" if quick else out
    folder, (host_plan, plan) = root / table.name, plan_table(table, seeds, out, jobs=jobs, quick=quick)
    configs = table.configs(table.rows, quick=quick)
    # Fewer seeds than the table has are an interim look at it.
    declared = declare(table.declaration, plan, range(max(len(seeds), 0 if quick else table.seeds)), folder)
    _tell_work({**host_plan, **plan}, table, jobs)

    failures = train_all(_by_seed(host_plan), jobs)
    failures += train_all(_by_seed(plan), jobs)
    results, trained = Results(tuple(configs), tuple(seeds), {}), without_failures(plan, failures)
    failures += evaluate_runs(trained, results)
    _add_geometric(without_failures(plan, failures), results)
    save_plan(plan, failures, results, folder)
    if not results.scores:
        raise UserError(summary_of(failures, len(_by_seed(plan))))
    first = next(iter(configs.values()))
    path = _save_scores(table, results, folder, quick=quick)
    save_effects(results, declared, OWN_TEST, first.task.errors, folder / "effects")
    pair = (table.claims[0].control or table.rows[0].name, table.claims[0].treatment)
    draw_models(first, first_models(trained, results), pair, folder / "comparison.png")
    _draw_curves(table, trained, folder / "curves.png")
    _save_summary(table, declared, results, trained, first, folder, quick=quick)
    print(f"\n{table.name}: {folder} has tables, tests, curves and pictures ({time.monotonic() - began:.0f} s)")
    if failures:
        raise UserError(summary_of(failures, len(_by_seed(plan))))
    return path


def plan_table(
    table: PaperTable, seeds: Sequence[int], out: Path, *, jobs: int = 1, quick: bool = False
) -> tuple[dict[str, list[Job]], dict[str, list[Job]]]:
    """Return the trainings of the hosts that rows start from, and of the rows.

    Raises UserError where one of them must fail. The arguments are those of `run_table`.
    """
    leave_to_workers(jobs)
    configs, hosts = table.configs(table.rows, quick=quick), table.configs(table.hosts, quick=quick)
    check(table.declaration, configs)
    threads, store = worker_threads(jobs), (out / "quick" if quick else out) / "runs"
    host_plan = stored_jobs(hosts, seeds, store, threads=threads)
    origins = {row.name: host_plan[row.start] for row in table.rows if row.start}
    plan = stored_jobs(configs, seeds, store, threads=threads, origins=origins)
    check_rows({f"host {name}": jobs for name, jobs in host_plan.items()} | plan)
    return host_plan, plan


def _by_seed(plan: Mapping[str, Sequence[Job]]) -> list[Job]:
    """Return every run once, seed by seed, so that a table stopped early has pairs."""
    every = [job for of_seed in zip(*plan.values(), strict=True) for job in of_seed]
    return list({job.folder: job for job in every}.values())


def _tell_work(plan: Mapping[str, Sequence[Job]], table: PaperTable, jobs: int) -> None:
    """Print how many runs are complete, and how long the others will take."""
    every = _by_seed(plan)
    complete = sum(job.is_complete() for job in every)
    text = f"{table.name}, {table.title}: {len(every)} runs, {complete} complete"
    if complete < len(every):
        seconds, guesses = remaining_seconds(plan, table.minutes)
        basis = f"{guesses} of the runs by the table's own figure" if guesses else "measured on this machine"
        text += f"; the others take about {_duration(seconds / jobs)} ({jobs} at a time; {basis})"
    print(text, flush=True)


def _duration(seconds: float) -> str:
    minutes = max(1, round(seconds / 60))
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"


def _rows(table: PaperTable, results: Results) -> list[dict[str, Any]]:
    """Return the rows of the table: mean and spread of the scores, at the last and at the best checkpoint."""
    rows = []
    for which in CHECKPOINTS:
        for name, by_seed in results.rows(OWN_TEST, which).items():
            wanted = [score for column in table.columns for score in (column, column + GEOMETRIC)]
            columns = [score for score in wanted if all(score in scores for scores in by_seed.values())]
            (cells,) = compact([Variant(name, tuple(by_seed.values()))], columns)
            rows.append({"model": name, "checkpoint": which, "seeds": len(by_seed)} | cells)
    return rows


def _add_geometric(trained: Mapping[str, Sequence[Job]], results: Results) -> None:
    """Add to every row that predicts topology its score with the geometric topology, at the last checkpoint."""
    pairs = [(name, job) for name, jobs in trained.items() for job in jobs]
    for name, job in tqdm(pairs, desc="evaluate with geometric topology", unit="run"):
        scores = results.scores[OWN_TEST, "last"][name][job.config.training.seeds[0]]
        for evaluation in job.further:
            measured = measure(job, replace(job.config, evaluation=evaluation), "last")
            if measured is not None:
                for score in TOPOLOGY & scores.keys():
                    scores[score + GEOMETRIC] = measured.ways[""][score]


def _save_scores(table: PaperTable, results: Results, folder: Path, *, quick: bool) -> Path:
    """Print the table and the paper's own numbers, and save both as Markdown, JSON and LaTeX."""
    rows = _rows(table, results)
    title = f"{table.name}: {table.title}. {results.protocol}, test split, percent (mean ± std over seeds)"
    if quick:
        title = f"SMOKE TEST, a few updates on a few scenes: no result. {title}"
    meta = {"table": table.name, "protocol": results.protocol, "seeds": list(results.seeds), "quick": quick}
    path, _ = save_table(folder / "table", rows, meta | {"quoted": asdict(table.quoted)}, title=title)
    text, tex = path.read_text(encoding="utf-8"), latex_table(rows, caption=title)
    if table.note:
        text += f"\n{table.note}\n"
        tex += f"\n{table.note}\n"
    if table.quoted.rows:
        paper = f"The paper's own numbers, not comparable with these: {table.quoted.source}"
        text += "\n" + format_table(table.quoted.rows, title=paper) + "\n"
        tex += "\n" + latex_table(table.quoted.rows, caption=paper)
    write_text(path, text)
    write_text(folder / "table.tex", tex)
    print("\n" + text)
    return path


def _draw_curves(table: PaperTable, trained: Mapping[str, Sequence[Job]], path: Path) -> None:
    """Draw validation scores over training, one panel a score; nothing without matplotlib or evaluations."""
    if importlib.util.find_spec("matplotlib") is None:
        return
    from tflane_jax.plots.curves import save_comparison_curves

    records = {
        name: [read_records(job.folder / "metrics.jsonl") for job in jobs] for name, jobs in trained.items() if jobs
    }
    save_comparison_curves(path, records, list(dict.fromkeys((table.primary, *table.columns))))


def _save_summary(
    table: PaperTable,
    declared: Declared,
    results: Results,
    trained: Mapping[str, Sequence[Job]],
    first: RunConfig,
    folder: Path,
    *,
    quick: bool,
) -> None:
    """Write what docs/results.md is made of."""
    every = [
        e for which in CHECKPOINTS for e in effects(results, declared.declaration, OWN_TEST, which, first.task.errors)
    ]
    starts = [start for jobs in trained.values() for job in jobs for start in read_provenance(job.folder)]
    threads = [job.threads for jobs in trained.values() for job in jobs]
    write_json(
        folder / "summary.json",
        {
            "table": table.name,
            "title": table.title,
            "quick": quick,
            **({"steps factor": table.steps_factor} if table.steps_factor > 1 else {}),
            "protocol": results.protocol,
            "declared": declared.sentence(),
            "note": table.note,
            "seeds": list(results.seeds),
            "steps": sorted({job.config.training.steps for jobs in trained.values() for job in jobs}),
            "cores of a run": sorted({setting["cores"] for setting in threads}),
            "commits": sorted({start["git"]["commit"][:9] for start in starts if start.get("git")}),
            "devices": sorted({start["device"] for start in starts}),
            "core minutes of a run": _minutes(trained),
            "rows": _rows(table, results),
            "findings": findings(every),
            "quoted": asdict(table.quoted),
        },
    )


def _minutes(trained: Mapping[str, Sequence[Job]]) -> dict[str, float]:
    """Return the training time of each row, in minutes, mean over runs."""
    found = {}
    for name, jobs in trained.items():
        ends = [read_records(job.folder / "metrics.jsonl") for job in jobs]
        seconds = [[r["seconds"] for r in records if "seconds" in r][-1] for records in ends if records]
        if seconds:
            found[name] = round(sum(seconds) / len(seconds) / 60, 1)
    return found
