"""`tflane export`: writes a monocular model as one StableHLO file, checks its outputs, and measures latency."""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np
from jax import export

from tflane_jax.commands.outputs import check_output, check_table
from tflane_jax.commands.sources import opened
from tflane_jax.errors import UserError
from tflane_jax.export import image_program, latencies, serialized_model
from tflane_jax.files.atomic import write_bytes
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.runtime import configure_jax

HEIGHT, WIDTH = 360, 640
_TOLERANCE = 1e-5  # rounding depends on the batch size


def run(options: argparse.Namespace) -> int:
    """Write the program, and the table of latencies beside it."""
    out: Path = options.out
    if out.suffix in (".md", ".json"):
        raise UserError(f"--out {out}: the table of latencies has this name; choose one such as .stablehlo")
    stem = out.with_suffix("") if out.suffix == ".stablehlo" else out
    check_output(out)
    check_table(stem)
    configure_jax()
    run, rest = opened(options)
    if rest:
        raise UserError(f"tflane export takes one run, {rest[0]} is too many")
    task = run.config.task
    if not isinstance(task, LaneShapeTask):
        raise UserError(f"{run.name} predicts lane graphs: tflane export takes models of lane lines in one image")
    if (weights := Path(run.name)).is_file():
        check_output(out, [weights])
    content = serialized_model(task, run.params[0], height=HEIGHT, width=WIDTH)
    program = export.deserialize(content)
    images = np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3), np.uint8)
    ours, exported = jax.jit(image_program(task, run.params[0]))(images), program.call(images)
    difference = max(float(abs(ours[name] - exported[name]).max()) for name in ours)
    if not difference <= _TOLERANCE:
        raise UserError(f"the program gives other numbers than the model (by {difference:.2g}): it is not written")
    rows = latencies(program, height=HEIGHT, width=WIDTH)
    title = f"{out.name}: latency on {jax.devices()[0].device_kind}"
    print(format_table(rows, title=title, digits=2))
    write_bytes(out, content)
    written = save_table(stem, rows, {"model": run.name, "step": run.step}, title=title, digits=2)
    print(f"\n{out}: {len(content) / 1e6:.1f} MB, the model's numbers within {difference:.1g}; table in {written[0]}")
    return 0
