"""`tflane eval`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from tflane_jax.commands.sources import chosen_source, limited_task, opened, with_chosen_topology, with_chosen_traffic
from tflane_jax.config_io import to_json
from tflane_jax.datasets.overlap import Nearness
from tflane_jax.datasets.sources import source_name
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import Run, evaluate_run, training_nearness
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Evaluate, print the table, and write it as Markdown and JSON."""
    configure_jax()
    trained, rest = opened(options)
    if rest:
        raise UserError(f"tflane eval takes one run: leave {rest[0]} out")
    trained = with_chosen_topology(with_chosen_traffic(trained, options), options)
    source = chosen_source(trained.config, options)
    near = _nearness(trained, source, options.training_root)
    groups = [] if near is None else near.groups
    protocol, rows = evaluate_run(trained, source, task=limited_task(trained, options), frame_groups=groups)

    name = f"{source_name(source)}-step{trained.step}"
    if options.max_instances is not None:
        name += f"-max_instances{options.max_instances}"
    if (traffic := trained.config.evaluation.traffic) != "own":
        name += f"-traffic_{traffic.replace('-', '_')}"
    if (topology := trained.config.evaluation.topology) != "learned":
        name += f"-topology_{topology}"
    title = f"{trained.name}, {name}: {protocol}"
    print(format_table(rows, title=title))
    if near is not None:
        print(f"\n{near.sentence()}")
    meta = {
        "run": trained.name,
        "step": trained.step,
        "protocol": protocol,
        "max_instances": options.max_instances,
        "traffic": traffic,
        "topology": topology,
        "source": to_json(source),
        "near_training": None if near is None else near.sentence(),
    }
    folder = Path("runs" if options.config else trained.name) / "evaluations"
    paths = save_table(options.out or folder / name, rows, meta, title=title)
    print(f"\nwritten to {paths[0]} and {paths[1]}")
    return 0


def _nearness(run: Run, source: Any, root: Path | None) -> Nearness | None:
    """Return how far the examples are from the training frames; None where that cannot be told and nobody asked."""
    if root is not None:
        if (found := training_nearness(run.config, source, root)) is None:
            raise UserError(f"{root}: no training frame is in a city of the evaluated frames")
        return found
    try:
        return training_nearness(run.config, source)
    except UserError as error:
        print(f"no groups by distance to training frames, whose files are needed for that: {error}", file=sys.stderr)
        return None
