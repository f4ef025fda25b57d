"""Time of a host and its traffic-flow module: inference, training update, several seeds, start of `tflane train`.

    python -m benchmarks.host --out runs/bench

The models are those of `configs/tf_lane/` on the preset `street`; examples come from the built-in world. Ratios compare
programs that ran in turn (`benchmarks.timing`).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.timing import Compiled, command_line, compile_jax, machine, markdown_table, measure, save
from tflane_jax.config import RunConfig, load_config
from tflane_jax.datasets.loading import TRAINING_PARTS, load_arrays
from tflane_jax.datasets.procedural import ProceduralDataset
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.models.parameters import split_statistics
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig, TrafficFlowModuleConfig
from tflane_jax.scene import Example
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training.schedule import make_optimizer
from tflane_jax.training.state import init_states
from tflane_jax.training.step import UpdateForm, compiled_update, update_all

ROOT = Path(__file__).parent.parent
CONFIGS = {"baseline": "tf_lane/toponet:street", "+TFM": "tf_lane/toponet_tfm:street"}
BATCH = 8  # of inference
SEEDS = 3
STEPS = 1000  # of the run that an update belongs to; its time does not depend on it
_SCENES = ("--data.train", "8", "--data.val", "2")
_MARKS = ("init_states", "compiled_update", "update_all")


def configs() -> dict[str, RunConfig]:
    """Return the shipped baseline and the same with the TFM."""
    return {name: load_config(reference) for name, reference in CONFIGS.items()}


def tasks() -> dict[str, LaneGraphTask]:
    """Return the models and losses of both."""
    return {name: config.task for name, config in configs().items() if isinstance(config.task, LaneGraphTask)}


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
    source = dataclasses.replace(configs()["baseline"].data.source("val"), scenes=BATCH)
    arrays = load_arrays(ProceduralDataset(source), parts=TRAINING_PARTS, progress=False)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[:BATCH]), arrays)


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
    """Time the update of a training against the gradient that it takes, at the batch of the configuration."""
    results = {}
    for name, config in configs().items():
        size = config.training.batch_size
        few = jax.tree.map(lambda leaf, size=size: leaf[:size], batch)
        results[f"{name}: update, batch {size}"] = measure(
            {"gradient alone": _gradient(tasks()[name], few), "update": _updates(config, few, 1)}, seconds
        )
    return results


def seeds(batch: Example, seconds: float) -> dict[str, Any]:
    """Time an update of several seeds against that of one."""
    config = configs()["+TFM"]
    few = jax.tree.map(lambda leaf: leaf[: config.training.batch_size], batch)
    compiled = {"one seed": _updates(config, few, 1), f"{SEEDS} seeds": _updates(config, few, SEEDS)}
    return {f"seeds, batch {config.training.batch_size} each": measure(compiled, seconds)}


def _gradient(task: LaneGraphTask, batch: Example) -> Compiled:
    learned, statistics = split_statistics(jax.jit(task.init)(jax.random.key(0), _first(batch)))

    def gradient(learned: Any, batch: Example) -> Any:
        return jax.value_and_grad(
            lambda params: task.loss(params | statistics, batch, jax.random.key(0)), has_aux=True
        )(learned)

    return compile_jax(gradient, learned, batch)


def _updates(config: RunConfig, batch: Example, count: int) -> Compiled:
    """Return the update of `count` seeds, as a training makes it: every call goes on from the one before."""
    states = init_states(config.task, make_optimizer(config.optim, STEPS), range(count), _first(batch))
    start = os.times().elapsed
    update = compiled_update(config.task, config.optim, STEPS, states[0], batch, UpdateForm(donate=count == 1))
    seconds = os.times().elapsed - start

    def step() -> Any:
        nonlocal states
        states, metrics = update_all(update, states, [batch] * count)
        return metrics

    return Compiled(step, seconds)


def _first(batch: Example) -> Example:
    return jax.tree.map(lambda leaf: leaf[0], batch)


def starts() -> dict[str, dict[str, float]]:
    """Return CPU seconds of `tflane train` until each part is done: first with empty caches, then again."""
    with tempfile.TemporaryDirectory() as folder:
        return {name: _start(Path(folder), name) for name in ("cold", "warm")}


def _start(folder: Path, name: str) -> dict[str, float]:
    # Programs kept elsewhere would make the first start a warm one.
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.host", "--start", str(folder / name)],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=environment | {"TFLANE_CACHE": str(folder / "cache"), "PYTHONPATH": str(ROOT)},
    )
    lines = [line.split("=") for line in done.stdout.splitlines() if line.startswith(_MARKS)]
    return {what: float(seconds) for what, seconds in lines}


def _train_one_step(out: Path) -> None:
    """Run `tflane train` up to its first step and print the CPU time before and after the parts of its program."""
    from tflane_jax.cli import main
    from tflane_jax.training import loop

    def marked(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if name == _MARKS[0]:
                print(f"{name} begins={_cpu_seconds():.2f}")
            result = function(*arguments, **options)
            print(f"{name}={_cpu_seconds():.2f}", flush=True)
            if name == _MARKS[-1]:
                os._exit(0)
            return result

        return call

    for name in _MARKS:
        setattr(loop, name, marked(name, getattr(loop, name)))
    main(["train", "--config", CONFIGS["+TFM"], "--out", str(out), *_SCENES])


def _cpu_seconds() -> float:
    return sum(os.times()[:4])  # of this process and its children, in user and system


def run(out: Path, seconds: float = 10.0) -> dict[str, Any]:
    """Run everything, print the tables, write `host.json` and `host.md` into `out`, and return the record."""
    configure_jax(keep_programs=False)  # compiling is timed
    batch = examples()
    traffic = tasks()["+TFM"].model.priors.traffic_flow or TrafficFlowConfig()
    results = inference(batch, seconds) | training(batch, seconds) | seeds(batch, seconds)
    record = {
        "machine": machine(),
        "max_instances": traffic.prior.max_instances,
        "results": results,
        "start_cpu_s": starts(),
    }
    rows = [
        [what, name, f"{r['median_ms']:.2f}", f"{r['least_ms']:.2f}", f"{r['ratio']:.3f}", f"{r['compile_s']:.1f}"]
        for what, programs in results.items()
        for name, r in programs.items()
    ]
    table = markdown_table(["what", "program", "median ms", "least ms", "ratio", "compile s"], rows)
    parts = ("imports, examples", "parameters", "update compiled", "first step")
    table += "\n\n" + markdown_table(
        ["`tflane train`, CPU s until", *parts],
        [[name, *(f"{second:.1f}" for second in marks.values())] for name, marks in record["start_cpu_s"].items()],
    )
    print(table)
    save(out, "host", record, table)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, seconds=10.0)
    parser.add_argument("--start", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.start is not None:
        _train_one_step(options.start)
    else:
        run(options.out, options.seconds)


if __name__ == "__main__":
    main()
