"""One learning rate for each row of a table, by the same small search: `tflane tables NAME --search`.

Rows are trained with each rate and seeds that the table does not have, and judged on validation data. The rates
found are written into the table by hand, so that its runs do not depend on files.

<out>/runs/KEY            the runs
<out>/TABLE/rates.md, .json   validation score of each row and rate (mean over seeds), and which rate is taken
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from tflane_jax.ablations.finished_runs import summary_of
from tflane_jax.ablations.jobs import Job, check_rows
from tflane_jax.ablations.paper.table import PaperTable, RateSearch
from tflane_jax.ablations.store import stored_jobs
from tflane_jax.ablations.table_plan import seed_by_seed
from tflane_jax.ablations.workers import train_all, worker_threads
from tflane_jax.errors import UserError
from tflane_jax.files.wording import counted
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.training.records import read_records

AT_THE_EDGE = "at the edge of the grid: a wider search may find a better one"


def search_rates(
    table: PaperTable, out: Path, *, parallel: int = 1, cores: int | None = None, quick: bool = False
) -> Path:
    """Train what is missing, and write and print the score of every rate; the same command resumes a search.

    Args:
        table: with a search.
        out: folder of all tables and their runs.
        parallel: trainings at a time.
        cores: of each training; None for equal shares of all.
        quick: few updates on few data, below `<out>/quick`: a smoke test, no result.

    Returns:
        The file with the scores.

    Raises:
        UserError: the table has no search, or no rate of a row could be trained.
    """
    plan = plan_search(table, out, parallel=parallel, cores=cores, quick=quick)
    assert table.search is not None
    by_name = {f"{row}, {rate}": runs for row, by_rate in plan.items() for rate, runs in by_rate.items()}
    every = seed_by_seed(by_name)
    print(f"{table.name}: {counted(len(every), 'training')} for the learning rates of {len(plan)} rows", flush=True)
    failures = train_all(every, parallel, cores)
    rows = rated(table.search, plan)
    folder = (out / "quick" if quick else out) / table.name
    title = (
        f"{table.name}: {table.search.score} on validation data at the last step, by learning rate "
        f"({_seeds(table.search.seeds)}{'; SMOKE TEST, no result' if quick else ''})"
    )
    path, _ = save_table(folder / "rates", rows, {"table": table.name, "search": asdict(table.search)}, title=title)
    print("\n" + format_table(rows, title=title) + f"\n\nwritten to {path}: copy the rates into the table's rows")
    if without := [row["row"] for row in rows if row["taken"] is None]:
        raise UserError(f"no rate of {', '.join(without)} could be trained; {summary_of(failures, len(every))}")
    return path


def plan_search(
    table: PaperTable, out: Path, *, parallel: int = 1, cores: int | None = None, quick: bool = False
) -> dict[str, dict[float, list[Job]]]:
    """Return the trainings of each row of the search and each rate, one for each seed.

    Raises UserError where one of them must fail. The arguments are those of `search_rates`.
    """
    if table.search is None:
        raise UserError(f"table {table.name} has no search for learning rates: leave --search out")
    store, threads = (out / "quick" if quick else out) / "runs", worker_threads(parallel, cores)
    chosen = [row for row in table.rows if row.name in table.search.rows]
    plan: dict[str, dict[float, list[Job]]] = {}
    for name, config in table.configs(chosen, quick=quick).items():
        by_rate = {rate: replace(config, optim=replace(config.optim, lr=rate)) for rate in table.search.rates}
        labelled = {f"{name}, rate {rate:g}": each for rate, each in by_rate.items()}
        planned = stored_jobs(labelled, table.search.seeds, store, threads=threads)
        check_rows(planned)
        plan[name] = dict(zip(by_rate, planned.values(), strict=True))
    return plan


def rated(search: RateSearch, plan: Mapping[str, Mapping[float, Sequence[Job]]]) -> list[dict[str, Any]]:
    """Return for each row the score of each rate, the rate with the highest one, and a remark.

    Scores are means over seeds, None for a rate of which a training failed. The remark says where the rate taken is the
    smallest or largest of the grid.
    """
    rows = []
    for name, by_rate in plan.items():
        scores = {rate: _mean(_last_score(job, search.score) for job in jobs) for rate, jobs in by_rate.items()}
        known = {rate: score for rate, score in scores.items() if score is not None}
        taken = max(known, key=lambda rate: known[rate], default=None)
        cells = {f"{rate:g}": score for rate, score in scores.items()}
        remark = AT_THE_EDGE if taken in (min(search.rates), max(search.rates)) else ""
        rows.append({"row": name} | cells | {"taken": None if taken is None else f"{taken:g}", "remark": remark})
    return rows


def _mean(scores: Iterable[float | None]) -> float | None:
    """Return the mean of scores; None where one is missing."""
    known = list(scores)
    return None if None in known else fmean(score for score in known if score is not None)


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"mean of seeds {', '.join(map(str, seeds))}"


def _last_score(job: Job, name: str) -> float | None:
    """Return the validation score of a complete run at its last step; None for a run that failed or diverged."""
    if not job.is_complete():
        return None
    found: Sequence[Mapping[str, Any]] = [
        record for record in read_records(job.folder / "metrics.jsonl") if record.get("split") == "val"
    ]
    last = [record for record in found if record["step"] == job.config.training.steps]
    if not last or name not in last[-1]:
        raise UserError(f"{job.folder} has no validation score {name} of its last step, by which the search decides")
    score = last[-1][name]
    score = float(score[0] if isinstance(score, list) else score)
    return score if math.isfinite(score) else None
