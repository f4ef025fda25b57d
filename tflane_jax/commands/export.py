"""`tflane export`: writes a monocular model as one StableHLO file, checks its outputs, and measures latency."""

from __future__ import annotations

import argparse

import jax
import numpy as np

from tflane_jax.commands.sources import opened
from tflane_jax.errors import UserError
from tflane_jax.export import export_model, image_program, latencies, load_program
from tflane_jax.files.atomic import check_stem, check_writable
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.runtime import configure_jax

HEIGHT, WIDTH = 360, 640
_TOLERANCE = 1e-5  # rounding depends on the batch size


def run(options: argparse.Namespace) -> int:
    """Write the program, and the table of latencies beside it."""
    check_writable(options.out)
    if options.out.suffix in (".md", ".json"):
        raise UserError(f"--out {options.out}: the table of latencies has this name; choose one such as .stablehlo")
    check_stem(options.out.with_suffix(""))
    configure_jax()
    run, rest = opened(options)
    if rest:
        raise UserError(f"tflane export takes one run, {rest[0]} is too many")
    task = run.config.task
    if not isinstance(task, LaneShapeTask):
        raise UserError(f"{run.name} predicts lane graphs: tflane export takes models of lane lines in one image")
    path = export_model(task, run.params[0], options.out, height=HEIGHT, width=WIDTH)

    program = load_program(path)
    images = np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3), np.uint8)
    ours, exported = jax.jit(image_program(task, run.params[0]))(images), program.call(images)
    difference = max(float(abs(ours[name] - exported[name]).max()) for name in ours)
    if not difference <= _TOLERANCE:
        raise UserError(f"{path} gives other numbers than the model (by {difference:.2g}): do not use it")
    rows = latencies(program, height=HEIGHT, width=WIDTH)
    title = f"{path.name}: latency on {jax.devices()[0].device_kind}"
    print(format_table(rows, title=title, digits=2))
    written = save_table(path.with_suffix(""), rows, {"model": run.name, "step": run.step}, title=title, digits=2)
    size = path.stat().st_size / 1e6
    print(f"\n{path}: {size:.1f} MB, the model's numbers within {difference:.1g}; table in {written[0]}")
    return 0
