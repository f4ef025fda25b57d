"""Train several configurations with several seeds, evaluate them alike, and say what the differences are worth.

Each training is a run folder of its own, `<out>/<model>/seed_<n>`: a comparison that was stopped goes on where it was,
and any run of it can be evaluated or drawn by itself.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from tflane_jax.ablations.comparison import Variant, compact, summarise
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import limit_instances, load_split, open_dataset, open_run, predict_examples, titles, train_run
from tflane_jax.scene import Example, stack_examples
from tflane_jax.training.evaluate import evaluate_lanes, scores
from tflane_jax.training.run_folder import write_json
from tflane_jax.training.runtime import configure_jax

_GROUPS = ("all", "occluded", "clear")
METRICS = tuple(f"{group}/{metric}" for metric in ("DET_l", "TOP_ll", "recall") for group in _GROUPS)


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        config: with exactly one seed.
        folder: of the run.
    """

    config: RunConfig
    folder: Path

    @property
    def log(self) -> Path:
        """What a training in a process of its own prints."""
        return self.folder.with_name(f"{self.folder.name}.log")


def compare(configs: dict[str, RunConfig], seeds: Sequence[int], out: Path, *, jobs: int = 1) -> Path:
    """Train what is not trained yet, evaluate on the test split, print and save tables and pictures.

    A model with traffic flow is evaluated a second time without any at inference (TF-Lane, Table 7). All runs are
    taken at their last step, so that no selection favours anyone.

    Args:
        configs: by the name that the table shows; the first one is what the others are compared with.
        seeds: of training; each model is trained with each.
        out: folder for everything.
        jobs: trainings at a time, each on its share of the cores.

    Returns:
        The Markdown file with the tables.

    Raises:
        UserError: the configurations do not test on the same examples, or a training failed.
    """
    if len({config.data.source("test") for config in configs.values()}) > 1:
        raise UserError("the configurations have different test data (data.test): their numbers cannot be compared")
    plan = {
        name: [
            Job(replace(config, training=replace(config.training, seeds=(seed,))), out / _slug(name) / f"seed_{seed}")
            for seed in seeds
        ]
        for name, config in configs.items()
    }
    for config in configs.values():  # before any worker starts, so that nobody builds the same data twice
        for split in ("train", "val", "test"):
            open_dataset(config.data.source(split))
    # Seed by seed, so that a comparison stopped early has pairs.
    train_all([plan[name][i] for i in range(len(seeds)) for name in plan], jobs)

    arrays = load_split(next(iter(configs.values())), "test")
    variants: list[Variant] = []
    protocol = ""
    for name, trainings in plan.items():
        measured, silent = [], []
        for job in tqdm(trainings, desc=f"evaluate {name}", unit="run"):
            protocol, values = _measure(job, arrays, None)
            measured.append(values)
            if job.config.task.model.traffic_flow is not None:
                silent.append(_measure(job, arrays, 0)[1])
        variants.append(Variant(name, tuple(measured)))
        if silent:
            variants.append(Variant(f"{name}, no traffic flow at inference", tuple(silent)))
    picture = draw_comparison({name: trainings[0] for name, trainings in plan.items()}, arrays, out / "comparison.png")
    return _report(variants, protocol, out, picture, seeds)


def train_all(jobs: Sequence[Job], parallel: int) -> None:
    """Train every job that is not complete; each in this process, or `parallel` at a time in processes of their own."""
    waiting = [job for job in jobs if _step(job.folder) < job.config.training.steps]
    if parallel == 1:
        for job in waiting:
            if train_run(job.config, job.folder, start=_start(job.folder)).stopped_by is not None:
                raise KeyboardInterrupt  # what is written goes on when the same command is given again
        return
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    context = multiprocessing.get_context("spawn")
    running: dict[int, tuple[Any, Job]] = {}
    total = sum(job.config.training.steps for job in jobs)
    with tqdm(total=total, desc=f"train {len(jobs)} runs", unit="step") as bar:
        while waiting or running:
            for slot in range(parallel):
                if slot not in running and waiting:
                    job = waiting.pop(0)
                    job.log.parent.mkdir(parents=True, exist_ok=True)
                    process = context.Process(target=_worker, args=(job, cores[slot::parallel]), daemon=True)
                    process.start()
                    running[slot] = process, job
            time.sleep(1.0)
            bar.update(sum(min(_step(job.folder), job.config.training.steps) for job in jobs) - bar.n)
            for slot, (process, job) in list(running.items()):
                if process.exitcode is not None:
                    del running[slot]
                    if process.exitcode != 0:
                        raise UserError(f"training {job.folder} failed: its messages are in {job.log}")


def _worker(job: Job, cores: list[int]) -> None:
    """Train in a process of its own: on its own cores, with its messages in a file."""
    if cores:
        os.sched_setaffinity(0, cores)  # XLA sizes its thread pool by this
    with job.log.open("a") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        configure_jax()
        try:
            result = train_run(job.config, job.folder, start=_start(job.folder), progress=False)
        except UserError as error:
            print(f"tflane: {error}")
            sys.exit(2)
    sys.exit(0 if result.stopped_by is None else 1)


def _start(folder: Path):
    return "resume" if (folder / "config.json").is_file() else "new"


def _step(folder: Path) -> int:
    """Return how far a run's records reach, 0 where there are none."""
    try:
        lines = (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        return int(json.loads(lines[-1])["step"])
    except (FileNotFoundError, IndexError, ValueError):
        return 0


def _measure(job: Job, arrays: Example, max_instances: int | None) -> tuple[str, dict[str, float]]:
    run = open_run(job.folder, "last")
    task = run.config.task if max_instances is None else limit_instances(run.config.task, max_instances)
    metrics = evaluate_lanes(task, run.params[0], arrays, run.config.evaluation.batch_size)
    return metrics.protocol, scores(metrics)


def draw_comparison(models: dict[str, Job], arrays: Example, path: Path, count: int = 6) -> Path | None:
    """Draw the test frames with the most hidden lanes, every model beside the truth; None without matplotlib."""
    try:
        from tflane_jax.plots import save_examples
    except UserError:
        return None
    source = next(iter(models.values())).config.data.source("test")
    dataset = open_dataset(source)
    hidden = (arrays.lanes.valid & (arrays.lanes.visibility < 0.5)).sum(-1)
    indices = np.argsort(-hidden, kind="stable")[:count].tolist()
    examples = stack_examples([dataset.example(index) for index in indices])
    lanes = {}
    for name, job in models.items():
        run = open_run(job.folder, "last")
        _, lanes[name] = predict_examples(run.config.task, run.params[0], dataset, indices)
    save_examples(
        path, examples, lanes, titles=titles(dataset, indices),
        ground=source.example.sensor.grid.range, view=source.example.range,
    )  # fmt: skip
    return path


def _report(
    variants: list[Variant], protocol: str, out: Path, picture: Path | None, seeds: Sequence[int]
) -> Path:
    """Print the tables and save them beside the pictures."""
    title = f"{protocol}, test split, {len(seeds)} seed{'s' if len(seeds) > 1 else ''}, percent (mean ± std)"
    print("\n" + format_table(compact(variants, METRICS), title=title))
    markdown, _ = save_table(
        out / "table", compact(variants, METRICS), {"protocol": protocol, "seeds": list(seeds)}, title=title
    )
    written = [markdown]
    if len(seeds) > 1:
        rows = summarise(variants, METRICS)
        title = f"{protocol}: paired differences to {variants[0].name}, two-sided t-test over {len(seeds)} seeds"
        print("\n" + format_table(rows, title=title, digits=4))
        written.append(save_table(out / "paired", rows, {"protocol": protocol}, title=title, digits=4)[0])
    write_json(out / "scores.json", {variant.name: list(variant.scores) for variant in variants})
    written += [out / "scores.json"] + ([picture] if picture else [])
    print("\nwritten:", *written, sep="\n  ")
    return markdown


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name.lower()).strip("_")
