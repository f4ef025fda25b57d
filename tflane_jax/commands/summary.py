"""`tflane summary`: parameters, operations, memory and an estimate of the training, computed from shapes alone."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import jax

from tflane_jax.commands.outputs import check_table
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.plan import UTILISATION, make_plan
from tflane_jax.plots.tables import format_table, save_table, written_to
from tflane_jax.run_checks import check_kind
from tflane_jax.summary import parameter_counts, prediction_program, shapes_of_params, training_program
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Print the two tables, and save them to --out; or the estimate of --plan."""
    _check_together(options)
    if options.out is not None:
        check_table(options.out)
    # XLA for GPUs counts no operations, and nothing here runs.
    jax.config.update("jax_platforms", "cpu")
    configure_jax(keep_programs=False)  # compiling is timed
    config = load_config(options.config) if options.config else RunConfig()
    config = apply_overrides(config, overrides)
    check_kind(config)
    config.task.check_settings(config.data)
    example = config.task.shapes(config.data)
    if options.plan is not None:
        return _plan(options, config, example)
    params = shapes_of_params(config.task, example)
    counts = parameter_counts(params, 1 if options.depth is None else options.depth)
    total = sum(counts.values())
    parts = [
        {"part": name, "parameters": f"{count:,}", "fraction": f"{count / total:.1%}"} for name, count in counts.items()
    ]
    parts.append({"part": "all", "parameters": f"{total:,}", "fraction": "100.0%"})
    title = f"Parameters of {options.config or 'the default configuration'}"
    print(format_table(parts, title=title), flush=True)

    batch_size, accumulate = config.training.batch_size, config.training.accumulate
    compiled = not options.no_compile
    programs = [prediction_program(config.task, example, compiled=compiled)]
    if not options.no_training:
        how: dict[str, Any] = {"accumulate": accumulate, "compiled": compiled}
        programs.append(training_program(config.task, example, batch_size, config.optim, **how))
    rows = [
        {
            "program": each.name,
            "batch": each.batch,
            "GFLOP": each.gflop,
            "memory, MiB": each.memory,
            "of that temporary": each.temporary,
            "compile, s": each.compile_s,
        }
        for each in programs
    ]
    title = "Operations as XLA counts them before fusion; memory as the compiler for this machine plans it"
    print("\n" + format_table(rows, title=title, digits=1))
    if options.out is not None:
        meta = {"config": options.config, "parameters": counts}
        print(f"\n{written_to(save_table(options.out, rows, meta, title=title, digits=1))}")
    return 0


def _check_together(options: argparse.Namespace) -> None:
    """Raise UserError for options that do nothing together."""
    of_plan = {"--kind": options.kind is not None, "--utilisation": options.utilisation is not None}
    of_tables = {"--depth": options.depth is not None, "--no-training": options.no_training}
    idle = [name for name, is_given in (of_plan if options.plan is None else of_tables).items() if is_given]
    if idle and options.plan is None:
        raise UserError(f"{idle[0]} does nothing without --plan: add it")
    if idle:
        raise UserError(f"{idle[0]} does nothing with --plan: leave {idle[0]} or --plan out")
    if options.depth is not None and options.depth < 1:
        raise UserError(f"--depth {options.depth}: at least one level of names")


def _plan(options: argparse.Namespace, config: RunConfig, example: Any) -> int:
    kind = options.kind or "h100"
    plan = make_plan(
        config.task,
        example,
        config.optim,
        config.training,
        devices=options.plan,
        kind=kind,
        utilisation=UTILISATION if options.utilisation is None else options.utilisation,
        compiled=not options.no_compile,
    )
    title = f"Estimate, not a measurement: {options.config or 'the default configuration'} on {options.plan} x "
    title += f"{kind}, batch {config.training.batch_size}"
    print(format_table(plan.rows, title=title))
    print("\nAssumptions\n" + "\n".join(f"- {sentence}" for sentence in plan.assumptions))
    if options.out is not None:
        meta = {"config": options.config, "assumptions": plan.assumptions}
        print(f"\n{written_to(save_table(options.out, plan.rows, meta, title=title))}")
    return 0
