"""`tflane eval`."""

from __future__ import annotations

import argparse

from tflane_jax.commands.sources import chosen_source, source_name
from tflane_jax.config_io import to_json
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import evaluate_run, open_run
from tflane_jax.training.runtime import configure_jax

_COLUMNS = ("lanes of", "seed", "DET_l", "TOP_ll", "DET_l@1.0", "DET_l@2.0", "DET_l@3.0", "lanes", "frames")


def run(options: argparse.Namespace) -> int:
    """Evaluate, print the table and write it as Markdown and JSON."""
    configure_jax()
    trained = open_run(options.run, options.checkpoint)
    source = chosen_source(trained.config, options)
    protocol, rows = evaluate_run(trained, source, max_instances=options.max_instances)
    rows = [{name: row[name] for name in _COLUMNS if name in row} for row in rows]

    name = f"{source_name(source)}-step{trained.step}"
    if options.max_instances is not None:
        name += f"-max_instances{options.max_instances}"
    title = f"{options.run}, {name}: {protocol}"
    print(format_table(rows, title=title))
    meta = {
        "run": str(options.run),
        "step": trained.step,
        "protocol": protocol,
        "max_instances": options.max_instances,
        "source": to_json(source),
    }
    paths = save_table(options.out or options.run / "evaluations" / name, rows, meta, title=title)
    print(f"\nwritten to {paths[0]} and {paths[1]}")
    return 0
