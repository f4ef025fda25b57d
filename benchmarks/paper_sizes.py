"""Updates at the papers' sizes: does each run, how long does it take, and how much memory does it need?

    python -m benchmarks.paper_sizes --out runs/bench
    python -m benchmarks.paper_sizes --out runs/bench --names tf_lane/lanesegnet_r50

Each configuration trains a few updates of one frame in a process of its own, with evaluation and checkpoint, on scenes
of the built-in world: those of OpenLane-V2 on a folder in its layout, with the tracks as Argoverse 2 logs, written to
`OUT/paper_sizes`; those of nuScenes on the world itself, with nuScenes' ring of cameras. Takes some ten minutes a
configuration on two cores. LaneSegNet at the paper's size needs about 24 GiB, so its rows are `:remat`, which
recomputes the activations of the encoder; `--names` measures any other. A configuration that fails, for want of memory
for example, gets a row that says so.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax.cli import exit_code
from tflane_jax.cli import main as tflane
from tflane_jax.config import NuScenesData, OpenLaneV2Data, RunConfig, WorldData, load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.runs import train_run
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.records import read_records

CONFIGS = (
    "camera/toponet_r50",
    "tf_lane/toponet_tfm_r50",
    "tf_lane/lanesegnet_r50:remat",
    "tf_lane/lanesegnet_tfm_r50:remat",
    "tf_lane/lanesegnet_bucket_r50:remat",
    "tf_lane/maptr_r50",
    "tf_lane/maptr_tfm_r50",
    "tf_lane/maptrv2_r50",
    "tf_lane/maptrv2_tfm_r50",
)
UPDATES = 3
_MEASURED = "measured: "
# Of this process, on Linux.
_STATUS = Path("/proc/self/status")


def measurable(name: str) -> RunConfig:
    """Return a configuration; one on nuScenes with the built-in world instead, in images of the same size.

    The world has no CAN bus; its numbers, zeros or not, cost the same.
    """
    config = load_config(name)
    if not isinstance(config.data, NuScenesData):
        return config
    ring, wanted = load_config("tf_lane/maptr_r50").data, config.data.example
    assert isinstance(ring, WorldData)
    example = replace(ring.example, history_hz=wanted.history_hz, tracks=wanted.tracks, map_lines=wanted.map_lines)
    data = replace(WorldData.city(), example=example)
    assert isinstance(config.task, LaneGraphTask)
    model = config.task.model
    assert isinstance(model.encoder, CameraEncoderConfig)
    if isinstance(model.encoder.bev, BevFormerConfig):
        bev = replace(model.encoder.bev, motion="moved")
        model = replace(model, encoder=replace(model.encoder, bev=bev))
    return replace(config, task=replace(config.task, model=model), data=data)


def settings(config: RunConfig, folder: Path) -> list[str]:
    """Return the settings of a short training of one frame a step on the data in `folder`."""
    count = str(UPDATES)
    short = {
        "training.batch_size": "1",
        "training.steps": count,
        "training.log_every": "1",
        "training.eval_every": count,
        "training.checkpoint_every": count,
        "optim.epoch_steps": "0",
        "optim.warmup_steps": "0",
        "evaluation.batch_size": "1",
        "evaluation.pictures": "0",
    }
    if config.task.frozen:
        short["task.model.encoder.images.frozen_stages"] = "0"
    if isinstance(config.data, OpenLaneV2Data):
        short["data.root"] = str(folder / "openlane_v2")
        if config.data.tracks is not None:
            short["data.tracks"] = str(folder / "argoverse2")
    else:
        short |= {"data.train": "1", "data.val": "1", "data.test": "1"}
    return [part for name, value in short.items() for part in (f"--{name}", value)]


def train(name: str, folder: Path) -> dict[str, Any]:
    """Train a configuration in this process and return what it took."""
    config = measurable(name)
    run = folder / "runs" / re.sub("[/:]", "_", name)
    result = train_run(apply_overrides(config, settings(config, folder)), run, start="overwrite")
    records = [record for record in read_records(run / "metrics.jsonl") if record["split"] == "train"]
    seconds = [record["seconds"] for record in records]
    return {
        "compile_s": result.compile_seconds,
        "update_s": (seconds[-1] - seconds[0]) / (len(seconds) - 1),  # the first touches fresh memory
        "peak_gib": _peak_gib(),
        "loss": [record["loss"] for record in records],
        "grad_norm": [record["grad_norm"] for record in records],
    }


def _peak_gib() -> float:
    """Return the most memory that this process has held; `ru_maxrss` would begin with that of the one it came from."""
    status = _STATUS.read_text(encoding="utf-8")
    return int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) / 2**20


def measured(name: str, folder: Path) -> dict[str, Any]:
    """Train a configuration in a process of its own; return what it took, or why it failed."""
    command = [sys.executable, "-m", "benchmarks.paper_sizes", "--out", str(folder), "--child", name]
    child = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    found = [line for line in child.stdout.splitlines() if line.startswith(_MEASURED)]
    if child.returncode or not found:
        killed = child.returncode < 0
        return {"failed": f"killed by signal {-child.returncode}" if killed else f"code {child.returncode}"}
    return json.loads(found[-1].removeprefix(_MEASURED))


def run(out: Path, names: Sequence[str] = CONFIGS) -> dict[str, Any]:
    """Measure the configurations; after each, print the table and write `paper_sizes.json` and `.md` into `out`."""
    if not _STATUS.exists():
        raise UserError(f"the memory of a training is read from {_STATUS}, which this system does not have")
    folder = out / "paper_sizes"
    if any(isinstance(load_config(name).data, OpenLaneV2Data) for name in names):
        written = ["--out", str(folder / "openlane_v2"), "--tracks", str(folder / "argoverse2")]
        if not (folder / "openlane_v2").exists() and tflane(["data", "export", "--config", _WORLD, *written]):
            raise SystemExit(2)
    header, found = ["configuration", "compile s", "s an update", "peak GiB", "loss"], {}
    record = machine() | {"updates": UPDATES, "configs": found}
    for name in names:
        found[name] = measured(name, folder)
        text = markdown_table(header, [_row(*one) for one in found.items()])
        print(text, flush=True)
        save(out, "paper_sizes", record, text)  # after each, because the next may take hours
    return record


_WORLD = "camera/native_ring"


def _row(name: str, found: dict[str, Any]) -> list[str]:
    if "failed" in found:
        return [name, "", "", "", found["failed"]]
    shown = (found["compile_s"], found["update_s"], found["peak_gib"], found["loss"][-1])
    return [name, *(f"{value:.1f}" for value in shown)]


def main() -> int:
    """Parse the command line and run; return the exit code."""
    parser = command_line(__doc__)
    parser.add_argument("--names", nargs="+", default=CONFIGS, help="configurations")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        print(_MEASURED + json.dumps(train(options.child, options.out)))
    else:
        run(options.out, options.names)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
