"""Loading: examples a second that reach the update step, from memory and from disk, by number of workers.

    python -m benchmarks.loading --out runs/bench
    python -m benchmarks.loading --out runs/bench --cases native --no-updates    # loading alone

Three data sets are written into a temporary folder and loaded as `tflane train` loads them, batches on the device:

- photos: TuSimple's layout, JPEGs of 1280 x 720, augmented; LSTR with the GTN encoder at its full size.
- cameras: six small cameras of the built-in world, from the cache; the small TopoNet with cameras.
- native: OpenLane-V2's layout, seven JPEGs of 2048 x 1550 a frame, photometric distortion; no update, because one of
  the paper's size takes minutes on a CPU. `benchmarks.gpu.steps` measures it on an accelerator.

Files stay in the system's page cache, so that reading costs decoding and copying, not the disk. A program makes some
batches from the start to the end of its workers and does nothing else meanwhile; updates run on their own. Programs of
a case run in turn (`benchmarks.timing`). The ratio is the time that an update takes for an example, divided by the time
that loading takes for one: above 1, loading keeps up if it has cores of its own. It takes about four minutes of CPU
time, most of them for compiling the updates.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.timing import Compiled, Program, command_line, interleave, machine, markdown_table, save
from tflane_jax.config import RunConfig, load_config
from tflane_jax.datasets import sources
from tflane_jax.datasets.batches import batches, first_example, in_workers
from tflane_jax.datasets.front_views import FrontViewConfig, FrontViewDataset
from tflane_jax.datasets.lane_rows import row_lanes
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.files.images import opencv
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training.schedule import make_optimizer
from tflane_jax.training.state import init_states
from tflane_jax.training.step import compiled_update, update_all

WORKERS = (0, 1, 2)
UPDATE = "update"
STEPS = 1000  # of the run that an update belongs to; its time does not depend on it


class Case(NamedTuple):
    """A data set with its model.

    Attributes:
        config: its training split is loaded.
        batch: examples of a batch.
        batches: of a measurement.
        update: whether an update is measured.
    """

    config: RunConfig
    batch: int
    batches: int
    update: bool = True


def photos(folder: Path, *, tiny: bool = False) -> Case:
    """Write labelled photos of the size of TuSimple's, and return the case."""
    count, height, width = (4, 72, 128) if tiny else (16, 720, 1280)
    world = FrontViewConfig().world
    world = replace(world, camera=replace(world.camera, height=height, width=width))
    views, records = FrontViewDataset(FrontViewConfig(images=count, world=world)), []
    for index in range(count):
        example, name = views.example(index), f"clips/{index}/20.jpg"
        (folder / name).parent.mkdir(parents=True)
        opencv().imwrite(str(folder / name), np.asarray(example.image)[..., ::-1])
        lanes = row_lanes(example.lines)
        assert lanes.rows is not None
        rows = lanes.rows.astype(int).tolist()
        records.append({"raw_file": name, "lanes": lanes.x.round().astype(int).tolist(), "h_samples": rows})
    (folder / "label_data_0313.json").write_text("".join(json.dumps(record) + "\n" for record in records))
    config = load_config("gtn_lane/gtn_tusimple")
    data: Any = config.data
    return Case(replace(config, data=replace(data, root=folder, train="all")), 2 if tiny else 4, 4)


def cameras(folder: Path, *, tiny: bool = False) -> Case:
    """Return the case of the small cameras; loading it fills the cache below `folder`."""
    config = load_config("camera/toponet")
    data: Any = config.data
    return Case(replace(config, data=replace(data, train=1 if tiny else 6)), config.training.batch_size, 6)


def native(folder: Path, *, tiny: bool = False) -> Case:
    """Write two frames of seven large cameras, and return the case."""
    data: Any = load_config("camera/native_ring").data
    if tiny:
        data = replace(data, example=replace(data.example, cameras=replace(data.example.cameras, scale=0.05)))
    drawn = sources.make_dataset(replace(data, train=1).source("train"))
    export_openlane_v2({"train": drawn}, folder / "world", progress=False)
    config = load_config("camera/toponet_r50")
    data = config.data
    data = replace(data, root=folder / "world")
    if tiny:
        data = replace(data, image=replace(data.image, front_rows=None))
    return Case(replace(config, data=data), 2, 1, update=False)


CASES: dict[str, Callable[..., Case]] = {"photos": photos, "cameras": cameras, "native": native}


def forms(case: Case) -> dict[tuple[str, int], Any]:
    """Return the training examples by where they are and by number of workers, as `tflane train` takes them.

    Workers touch examples in memory only to augment them.
    """
    task: Any = case.config.task
    source: Any = task.training_form(case.config.data.source("train"), case.config.data)

    def loaded(loading: StreamingConfig) -> Any:
        return task.examples(task.load(replace(source, loading=loading), progress=False))

    kept = loaded(StreamingConfig(where="memory"))
    augmented = task.prepare(case.config.data) is not None
    found = {("memory", n): in_workers(kept, StreamingConfig(threads=n)) for n in (WORKERS if augmented else (0,))}
    return found | {("disk", n): loaded(StreamingConfig(where="disk", threads=n)) for n in WORKERS}


def loads(case: Case, arrays: Any) -> Iterator[Any]:
    """Yield the batches of a measurement."""
    prepare = case.config.task.prepare(case.config.data)
    for [batch] in batches(arrays, (0,), range(case.batches), case.batch, prepare):
        yield jax.block_until_ready(batch)


def updates(case: Case, batch: Any) -> Compiled:
    """Return the update of a training; every call goes on from the one before."""
    task, optim = case.config.task, replace(case.config.optim, warmup_steps=0, epoch_steps=0, lr_factors=())
    states = init_states(task, make_optimizer(optim, STEPS), [0], jax.tree.map(lambda leaf: leaf[0], batch))
    began = time.perf_counter()
    update = compiled_update(task, optim, STEPS, states[0], batch)
    seconds = time.perf_counter() - began

    def step() -> None:
        nonlocal states
        states, _ = update_all(update, states, [batch])

    return Compiled(step, seconds)


def measured(case: Case, seconds: float, *, with_update: bool = True) -> dict[str, Any]:
    """Return rates of all forms, by name, and of the update, after checking that all forms give the same batches."""
    found = forms(case)
    first = [jax.device_get(next(loads(case, arrays))) for arrays in found.values()]
    for other in first[1:]:
        jax.tree.map(np.testing.assert_array_equal, first[0], other)

    def program(arrays: Any) -> Program:
        return lambda: [None for _ in loads(case, arrays)]

    programs = {f"{where} {workers}": program(arrays) for (where, workers), arrays in found.items()}
    compile_s = None
    if with_update and case.update:
        programs[UPDATE], compile_s = updates(case, jax.device_put(first[0]))
    times = interleave(programs, seconds)
    each = {key: values / case.batch / (1 if key == UPDATE else case.batches) for key, values in times.items()}
    rows = []
    for key, values in each.items():
        where, _, workers = key.partition(" ")
        ratio = float(np.median(each[UPDATE] / values)) if UPDATE in each else None
        rate = 1.0 / float(np.median(values))
        rows.append({"examples": where, "workers": workers, "examples_per_s": rate, "ratio": ratio})
    example = first_example(found["memory", 0])
    size = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(example))
    rounds = len(times["memory 0"])
    return {"rows": rows, "batch": case.batch, "mib": size / 2**20, "rounds": rounds, "compile_s": compile_s}


@contextmanager
def cache_in(folder: Path) -> Iterator[None]:
    """Keep generated examples below a folder for as long as the block lasts."""
    before = os.environ.get("TFLANE_CACHE")
    os.environ["TFLANE_CACHE"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["TFLANE_CACHE"]
        else:
            os.environ["TFLANE_CACHE"] = before


def run(
    out: Path,
    names: Sequence[str] = tuple(CASES),
    *,
    seconds: float = 8.0,
    with_updates: bool = True,
    tiny: bool = False,
) -> dict[str, Any]:
    """Measure the cases, print the table, write `loading.json` and `loading.md` into `out`, and return the record.

    Args:
        out: folder.
        names: of `CASES`.
        seconds: of each case, at least three rounds.
        with_updates: whether updates are compiled and measured.
        tiny: small images, to show that it starts.
    """
    configure_jax()
    results = {}
    for name in names:
        with tempfile.TemporaryDirectory() as folder, cache_in(Path(folder) / "cache"):
            case = CASES[name](Path(folder), tiny=tiny)
            results[name] = measured(case, seconds, with_update=with_updates)
        print(f"{name} done", flush=True)
    rows = [
        [
            f"{name}, {row['examples']}",
            row["workers"] or "-",
            f"{row['examples_per_s']:.1f}",
            "-" if row["ratio"] is None else f"{row['ratio']:.2f}",
        ]
        for name, found in results.items()
        for row in found["rows"]
    ]
    table = markdown_table(["examples", "workers", "examples/s", "ratio to the update"], rows)
    print(table)
    record = {"machine": machine(), "settings": {"seconds": seconds, "tiny": tiny}, "results": results}
    save(out, "loading", record, table)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, seconds=8.0)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--no-updates", action="store_true", help="loading alone, without compiling updates")
    parser.add_argument("--tiny", action="store_true", help="small images, to show that it starts")
    options = parser.parse_args()
    run(options.out, options.cases, seconds=options.seconds, with_updates=not options.no_updates, tiny=options.tiny)


if __name__ == "__main__":
    main()
