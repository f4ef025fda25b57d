"""Time of a host and its traffic-flow module: inference, training step, several seeds at once, first step.

    python -m benchmarks.host --out runs/bench

The models are those of `configs/tf_lane/`; examples come from the built-in world. Ratios compare programs that ran in
turn (`benchmarks.timing`).
"""

from __future__ import annotations

import argparse
import dataclasses
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.timing import Compiled, compile_jax, machine, markdown_table, measure, save
from tflane_jax.config import load_config
from tflane_jax.datasets.loading import TRAINING_PARTS, load_arrays
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig, TrafficFlowModuleConfig
from tflane_jax.scene import Example
from tflane_jax.tasks.lane_graph import LaneGraphTask

CONFIGS = Path(__file__).parent.parent / "configs" / "tf_lane"
BATCH = 8
SEEDS = 3


CONFIG_FILES = {"baseline": "toponet.py", "+TFM": "toponet_tfm.py"}


def tasks() -> dict[str, LaneGraphTask]:
    """Return the shipped baseline and the same with the TFM."""
    shipped = {name: load_config(str(CONFIGS / file)).task for name, file in CONFIG_FILES.items()}
    return {name: task for name, task in shipped.items() if isinstance(task, LaneGraphTask)}


def paper_size_tasks() -> dict[str, LaneGraphTask]:
    """Return both with TopoNet's own decoder: 256 channels, 6 layers, 200 queries, 100 x 200 BEV cells.

    The encoder stays small. With cameras and BEVFormer, the TFM's fraction of the time would be smaller.
    """
    decoder = LaneDecoderConfig(dim=256, layers=6, queries=200, hidden=512, relation=128, refine="fixed")
    model = TopoNetConfig(encoder=EvidenceEncoderConfig(dim=64, cell=1), decoder=decoder)
    module = TrafficFlowModuleConfig(width=128, heads=8)
    with_traffic = dataclasses.replace(model, priors=PriorsConfig(traffic_flow=TrafficFlowConfig(module=module)))
    return {"baseline": LaneGraphTask(model), "+TFM": LaneGraphTask(with_traffic)}


def examples() -> Example:
    """Return a batch of examples of the built-in world, on the device."""
    dataset = ProceduralDataset(ProceduralConfig(split="val", scenes=BATCH // 4))
    return jax.tree.map(jnp.asarray, load_arrays(dataset, parts=TRAINING_PARTS, progress=False))


def inference(batch: Example, seconds: float) -> dict[str, Any]:
    """Time prediction of one example and of a batch, with and without the TFM (N_t = 30), and one at TopoNet's size."""
    one = jax.tree.map(lambda leaf: leaf[0], batch)

    def measured(models: dict[str, LaneGraphTask], batched: bool) -> dict[str, Any]:
        compiled = {}
        for name, task in models.items():
            params = jax.jit(task.init)(jax.random.key(0), one)
            predict = jax.vmap(task.predict, in_axes=(None, 0)) if batched else task.predict
            compiled[name] = compile_jax(predict, params, batch if batched else one)
        return measure(compiled, seconds)

    return {
        "inference, batch 1": measured(tasks(), batched=False),
        f"inference, batch {BATCH}": measured(tasks(), batched=True),
        "inference, batch 1, TopoNet's decoder size": measured(paper_size_tasks(), batched=False),
    }


def training(batch: Example, seconds: float) -> dict[str, Any]:
    """Time loss and gradient of a batch: with and without the TFM, and with either matching backend."""
    one = jax.tree.map(lambda leaf: leaf[0], batch)
    compiled = {}
    for name, task in tasks().items():
        params = jax.jit(task.init)(jax.random.key(0), one)
        compiled[name] = compile_jax(_gradient(task), params, batch)
    return {f"loss and gradient, batch {BATCH}": measure(compiled, seconds)}


def seeds(batch: Example, seconds: float) -> dict[str, Any]:
    """Time several seeds in one program (vmap) against one after the other."""
    one = jax.tree.map(lambda leaf: leaf[0], batch)
    task = tasks()["+TFM"]
    keys = jax.random.split(jax.random.key(0), SEEDS)
    stacked = jax.jit(jax.vmap(task.init, in_axes=(0, None)))(keys, one)
    single = [jax.tree.map(lambda leaf, i=i: leaf[i], stacked) for i in range(SEEDS)]
    together = compile_jax(jax.vmap(_gradient(task), in_axes=(0, None)), stacked, batch)
    alone = compile_jax(_gradient(task), single[0], batch)
    step = jax.jit(_gradient(task))
    jax.block_until_ready(step(single[0], batch))
    compiled = {
        "one after the other": Compiled(
            lambda: [jax.block_until_ready(step(params, batch)) for params in single], alone.seconds
        ),
        "vmap": together,
    }
    return {f"{SEEDS} seeds, batch {BATCH} each": measure(compiled, seconds)}


def first_step() -> dict[str, Any]:
    """Time a fresh process until it has imported, made an example, initialised, compiled and made one step."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.host", "--first-step"],
        check=True,
        capture_output=True,
        text=True,
        cwd=CONFIGS.parent.parent,
    )
    marks = dict(line.split("=") for line in done.stdout.split())
    return {name: float(value) for name, value in marks.items()} | {"process": time.perf_counter() - start}


def _print_first_step() -> None:
    start = time.perf_counter()
    task, batch = tasks()["+TFM"], examples()
    print(f"world={time.perf_counter() - start:.3f}")
    start = time.perf_counter()
    params = jax.jit(task.init)(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], batch))
    print(f"init={time.perf_counter() - start:.3f}")
    step = compile_jax(_gradient(task), params, batch)
    print(f"compile={step.seconds:.3f}")
    start = time.perf_counter()
    step.program()
    print(f"step={time.perf_counter() - start:.3f}")


def _gradient(task: LaneGraphTask):
    def loss(params, batch):
        return task.loss(params, batch, jax.random.key(0))[0]

    return jax.value_and_grad(loss)


def run(out: Path, seconds: float = 10.0) -> dict[str, Any]:
    """Run everything, print the tables, write `host.json` and `host.md` into `out`, and return the record."""
    batch = examples()
    traffic = tasks()["+TFM"].model.priors.traffic_flow or TrafficFlowConfig()
    results = inference(batch, seconds) | training(batch, seconds) | seeds(batch, seconds)
    record = {
        "machine": machine(),
        "max_instances": traffic.prior.max_instances,
        "results": results,
        "first_step_s": first_step(),
    }
    rows = [
        [what, name, f"{r['median_ms']:.2f}", f"{r['least_ms']:.2f}", f"{r['ratio']:.3f}", f"{r['compile_s']:.1f}"]
        for what, programs in results.items()
        for name, r in programs.items()
    ]
    table = markdown_table(["what", "program", "median ms", "least ms", "ratio", "compile s"], rows)
    first = ", ".join(f"{name} {value:.1f} s" for name, value in record["first_step_s"].items())
    table += f"\n\nFresh process to its first step: {first}."
    print(table)
    save(out, "host", record, table)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("--seconds", type=float, default=10.0, help="for each comparison")
    parser.add_argument("--first-step", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.first_step:
        _print_first_step()
    else:
        run(options.out, options.seconds)


if __name__ == "__main__":
    main()
