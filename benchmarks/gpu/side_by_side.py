"""How many updates of small trainings one GPU makes in a second, by the number of processes that share it.

    python -m benchmarks.gpu.side_by_side --out runs/bench
    python -m benchmarks.gpu.side_by_side --out runs/bench --configs tf_lane/toponet_tfm --processes 1 4
    python -m benchmarks.gpu.side_by_side --out runs/bench --fed --configs gtn_lane/table1:gtn
    python -m benchmarks.gpu.side_by_side --out runs/bench --tiny       # on a CPU, few updates: shows that it starts

A small model leaves most of a GPU idle: its kernels are short, and the host takes time to start each. Every process
trains as `tflane tables --jobs` lets workers train: it makes an update of one batch of invented numbers, fetches the
metrics, and goes on. With `--fed` each has one core, and gathers and augments the next batch meanwhile, as a training
does. The first process compiles, the others find its programs in the cache, and those that take part begin together.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.gpu.steps import invented
from benchmarks.gpu.turns import alone
from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax import accelerators
from tflane_jax.config import load_config
from tflane_jax.datasets.batches import batches
from tflane_jax.memory import keep_freed_memory
from tflane_jax.scene import shapes_of
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training.schedule import make_optimizer
from tflane_jax.training.state import init_states
from tflane_jax.training.step import compiled_update, update_all

CONFIGS = ("gtn_lane/table1:gtn", "tf_lane/toponet_tfm")
PROCESSES = (1, 2, 4, 8, 14)
_WARM_UP = 10
_EXAMPLES = 64


class _Trainer:
    """A training of one seed: it repeats one batch, or gathers and augments the next one while an update runs."""

    def __init__(self, name: str, seed: int, *, fed: bool) -> None:
        config = load_config(name)
        task, steps, size = config.task, 1000, config.training.batch_size
        example = invented(task.shapes(config.data), seed)
        batch = invented(shapes_of(example, size), seed)
        self._batches: Iterator[Any] = itertools.repeat([jax.device_put(batch)])
        if fed:
            examples = invented(shapes_of(example, _EXAMPLES), seed)
            self._batches = batches(examples, [seed], range(10**6), size, task.prepare(config.data))
        optim = replace(config.optim, warmup_steps=0, epoch_steps=0, lr_factors=(), restarts=None)
        self._states = init_states(task, make_optimizer(optim, steps), [seed], example)
        self._update = compiled_update(task, optim, steps, self._states[0], batch)

    def updates(self, count: int) -> None:
        """Make some updates; their metrics are fetched one after the other."""
        for batch in itertools.islice(self._batches, count):
            self._states, _ = update_all(self._update, self._states, batch)


def _train(place: int, environment: dict[str, str], configs: Sequence[str], fed: bool, pipe: Any, start: Any) -> None:
    """Compile all configurations; then, as often as asked, make updates together with the others that take part."""
    os.environ |= environment
    if fed:
        keep_freed_memory()
        every = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, [every[place % len(every)]])
    configure_jax()
    began = time.perf_counter()
    trainers = [_Trainer(name, place, fed=fed) for name in configs]
    pipe.send(time.perf_counter() - began)
    while (asked := pipe.recv()) is not None:
        which, count = asked
        trainers[which].updates(_WARM_UP)
        pipe.send("warm")
        start.acquire()
        began = time.perf_counter()
        trainers[which].updates(count)
        pipe.send((began, time.perf_counter()))


def run(
    out: Path,
    configs: Sequence[str] = CONFIGS,
    processes: Sequence[int] = PROCESSES,
    *,
    updates: int = 200,
    fed: bool = False,
) -> dict[str, Any]:
    """Measure every configuration with every number of processes, print and write `gpu_side_by_side.json` and `.md`.

    Under MPS the files' names end in `_mps`, with batches that are gathered in `_fed`.
    """
    if found := accelerators.gpus():
        os.environ["CUDA_VISIBLE_DEVICES"] = found[0]
    accelerators.leave_to_workers()
    context, most = multiprocessing.get_context("spawn"), max(processes)
    start, pipes, workers, ready_s = context.Semaphore(0), [], [], []

    def begin(places: range) -> None:
        for place in places:
            near, far = context.Pipe()
            given = place, accelerators.of_worker(place, most), tuple(configs), fed, far, start
            workers.append(context.Process(target=_train, args=given, daemon=True))
            workers[-1].start()
            far.close()
            pipes.append(near)
        ready_s.extend(pipes[place].recv() for place in places)

    begin(range(1))
    begin(range(1, most))
    rows: dict[str, dict[str, float]] = {}
    with alone():
        for which, name in enumerate(configs):
            rows[name] = {str(n): _rate(pipes[:n], start, which, updates) for n in processes}
            print(name, rows[name], flush=True)
    for pipe in pipes:
        pipe.send(None)
    for worker in workers:
        worker.join()
    record = machine() | {
        "device": jax.devices()[0].device_kind,
        "shared_by": "MPS" if _mps() else "time slices",
        "updates": updates,
        "batches": "gathered and augmented, on one core of each process" if fed else "one, repeated",
        "ready_s": {"first": ready_s[0], "others": float(np.median(ready_s[1:])) if most > 1 else None},
        "updates_per_s": rows,
    }
    header = ["updates/s", *(f"{number} process{'es' * (number > 1)}" for number in processes)]
    text = markdown_table(header, [[name, *(f"{row[str(n)]:.1f}" for n in processes)] for name, row in rows.items()])
    print(text)
    save(out, "gpu_side_by_side" + "_mps" * _mps() + "_fed" * fed, record, text)
    return record


def _rate(pipes: Sequence[Any], start: Any, which: int, updates: int) -> float:
    """Return the updates in a second of all processes together, from the first one's start to the last one's end."""
    for pipe in pipes:
        pipe.send((which, updates))
    for pipe in pipes:
        pipe.recv()  # warm
    for _ in pipes:
        start.release()
    spans = [pipe.recv() for pipe in pipes]
    return len(pipes) * updates / (max(end for _, end in spans) - min(begun for begun, _ in spans))


def _mps() -> bool:
    """Return whether a server of NVIDIA's MPS lets kernels of several processes run at the same time."""
    folder = Path(os.environ.get("CUDA_MPS_PIPE_DIRECTORY", "/tmp/nvidia-mps"))
    return (folder / "control").exists()


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__)
    parser.add_argument("--configs", nargs="+", default=list(CONFIGS), metavar="CONFIG", help="what to train")
    parser.add_argument("--processes", nargs="+", type=int, default=list(PROCESSES), metavar="N", help="at a time")
    parser.add_argument("--updates", type=int, default=200, metavar="N", help="of each process (default 200)")
    parser.add_argument("--fed", action="store_true", help="gather and augment batches, on one core of each process")
    parser.add_argument("--tiny", action="store_true", help="one and two processes, few updates, for a CPU")
    o = parser.parse_args()
    if o.tiny:
        run(o.out, CONFIGS[:1], (1, 2), updates=3, fed=o.fed)
    else:
        run(o.out, o.configs, o.processes, updates=o.updates, fed=o.fed)


if __name__ == "__main__":
    main()
