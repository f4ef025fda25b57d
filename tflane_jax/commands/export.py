"""`tflane export`: writes a model as one StableHLO file, checks its outputs, and measures latency."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jax import export

from tflane_jax.commands.outputs import check_output, check_table, folders_of
from tflane_jax.commands.sources import opened, source_for
from tflane_jax.config_io import settings
from tflane_jax.datasets import sources
from tflane_jax.datasets.photos import HEIGHT, WIDTH
from tflane_jax.errors import UserError
from tflane_jax.export import (
    Program,
    image_program,
    largest_difference,
    latencies,
    scene_program,
    serialized_model,
)
from tflane_jax.files.atomic import write_bytes
from tflane_jax.files.npz import write_npz
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import Run
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.runtime import configure_jax

_TOLERANCE, _OF_HALVES = 1e-3, 0.1
"""Two compiled programs of one model differ by rounding, which its layers amplify; 1.5e-5 was seen in float32."""
_SUFFIX = ".stablehlo"


def run(options: argparse.Namespace) -> int:
    """Write the program; beside it the table of latencies and, of a model of lanes around the vehicle, an example."""
    out: Path = options.out
    if out.suffix in (".md", ".json", ".npz"):
        raise UserError(f"--out {out}: a file beside the program has this name; choose one such as {_SUFFIX}")
    stem = out.with_suffix("") if out.suffix == _SUFFIX else out
    check_output(out)
    check_table(stem)
    configure_jax()
    run, rest = opened(options)
    if rest:
        raise UserError(f"tflane export takes one run, {rest[0]} is too many")
    if (weights := Path(run.name)).is_file():
        check_output(out, [weights])
    example = stem.with_name(stem.name + ".npz")
    program = _program(run, options, [out, example])
    content = serialized_model(program)
    loaded = export.deserialize(content)
    inputs = stack_examples([program.inputs] * 2)
    ours, exported = jax.jit(program.call)(inputs), cast(dict[str, Any], loaded.call(inputs))
    halves = any(value == "bfloat16" for _, value in settings(run.config.task))
    if not (difference := largest_difference(ours, exported)) <= (_OF_HALVES if halves else _TOLERANCE):
        raise UserError(f"the program gives other numbers than the model (by {difference:.2g}): it is not written")
    arrays = _arrays(program.inputs, exported)
    print(format_table(arrays, title=f"{out.name}: arrays of a batch of b"))
    batches = (1, 4, 16) if isinstance(run.config.task, LaneShapeTask) else (1, 4)
    rows = latencies(loaded, program.inputs, batches=batches)
    title = f"{out.name}: latency on {jax.devices()[0].device_kind}"
    print("\n" + format_table(rows, title=title, digits=2))
    write_bytes(out, content)
    written = save_table(stem, rows, {"model": run.name, "step": run.step, "arrays": arrays}, title=title, digits=2)
    print(f"\n{out}: {len(content) / 1e6:.1f} MB, the model's numbers within {difference:.1g}; table in {written[0]}")
    if isinstance(program.inputs, dict):
        answers = {f"answer/{name}": np.asarray(array)[0] for name, array in exported.items()}
        write_npz(example, program.inputs | answers)
        print(f"one frame and its answer in {example}")
    return 0


def _program(run: Run, options: argparse.Namespace, written: Sequence[Path]) -> Program:
    """Return the model as a function; raise UserError where it cannot be one, or data would be written over."""
    task = run.config.task
    if isinstance(task, LaneShapeTask):
        if given := [name for name in ("split", "data", "root") if getattr(options, name) is not None]:
            raise UserError(f"--{given[0]}: a model of lane lines in one image needs no data to be exported")
        return image_program(task, run.params[0], height=HEIGHT, width=WIDTH)
    if not isinstance(task, LaneGraphTask):
        raise UserError(f"{run.name} is of {type(task).__name__}, which tflane export does not know")
    source = source_for(run, options)
    for path in written:
        check_output(path, folders_of(source))
    if run.config.evaluation.topology != "learned":
        print("`successor` holds the learned scores; the run's evaluation.topology adds to them from `points`")
    return scene_program(task, run.params[0], sources.sample(source))


def _arrays(inputs: Any, answers: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each array of a program, with its shape for a batch of b."""
    named = inputs if isinstance(inputs, dict) else {"images": inputs}
    rows = [("input", name, ("b", *leaf.shape), leaf.dtype) for name, leaf in named.items()]
    rows += [("answer", name, ("b", *leaf.shape[1:]), leaf.dtype) for name, leaf in answers.items()]
    return [
        {"": kind, "array": name, "shape": f"({', '.join(map(str, shape))})", "type": str(dtype)}
        for kind, name, shape, dtype in rows
    ]
