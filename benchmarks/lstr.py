"""LSTR at its full size against the same network in PyTorch, and the encoders against each other.

    python -m benchmarks.lstr --out runs/bench

Inference at batch 1, 8 and 16 and a whole training step at batch 16, at 360 x 640. PyTorch, where it is installed,
runs the network of `benchmarks.torch_lstr` on the same cores in the same rounds, from normalised images with channels
last. For inference both sides have the same random weights and must give the same outputs.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import Compiled, command_line, compile_jax, interleave, machine, markdown_table, save, summarise
from tflane_jax.convert.lstr import convert_lstr
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.graph_encoders import GcnEncoderConfig, GtnEncoderConfig, HanEncoderConfig
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.models.parameters import Params
from tflane_jax.scene import LaneLines, RoadImage
from tflane_jax.startup import in_another_thread
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.state import init_state
from tflane_jax.training.step import make_update_step

HEIGHT, WIDTH, TRAINING_BATCH = 360, 640, 16
OURS, TORCH = "ours", "PyTorch"
MODEL = LstrConfig(backbone=ResNetConfig(frozen_stem_norm=True))
ENCODERS = {
    "transformer": MODEL.encoder,
    "GTN": GtnEncoderConfig(),
    "GCN": GcnEncoderConfig(),
    "HAN": HanEncoderConfig(),
}


def images(batch: int) -> np.ndarray:
    """Return random normalised images (B, H, W, 3)."""
    return np.random.default_rng(0).normal(size=(batch, HEIGHT, WIDTH, 3)).astype(np.float32)


def lines(batch: int) -> LaneLines:
    """Return four straight lanes of 48 points for each image."""
    rows = np.linspace(0.34, 0.98, 48, dtype=np.float32)
    columns = 0.5 + np.linspace(-1.2, 1.2, 4, dtype=np.float32)[:, None] * (rows - 0.3)
    points = np.stack([columns, np.broadcast_to(rows, columns.shape)], -1)
    shape = (batch, *columns.shape)
    return LaneLines(np.broadcast_to(points, (*shape, 2)), np.ones(shape, bool), np.ones(shape[:2], bool))


def inference(config: LstrConfig, batch: int, variables: Params | None = None) -> Compiled:
    """Return the network on normalised images, with random weights if none are given."""
    valid = jnp.ones((batch, HEIGHT, WIDTH), bool)
    pixels = jnp.asarray(images(batch))
    if variables is None:
        variables = jax.jit(config.build().init)(jax.random.key(0), pixels[0], valid[0])

    def predict(variables, pixels, valid):
        return jax.vmap(lambda image, v: config.build().apply(variables, image, v))(pixels, valid)

    return compile_jax(predict, variables, pixels, valid)


def training(config: LstrConfig, batch: int) -> Compiled:
    """Return a whole update step from bytes: normalisation, loss, gradient, clipping, AdamW, average, guard."""
    pixels = np.random.default_rng(0).integers(0, 256, (batch, HEIGHT, WIDTH, 3), np.uint8)
    data = jax.device_put(RoadImage(pixels, np.ones(pixels.shape[:3], bool), lines(batch)))
    task, optim = LaneShapeTask(config), OptimConfig(warmup_steps=0)
    state = init_state(task, make_optimizer(optim, 1000), jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], data))
    began = time.perf_counter()
    step = in_another_thread(make_update_step(task, optim, 1000).lower(state, data).compile)
    seconds = time.perf_counter() - began
    carried = [state]

    def run() -> None:
        carried[0], metrics = step(carried[0], data)
        jax.block_until_ready(metrics)

    return Compiled(run, seconds)


def with_torch() -> bool:
    """Return whether PyTorch is installed."""
    return importlib.util.find_spec("torch") is not None


def inference_case(batch: int) -> dict[str, Compiled]:
    """Return both sides of inference, which have given the same outputs; ours alone where PyTorch is missing."""
    if not with_torch():
        return {OURS: inference(MODEL, batch)}
    from benchmarks import torch_lstr

    weights = {name: value.numpy() for name, value in torch_lstr.build().state_dict().items()}
    ours = inference(MODEL, batch, convert_lstr(weights).variables)
    network = torch_lstr.inference(weights)
    pixels = images(batch).transpose(0, 3, 1, 2)  # a view: channels stay last in memory
    theirs = Compiled(lambda: network(pixels), 0.0)
    found = ours.program()
    check_equal((found.logits[:, -1], found.curves[:, -1]), theirs.program())
    return {OURS: ours, TORCH: theirs}


def check_equal(ours: Sequence[Any], theirs: Sequence[Any]) -> None:
    """Raise AssertionError unless outputs agree within 1e-4 of the largest."""
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-4 * np.abs(b).max())


def training_case(batch: int) -> dict[str, Compiled]:
    """Return both sides of a training step, ours alone where PyTorch is missing."""
    case = {OURS: training(MODEL, batch)}
    if not with_torch():
        return case
    from benchmarks.torch_lstr import Batch, training_step

    truth = lines(batch)
    rows = np.concatenate(
        [np.ones((4, 1)), truth.points[0, :, [0, -1], 1].T, truth.points[0, ..., 0], truth.points[0, ..., 1]], 1
    ).astype(np.float32)
    masks = np.zeros((batch, 1, HEIGHT, WIDTH), np.float32)
    step = training_step(Batch(images(batch).transpose(0, 3, 1, 2), masks, [rows] * batch))
    return case | {TORCH: Compiled(step, 0.0)}


def measure(seconds: float) -> dict[str, dict[str, Any]]:
    """Return for each case what `timing.summarise` gives, and the seconds of compilation."""
    cases = {f"inference, batch {batch}": inference_case(batch) for batch in (1, 8, 16)}
    cases[f"training step, batch {TRAINING_BATCH}"] = training_case(TRAINING_BATCH)
    for batch in (1, TRAINING_BATCH):
        encoders = {name: inference(replace(MODEL, encoder=encoder), batch) for name, encoder in ENCODERS.items()}
        cases[f"encoders, inference, batch {batch}"] = encoders
    cases[f"encoders, training step, batch {TRAINING_BATCH}"] = {
        name: training(replace(MODEL, encoder=encoder), TRAINING_BATCH) for name, encoder in ENCODERS.items()
    }
    results = {}
    for name, compiled in cases.items():
        reference = next(iter(compiled))
        timings = summarise(interleave({key: c.program for key, c in compiled.items()}, seconds), reference)
        results[name] = {key: row | {"compile_s": compiled[key].seconds} for key, row in timings.items()}
    return results


def table(results: dict[str, dict[str, Any]]) -> str:
    """Return one row for each program; the ratio is to the first of its case."""
    header = ("case", "program", "median ms", "least ms", "times the first", "compile s")
    rows = [
        (
            case,
            name,
            f"{row['median_ms']:.1f}",
            f"{row['least_ms']:.1f}",
            f"{row['ratio']:.2f}",
            f"{row['compile_s']:.1f}",
        )
        for case, programs in results.items()
        for name, row in programs.items()
    ]
    return markdown_table(header, rows)


def run(out: Path, seconds: float = 20.0) -> None:
    """Measure, print and save."""
    configure_jax(keep_programs=False)  # compiling is timed
    results = measure(seconds)
    record = machine() | {"results": results}  # the load is that at the end
    text = table(record["results"])
    print(text)
    save(out, "lstr", record, text)


if __name__ == "__main__":
    parser = command_line(__doc__, seconds=20.0)
    options = parser.parse_args()
    run(options.out, options.seconds)
