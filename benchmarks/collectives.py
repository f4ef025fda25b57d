"""Several devices without having them: planned memory and collectives of an update, and an estimate of the scaling.

    python -m benchmarks.collectives --out runs/bench --config tf_lane/toponet_tfm:street --layers 1
    python -m benchmarks.collectives --out runs/bench --only-estimate --paper camera/toponet_r50

Compiles the update for 1, 2 and 8 devices that a CPU plays, with the state whole on each device and shared
(`training.shard_state`), each in a process of its own. Nothing runs. Memory is what the compiler for CPUs plans for one
device. Collectives are read from the compiled program; one in a loop counts once. The estimate then takes the exchange
of the gradients of a model of the paper's size.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax

from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax.config import RunConfig, load_config
from tflane_jax.devices import active, in_parts, training_mesh
from tflane_jax.plan import ACCELERATORS, GIB, UTILISATION, make_plan
from tflane_jax.scene import shapes_of
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training.schedule import make_optimizer, scaled_to_batch
from tflane_jax.training.sharding import laid_out
from tflane_jax.training.state import init_state
from tflane_jax.training.step import UpdateForm, make_update_step

DEVICES = (1, 2, 8)
KINDS_OF_EXCHANGE: tuple[str, ...] = ("all-reduce", "all-gather", "reduce-scatter", "all-to-all", "collective-permute")
LINKS = {"NVLink 4, 450 GB/s": 450.0, "Ethernet, 100 Gbit/s": 12.5}
"""GB/s of the slowest link of the ring, in one direction: H100's NVLink (900 GB/s in both), and a network card."""
STEPS = 1000


def exchanges(program: str, devices: int) -> dict[str, tuple[int, int]]:
    """Return number and bytes of each kind of collective in a compiled program (HLO text of a CPU).

    Bytes are those of the whole arrays: of what is added up, gathered, or added up and divided.
    """
    found: dict[str, tuple[int, int]] = dict.fromkeys(KINDS_OF_EXCHANGE, (0, 0))
    for shapes, kind in re.findall(rf" = (\(.*?\)|\S+) ({'|'.join(KINDS_OF_EXCHANGE)})\(", program):
        count, total = found[kind]
        size = sum(_bytes(name, dims) for name, dims in re.findall(r"([a-z]+\d*)\[([\d,]*)\]", shapes))
        found[kind] = (count + 1, total + size * (devices if kind == "reduce-scatter" else 1))
    return found


def _bytes(name: str, dims: str) -> int:
    bits = re.search(r"\d+", name)  # "pred" has none, and takes a byte
    return math.prod(map(int, filter(None, dims.split(",")))) * (int(bits[0]) // 8 if bits else 1)


def planned(config: RunConfig, examples: int, *, shard: bool) -> dict[str, Any]:
    """Return what the compiled update takes on each of this process's devices, which get `examples` each."""
    task, devices = config.task, jax.device_count()
    batch_size = examples * devices
    mesh, optim = training_mesh(batch_size), scaled_to_batch(replace(config.optim, warmup_steps=0), batch_size)
    example = task.shapes(config.data)
    frames = example if task.frames == 1 else shapes_of(example, task.frames)
    state: Any = jax.eval_shape(partial(init_state, task, make_optimizer(optim, STEPS)), jax.random.key(0), frames)
    parameters = sum(4 * math.prod(vector.shape) for vector in jax.tree.leaves(state.learned))
    batch = shapes_of(frames, batch_size)
    if mesh is not None:
        state = laid_out(state, mesh, shard=shard)
        parts = in_parts(mesh)
        batch = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=parts), batch)
    began = time.process_time()
    with active(mesh):
        update: Any = make_update_step(task, optim, STEPS, UpdateForm(mesh=mesh, shard_state=shard))
        program = update.lower(state, batch).compile()
    memory = program.memory_analysis()
    return {
        "devices": devices,
        "state": "shared" if shard else "whole",
        "parameters": parameters,
        "arguments": memory.argument_size_in_bytes,
        "between": memory.temp_size_in_bytes,
        "exchanges": exchanges(program.as_text(), devices),
        "compile_cpu_s": time.process_time() - began,
    }


def with_layers(config: RunConfig, layers: int | None) -> RunConfig:
    """Return a configuration with so many decoder layers; None leaves it."""
    if layers is None:
        return config
    task: Any = config.task
    decoder = replace(task.model.decoder, layers=layers)
    return replace(config, task=replace(task, model=replace(task.model, decoder=decoder)))


def _in_processes(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return `planned` for every number of devices, each from a process that plays them."""
    rows: list[dict[str, Any]] = []
    for devices in options.devices:
        # Code is left unoptimised, which halves compiling and changes no collective.
        flags = f"--xla_backend_optimization_level=0 --xla_force_host_platform_device_count={devices}"
        command = [sys.executable, "-m", "benchmarks.collectives", "--out", str(options.out), "--config"]
        command += [options.config, "--examples", str(options.examples), "--here"]
        command += [] if options.layers is None else ["--layers", str(options.layers)]
        environment = os.environ | {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()}
        ended = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        rows += json.loads(ended.stdout.splitlines()[-1])
        print(f"{devices} devices: compiled", flush=True)
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of `planned` rows; memory and exchanged bytes in MiB."""
    used = [kind for kind in KINDS_OF_EXCHANGE if any(row["exchanges"][kind][0] for row in rows)]
    header = ["devices", "state", "arguments", "between", *(f"{kind}: number, MiB" for kind in used)]
    mib = lambda size: f"{size / 2**20:,.2f}"  # noqa: E731
    lines = [
        [str(row["devices"]), row["state"], mib(row["arguments"]), mib(row["between"])]
        + [f"{count}, {mib(size)}" if count else "-" for count, size in (row["exchanges"][kind] for kind in used)]
        for row in rows
    ]
    return markdown_table(header, lines)


def ring_bytes(size: float, devices: int, *, shared: bool) -> float:
    """Return the bytes that each device sends in a step for gradients of `size` bytes, in a ring.

    Adding up takes 2 (n - 1) / n of the size; a shared state is gathered too, which takes (n - 1) / n.
    """
    return (3 if shared else 2) * (devices - 1) / devices * size


def estimate(
    name: str, examples: int, devices: Sequence[int], *, kind: str, utilisation: float
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return rows of an estimate for a configuration on several devices, and the assumptions, a sentence each."""
    config = load_config(name)
    example = config.task.shapes(config.data)
    training = replace(config.training, batch_size=examples, accumulate=1)
    form: dict[str, Any] = {"devices": 1, "kind": kind, "utilisation": utilisation, "compiled": False}
    plan = make_plan(config.task, example, config.optim, training, **form)
    size = plan.learned * GIB
    rows = []
    for link, speed in LINKS.items():
        for n in devices:
            for state in ("whole", "shared"):
                exchange = ring_bytes(size, n, shared=state == "shared") / (1e9 * speed)
                rows.append(
                    {
                        "link": link,
                        "devices": n,
                        "state": state,
                        "computing_s": plan.step_s,
                        "exchange_s": exchange,
                        "efficiency": plan.step_s / (plan.step_s + exchange),
                    }
                )
    return rows, [
        f"{name}, {examples} example(s) on each device, {size / 4e6:.1f} million learned parameters of 4 bytes",
        *plan.assumptions[:3],
        "every device sends 2 (n - 1) / n of the gradients' bytes, and (n - 1) / n of the parameters' if they are "
        "shared; all other exchanges take no time",
        "exchange begins after computing and runs at full speed of the slowest link of the ring; no latency",
        "links: H100's data sheet has 900 GB/s of NVLink in both directions, half of it in one; 100 Gbit/s are "
        "12.5 GB/s. 16 devices on NVLink need an NVLink switch over two hosts",
        "efficiency is computing / (computing + exchange); loading and waiting for the slowest device are left out",
    ]


def estimate_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of `estimate` rows."""
    header = ["link", "devices", "state", "computing, s", "exchange, s", "efficiency"]
    formats = {"devices": "d", "computing_s": ".3f", "exchange_s": ".4f", "efficiency": ".0%"}
    return markdown_table(header, [[format(value, formats.get(name, "")) for name, value in r.items()] for r in rows])


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Print the tables, and write `collectives.json` and `.md` into the folder."""
    rows = [] if options.only_estimate else _in_processes(options)
    text = ""
    if rows:
        layers = "" if options.layers is None else f", {options.layers} decoder layer(s)"
        text = f"{options.config}{layers}, {options.examples} example(s) and MiB on each device; "
        text += f"parameters {rows[0]['parameters'] / 2**20:.2f} MiB\n\n{table(rows)}\n\n"
    form: dict[str, Any] = {"kind": options.kind, "utilisation": options.utilisation}
    scaling, assumptions = estimate(options.paper, options.examples, (8, 16), **form)
    text += f"Estimate, not a measurement: {options.paper} on {options.kind}\n\n{estimate_table(scaling)}\n\n"
    text += "Assumptions\n" + "\n".join(f"- {sentence}" for sentence in assumptions)
    print(text)
    settings = {name: value for name, value in vars(options).items() if name not in ("out", "here")}
    record = machine() | {"settings": settings, "rows": rows, "estimate": scaling, "assumptions": assumptions}
    save(options.out, "collectives", record, text)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__)
    parser.add_argument("--config", default="tf_lane/toponet_tfm:street", help="what is compiled")
    parser.add_argument("--layers", type=int, help="of its decoder")
    parser.add_argument("--examples", type=int, default=1, help="of each device (default 1)")
    parser.add_argument("--devices", type=int, nargs="+", default=list(DEVICES), help="numbers of devices")
    parser.add_argument("--paper", default="camera/toponet_r50", help="configuration of the estimate")
    parser.add_argument("--kind", choices=ACCELERATORS, default="h100", help="device of the estimate (default h100)")
    parser.add_argument(
        "--utilisation", type=float, default=UTILISATION, help=f"assumed fraction of its peak (default {UTILISATION})"
    )
    parser.add_argument("--only-estimate", action="store_true", help="compile nothing")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)  # in a process that plays the devices
    options = parser.parse_args()
    configure_jax(keep_programs=False)
    if options.here:
        config = with_layers(load_config(options.config), options.layers)
        states = (False, True) if jax.device_count() > 1 else (False,)
        print(json.dumps([planned(config, options.examples, shard=shard) for shard in states]))
    else:
        run(options)


if __name__ == "__main__":
    main()
