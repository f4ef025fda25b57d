"""Train every shipped configuration for a few steps in two checkouts on this machine; compare all numbers bit by bit.

    python -m tests.same_losses ../before                      # 50 steps of every configuration: hours on one core
    python -m tests.same_losses ../before tf_lane camera.toponet --steps 20

For a change that must not change a number: check out the state before it (`git worktree add ../before HEAD`), then
compare. Nothing is recorded, because results are bit-identical only on one machine with one number of cores. Data sets
are cut to a few scenes, and models of the papers' sizes make three steps on small images; models and losses are whole.
Runs that are complete are not repeated, so that the command can be stopped and given again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.test_config import ROOT, shipped

_FEW_SCENES = ["--data.train", "8", "--data.val", "1", "--data.test", "1"]
_PAPER_SIZE_STEPS = 3
_PAPER_SIZE_ON_THE_WORLD = ("tf_lane.maptr_r50", "tf_lane.maptrv2_r50")
# Data to be exported, in more cameras than the model beside them has; the paper-size models train on them.
_DATA_ONLY = ("camera.native_ring",)
_TRAIN_LOG = "adcf7d18-0510-35b0-a2fa-b4cea13a6d76"
_TEST_LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def arguments_of(name: str, steps: int, exported: Path) -> list[str]:
    """Return the settings that make a configuration small; only such as every version has."""
    paper_size = "_r50" in name
    steps = min(steps, _PAPER_SIZE_STEPS) if paper_size else steps
    batch = "1" if paper_size else "2"
    arguments = ["--training.steps", str(steps), "--training.log_every", "1", "--training.batch_size", batch]
    arguments += ["--training.eval_every", str(steps), "--training.checkpoint_every", str(steps)]
    arguments += ["--evaluation.pictures", "0", "--optim.warmup_steps", "1"]
    if paper_size:  # frozen stages need weights to start from, which are not at hand
        arguments += ["--task.model.encoder.images.frozen_stages", "0"]
    if name.startswith(_PAPER_SIZE_ON_THE_WORLD):
        scale = ["--data.example.cameras.scale", "0.1", "--optim.epoch_steps", "0"]
        return [*arguments, *_FEW_SCENES, *scale]
    if paper_size:
        arguments += ["--optim.epoch_steps", "0", "--data.root", str(exported), "--data.image.scale", "1.0"]
        if name.startswith("markers."):  # exported scenes have two frames
            arguments += ["--training.init_from", "None", "--task.clip", "2", "--data.example.sd_map", "None"]
        return [*arguments, "--data.image.front_rows", "None", "--data.image.front_size", "None"]
    if name.startswith("markers."):
        arguments += ["--training.init_from", "None"]
    return arguments + (_real_data(name) or _FEW_SCENES)


def _real_data(name: str) -> list[str]:
    """Return the settings that name the folders of a configuration on real data; none for the built-in world."""
    data = _shared() / "data"
    if name in ("gtn_lane.lstr", "gtn_lane.overfit"):
        return ["--data.root", str(data / "tusimple" / "LaneDetection")]
    if name == "tf_lane.argoverse2":
        logs = data / "argoverse2" / "sensor" / "val"
        train, test = str(logs / _TRAIN_LOG), str(logs / _TEST_LOG)
        splits = ["--data.train", train, "--data.val", test, "--data.test", test]
        return [*splits, "--data.openlane", str(data / "openlanev2")]
    return []


def run(checkout: Path, arguments: list[str], log: Path) -> bool:
    """Run `tflane` of a checkout and return whether that went well; its messages go to a file."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "TFLANE_SHARED": str(_shared())}
    command = [sys.executable, "-m", "tflane_jax.cli", *arguments]
    with log.open("w", encoding="utf-8") as file:
        return subprocess.run(command, cwd=checkout, env=environment, stdout=file, stderr=file).returncode == 0


def _shared() -> Path:
    return Path(os.environ.get("TFLANE_SHARED", ROOT.parent / "shared")).resolve()


def numbers_of(checkout: Path, name: str, reference: str, steps: int, out: Path) -> list[dict] | None:
    """Return the records of a training, which is made where it is missing; None where it failed."""
    folder = out / f"{name}-{steps}"
    records = folder / "metrics.jsonl"
    if not (folder / "complete").exists():
        shutil.rmtree(folder, ignore_errors=True)
        out.mkdir(parents=True, exist_ok=True)
        exported = out / "exported"
        if "_r50" in name and not exported.exists():
            export = ["data", "export", "--config", "configs/camera/native_ring.py", "--out", str(exported)]
            if not run(checkout, [*export, "--data.example.cameras.scale", "0.1"], out / "exported.log"):
                return None
        train = ["train", "--config", reference, "--out", str(folder), *arguments_of(name, steps, exported)]
        if not run(checkout, train, out / f"{name}.log"):
            return None
        (folder / "complete").touch()
    lines = records.read_text(encoding="utf-8").splitlines()
    return [{k: v for k, v in json.loads(line).items() if k not in ("seconds", "waiting")} for line in lines]


def difference(before: list[dict], after: list[dict]) -> str:
    """Return the first number that differs, "" where none does; numbers that only one side has are not compared."""
    for old, new in zip(before, after, strict=False):
        for key in sorted(old.keys() & new.keys()):
            if old[key] != new[key] and not (old[key] != old[key] and new[key] != new[key]):  # NaN equals NaN
                return f"{old['split']} step {old['step']}, {key}: {old[key]!r} before, {new[key]!r} after"
    return "" if len(before) == len(after) else f"{len(before)} records before, {len(after)} after"


def main() -> int:
    """Compare, print a line for each configuration, and return 1 where one differs or fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="checkout of the state before the change")
    parser.add_argument("names", nargs="*", help="beginnings of names, such as tf_lane.toponet_tfm.street; default all")
    parser.add_argument("--exact", action="store_true", help="take names as they are, not as beginnings")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "same_losses")
    parser.add_argument("--only", choices=("before", "after"), help="make the runs of one side, compare nothing")
    options = parser.parse_intermixed_args()
    wrong = 0
    for name, reference in shipped().items():
        chosen = name in options.names if options.exact else name.startswith(tuple(options.names))
        if not reference or name in _DATA_ONLY or (options.names and not chosen):
            continue
        sides = {}
        for side, checkout in (("before", options.before.resolve()), ("after", ROOT)):
            if options.only in (None, side):
                sides[side] = numbers_of(checkout, name, reference, options.steps, options.out.resolve() / side)
        failed = [side for side, records in sides.items() if records is None]
        if failed:
            verdict = f"FAILED {', '.join(failed)}: see {options.out / failed[0] / name}.log"
        elif options.only:
            verdict = "done"
        else:
            verdict = difference(sides["before"], sides["after"]) or "same"  # pyright: ignore[reportArgumentType]
        wrong += verdict not in ("same", "done")
        print(f"{name}: {verdict}", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
