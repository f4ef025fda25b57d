"""`tflane tables`."""

from __future__ import annotations

import argparse

from tflane_jax.ablations.published import record
from tflane_jax.ablations.tables import TABLES, find_table
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Run the named tables, or list all."""
    chosen = [find_table(name) for name in options.names]
    if options.seeds is not None and options.seeds < 1:
        raise UserError(f"--seeds {options.seeds}: at least one")
    jobs = (2 if options.quick else 1) if options.jobs is None else options.jobs
    if jobs < 1:
        raise UserError(f"--jobs {jobs}: at least one training runs at a time")
    if not chosen:
        print(format_table([_listed(name) for name in TABLES], digits=0))
        return 0
    configure_jax()
    if options.search:
        from tflane_jax.ablations.rate_search import search_rates

        for table in chosen:
            search_rates(table, options.out, jobs=jobs, quick=options.quick)
        return 0
    from tflane_jax.ablations.table_run import plan_table, run_table

    seeds = {table.name: range(options.seeds or (2 if options.quick else table.seeds)) for table in chosen}
    if len(chosen) > 1:  # what is wrong in the last one is told before the first one is trained
        for table in chosen:
            plan_table(table, seeds[table.name], options.out, jobs=jobs, quick=options.quick)
    written = [run_table(t, seeds[t.name], options.out, jobs=jobs, quick=options.quick) for t in chosen]
    if options.record is not None:
        print("written:", record([path.with_name("summary.json") for path in written], options.record))
    return 0


def _listed(name: str) -> dict[str, str | int | float]:
    table = TABLES[name]
    runs = table.seeds * (len(table.rows) + len(table.hosts))
    hours = f"{runs * table.minutes / 60:.0f} h"
    return {
        "table": name,
        "shows": table.title,
        "rows": len(table.rows),
        "seeds": table.seeds,
        "decided by": table.primary,
        "one core": hours,
    }
