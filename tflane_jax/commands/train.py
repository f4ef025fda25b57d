"""`tflane train`."""

from __future__ import annotations

import argparse
import contextlib
import shlex
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from tflane_jax import processes
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_files import split_reference
from tflane_jax.config_help import explained
from tflane_jax.config_io import from_json, to_json
from tflane_jax.config_overrides import apply_overrides, batch_notices, unread_notices
from tflane_jax.errors import UserError
from tflane_jax.evaluation.predict import undivided_notices
from tflane_jax.files.wording import counted
from tflane_jax.own_modules import imports_of
from tflane_jax.plots.tables import format_table
from tflane_jax.progress import write
from tflane_jax.runs import resumable_config, train_run
from tflane_jax.training.notices import print_notices
from tflane_jax.training.runtime import configure_jax

_NOT_BEGUN = " before the run began: give the same command again"


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Train, or print the help."""
    if options.wants_help:
        print(options.usage)
        if options.config:
            print(f"settings of {options.config}:\n\n{explained(load_config(options.config))}")
        return 0
    if options.config is None and options.start != "resume":
        raise UserError("say what to train: --config FILE (or a name, say tf_lane/toponet), or --resume with --out RUN")
    configure_jax()  # before the first look at the devices, which starts JAX's backend
    if options.distributed or (options.coordinator, options.processes, options.process) != (None, None, None):
        processes.join(options.coordinator, options.processes, options.process)
    with processes.leaving():
        return _trained(options, overrides)


def _trained(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    _agree_on_start(options)
    out = options.out or _default_folder(options.config)
    config = _config(options, out, overrides)
    _print_devices()
    if processes.is_first():
        print_notices(undivided_notices(config.task, config.evaluation.batch_size))
    before, own = _saved_at(out), imports_of(config)
    resume = f"go on with: tflane train --resume --out {shlex.quote(str(out))}{own}"
    try:
        result = train_run(config, out, start=options.start)
    except KeyboardInterrupt as error:
        number = getattr(error, "number", signal.SIGINT)
        began = options.start == "resume" or _saved_at(out) not in (None, before)
        remedy = f"; {resume}" if began else _NOT_BEGUN
        print(f"stopped by {signal.Signals(number).name}{remedy}", file=sys.stderr)
        processes.end_alone(128 + number)
        return 128 + number
    if result.stopped_by is not None:
        name = signal.Signals(result.stopped_by).name
        print(f"stopped by {name} after step {result.step}; {resume}", file=sys.stderr)
        return 128 + result.stopped_by
    if not processes.is_first():
        return 0
    print(
        f"{out}: {counted(result.step, 'step')}, {result.steps_per_second:.2f} steps/s, "
        f"compiled in {result.compile_seconds:.1f} s"
    )
    if result.metrics:
        several = f", mean of {len(config.training.seeds)} seeds" if len(config.training.seeds) > 1 else ""
        print("\n" + score_table(result.metrics, f"last evaluation, validation split{several}") + "\n")
    if pictures := [str(path) for path in (out / "curves.png", out / "pictures") if path.exists()]:
        print(f"pictures: {', '.join(pictures)}")
    print(f"evaluate with: tflane eval {shlex.quote(str(out))}{own}")
    return 0


def _agree_on_start(options: argparse.Namespace) -> None:
    """Raise UserError, in all processes, where one starts in another way than the first.

    A process that reads --config exchanges other things next than one that resumes: each would wait for ever.
    """
    own = ["--config"] * (options.config is not None) + [f"--{options.start}"] * (options.start != "new")
    starts = processes.all_texts(" ".join(own))
    if others := [f"process {i} has {start}" for i, start in enumerate(starts) if start != starts[0]]:
        raise processes.AgreedError(
            f"process 0 has {starts[0]}, {', '.join(others)}: give all processes the same command; a script decides "
            "once for all of them whether to resume"
        )


def score_table(metrics: Mapping[str, float], title: str) -> str:
    """Return scores by "group/name" as a table with a row for each group.

    Scores at single thresholds ("recall@1.0") are left out: they are in metrics.jsonl.
    """
    groups: dict[str, dict[str, Any]] = {}
    for name, value in metrics.items():
        group, _, score = name.rpartition("/")
        if "@" not in score:
            groups.setdefault(group or "all", {})[score] = value
    return format_table([{"of": group} | scores for group, scores in groups.items()], title=title)


def _config(options: argparse.Namespace, out: Path, overrides: Sequence[str]) -> RunConfig:
    if options.config is not None:
        with processes.agreed():
            config = load_config(options.config)
            changed = apply_overrides(config, overrides)
        for notice in (*batch_notices(config, changed), *unread_notices(config, changed)):
            if processes.is_first():
                write(notice)
        return changed
    if overrides:
        raise UserError(
            f"a run is resumed with its own configuration: leave {overrides[0]} out (to train longer, or with "
            f"other settings, start another run with --training.init-from {out})"
        )
    return from_json(RunConfig, processes.from_first(lambda: to_json(resumable_config(out))))


def _print_devices() -> None:
    """Print how many devices share the training, and which: a missing one is noticed, and that a GPU is used."""
    number, devices = jax.process_count(), jax.devices()
    if processes.is_first() and (number > 1 or len(devices) > 1 or devices[0].platform != "cpu"):
        joined = f"{number} processes, " if number > 1 else ""
        write(f"{joined}{counted(len(devices), 'device')} ({devices[0].device_kind})")


def _saved_at(out: Path) -> int | None:
    """Return when the run in a folder began, None where there is none."""
    with contextlib.suppress(OSError):
        return (out / "config.json").stat().st_mtime_ns
    return None


def _default_folder(config: str | None) -> Path:
    if config is None:
        raise UserError("say which run to resume: --out RUN")
    path, ablation = split_reference(config)
    return Path("runs") / (f"{Path(path).stem}-{ablation}" if ablation else Path(path).stem)
