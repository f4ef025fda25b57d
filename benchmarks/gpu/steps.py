"""Updates at the papers' sizes on an accelerator: time and memory.

    python -m benchmarks.gpu.steps --out runs/bench --kind h100
    python -m benchmarks.gpu.steps --out runs/bench --models toponet --batch 4 --precision float32 --remat
    python -m benchmarks.gpu.steps --out runs/bench --tiny          # on a CPU: small models, which shows that it starts

TopoNet, LaneSegNet and MapTRv2 make updates of one batch of invented numbers in the shapes of their data: a fifth of
the slots for lanes is valid, images are noise. Parameters are invented too, and losses mean nothing. The time of
matching on the device depends on the number of lanes. The fraction of the peak is XLA's count of operations before
fusion, divided by time and the data sheet's peak; XLA for GPUs does not count them (seen with jax 0.11.2), and `tflane
summary --plan` does on a CPU. Peak memory may include what XLA tries while it chooses convolutions. Every model has a
process of its own: all compile at the same time, and run one after the other.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gpu.turns import alone
from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax import accelerators
from tflane_jax.config import RunConfig, load_config
from tflane_jax.layers.precision import Precision
from tflane_jax.plan import ACCELERATORS
from tflane_jax.scene import shapes_of
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training.schedule import make_optimizer
from tflane_jax.training.state import init_state
from tflane_jax.training.step import make_update_step

CONFIGS = {"toponet": "camera/toponet_r50", "lanesegnet": "tf_lane/lanesegnet_r50", "maptrv2": "tf_lane/maptrv2_r50"}
TINY = {"toponet": "tf_lane/toponet", "lanesegnet": "tf_lane/lanesegnet", "maptrv2": "tf_lane/maptrv2"}
UPDATES = 20
T = TypeVar("T")


def everywhere(config: T, precision: Precision, *, remat: bool) -> T:
    """Return a configuration in which every part that has the two settings takes these."""
    if not is_dataclass(config) or isinstance(config, type):
        return config
    changes: dict[str, Any] = {
        field.name: everywhere(getattr(config, field.name), precision, remat=remat) for field in fields(config)
    }
    if "precision" in changes:
        changes |= {"precision": precision, "remat": remat}
    return replace(config, **changes)


def configuration(model: str, precision: Precision, *, remat: bool, tiny: bool) -> RunConfig:
    """Return the configuration of a model at the paper's size, or a small one with a single decoder layer."""
    config = load_config((TINY if tiny else CONFIGS)[model])
    task: Any = config.task
    host = everywhere(task.model, precision, remat=remat)
    if tiny:
        host = replace(host, decoder=replace(host.decoder, layers=1))
    return replace(config, task=replace(task, model=host))


def invented(shapes: Any, seed: int = 0) -> Any:
    """Return arrays of given shapes: integers 0, numbers in [0, 1), images of noise, a fifth of all slots valid."""
    rng = np.random.default_rng(seed)

    def fill(leaf: Any) -> np.ndarray:
        if leaf.dtype == bool:
            return rng.random(leaf.shape) < 0.2
        if leaf.dtype == np.uint8:
            return rng.integers(0, 256, leaf.shape, np.uint8)
        if np.issubdtype(leaf.dtype, np.floating):
            return rng.random(leaf.shape).astype(leaf.dtype)
        return np.zeros(leaf.shape, leaf.dtype)

    return jax.tree.map(fill, shapes)


def _invented_state(init: Callable[[jax.Array, Any], Any], example: Any, seed: int = 0) -> Any:
    """Return a training state of small positive numbers: compiling its initialisation takes minutes at these sizes."""
    rng, key = np.random.default_rng(seed), jax.random.key(seed)

    def fill(leaf: Any) -> Any:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return key
        if np.issubdtype(leaf.dtype, np.floating):
            return np.abs(rng.normal(0.0, 0.02, leaf.shape)).astype(leaf.dtype)
        return np.zeros(leaf.shape, leaf.dtype)

    return jax.device_put(jax.tree.map(fill, jax.eval_shape(init, key, example)))


def measured(config: RunConfig, batch_size: int, updates: int, peak: float) -> dict[str, Any]:
    """Return what updates of one batch take on the first device; `peak` is in TFLOP/s."""
    task = config.task
    example = invented(task.shapes(config.data))
    batch = jax.device_put(invented(shapes_of(example, batch_size)))
    optim = replace(config.optim, warmup_steps=0, epoch_steps=0, lr_factors=())
    state = _invented_state(partial(init_state, task, make_optimizer(optim, 1000)), example)
    lowered: Any = make_update_step(task, optim, 1000)
    lowered = lowered.lower(state, batch)
    flops = (lowered.cost_analysis() or {}).get("flops")
    gflop = None if flops is None else flops / 1e9
    began = time.perf_counter()
    update = lowered.compile()
    compile_s, seconds = time.perf_counter() - began, []
    planned = update.memory_analysis()
    with alone():
        for _ in range(updates):
            began = time.perf_counter()
            state, metrics = jax.block_until_ready(update(state, batch))
            seconds.append(time.perf_counter() - began)
    update_s = float(np.median(seconds[1:]))  # the first touches fresh memory
    used = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return {
        "compile_s": compile_s,
        "update_s": update_s,
        "least_s": float(min(seconds[1:])),
        "examples_per_s": batch_size / update_s,
        "gflop": gflop,
        "of_peak": None if gflop is None else gflop / update_s / (1e3 * peak),
        "planned_gib": (planned.argument_size_in_bytes + planned.temp_size_in_bytes) / 2**30,
        "peak_gib": None if used is None else used / 2**30,
        "finite": bool(metrics["finite"]),
    }


def run(
    out: Path,
    models: Sequence[str] = tuple(CONFIGS),
    *,
    batch_size: int = 1,
    precision: Precision = "bfloat16",
    remat: bool = False,
    kind: str = "h100",
    tiny: bool = False,
) -> dict[str, Any]:
    """Measure the models, print the table, and write `gpu_steps.json` and `.md` into `out`."""
    peak = getattr(ACCELERATORS[kind], precision)
    accelerators.leave_to_workers()
    settings_of_jax = partial(configure_jax, keep_programs=False)  # compiling is timed
    with ProcessPoolExecutor(len(models), multiprocessing.get_context("spawn"), settings_of_jax) as processes:
        begun = {}
        for model in models:
            config = configuration(model, precision, remat=remat, tiny=tiny)
            begun[processes.submit(measured, config, batch_size, 3 if tiny else UPDATES, peak)] = model
        rows = {}
        for found in as_completed(begun):
            rows[begun[found]] = found.result()
            print(begun[found], found.result(), flush=True)
    settings = {"batch_size": batch_size, "precision": precision, "remat": remat, "kind": kind, "tiny": tiny}
    record = machine() | {"device": jax.devices()[0].device_kind, "settings": settings, "models": rows}
    header = ["model", "compile s", "ms an update", "examples/s", "GFLOP", "of peak", "peak GiB", "planned GiB"]
    text = markdown_table(header, [_row(name, rows[name]) for name in models])
    print(text)
    save(out, "gpu_steps", record, text)
    return record


def _row(name: str, found: dict[str, Any]) -> list[str]:
    def cell(name: str, form: str) -> str:
        return "-" if found[name] is None else f"{found[name]:{form}}"

    return [
        name,
        f"{found['compile_s']:.0f}",
        f"{1e3 * found['update_s']:.1f}",
        f"{found['examples_per_s']:.1f}",
        cell("gflop", ",.0f"),
        cell("of_peak", ".1%"),
        cell("peak_gib", ".2f"),
        f"{found['planned_gib']:.2f}",
    ]


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__)
    parser.add_argument("--models", nargs="+", choices=CONFIGS, default=list(CONFIGS))
    parser.add_argument("--batch", type=int, default=1, help="examples of an update (default 1)")
    parser.add_argument("--precision", choices=["float32", "bfloat16"], default="bfloat16")
    parser.add_argument("--remat", action="store_true", help="recompute activations for the gradient")
    parser.add_argument(
        "--kind", choices=ACCELERATORS, default="h100", help="whose peak is compared with (default h100)"
    )
    parser.add_argument("--tiny", action="store_true", help="small models, for a CPU")
    o = parser.parse_args()
    run(o.out, o.models, batch_size=o.batch, precision=o.precision, remat=o.remat, kind=o.kind, tiny=o.tiny)


if __name__ == "__main__":
    main()
