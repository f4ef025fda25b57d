"""Train several configurations with several seeds, evaluate them alike, and say what the differences are worth.

Each training is a run folder of its own, `<out>/<model>/seed_<n>`: a comparison that was stopped goes on where it was,
and any run of it can be evaluated or drawn by itself.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import multiprocessing
import os
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tflane_jax.ablations.comparison import Variant, compact, summarise
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import open_run, train_run
from tflane_jax.tasks import Model, System, load_test_data, system_of
from tflane_jax.training.runtime import configure_jax


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

    What can be used in several ways is listed with each (traffic flow: with and without it at inference). All runs
    are taken at their last step, so that no selection favours anyone.

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
    first = next(iter(configs.values()))
    source, system = first.data.source("test"), system_of(first)
    if any(config.data.source("test") != source for config in configs.values()):
        raise UserError("the configurations have different test data (data.test): their numbers cannot be compared")
    plan = {
        name: [
            Job(replace(config, training=replace(config.training, seeds=(seed,))), out / _slug(name) / f"seed_{seed}")
            for seed in seeds
        ]
        for name, config in configs.items()
    }
    # Before any worker starts, so that nobody builds the same data twice.
    for each in {config.data.source(split) for config in configs.values() for split in ("train", "val", "test")}:
        system.load(each)
    # Seed by seed, so that a comparison stopped early has pairs.
    train_all([plan[name][i] for i in range(len(seeds)) for name in plan], jobs)

    variants: list[Variant] = []
    remarks: dict[str, dict[str, str]] = {}
    models: dict[str, Model] = {}
    protocol = ""
    for name, trainings in plan.items():
        measured: dict[str, list[dict[str, float]]] = {}
        for job in tqdm(trainings, desc=f"evaluate {name}", unit="run"):
            found = _measured(job)
            protocol = found["protocol"]
            for way, scores in found["ways"].items():
                measured.setdefault(f"{name}, {way}" if way else name, []).append(scores)
        run = open_run(trainings[0].folder, "last")
        models[name] = Model(run.config.task, run.params[0])
        remarks[name] = system.remarks(models[name])
        variants += [Variant(way, tuple(scores)) for way, scores in measured.items()]
    picture = None
    if importlib.util.find_spec("matplotlib") is not None:
        picture = system.draw_comparison(models, source, load_test_data(first), out / "comparison.png")
    return _report(system, variants, remarks, protocol, out, picture, seeds)


def _measured(job: Job) -> dict[str, Any]:
    """Return the protocol and the scores of each way to use a run, at its last step; measured once, kept beside it."""
    path, source = job.folder.with_name(f"{job.folder.name}.scores.json"), job.config.data.source("test")
    # Of which run and data: it may have been trained anew since, or the test split be another.
    of = [_step(job.folder), (job.folder / "config.json").stat().st_mtime_ns, repr(source)]
    with contextlib.suppress(FileNotFoundError, ValueError, KeyError):
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["of"] == of:
            return kept
    run = open_run(job.folder, "last")
    system, task, params = system_of(job.config), run.config.task, run.params[0]
    data, ways = load_test_data(job.config), {"": task} | system.inference_variants(task)
    every = {way: system.evaluate(used, params, data, run.config.evaluation.batch_size) for way, used in ways.items()}
    found = {"of": of, "protocol": every[""].protocol, "ways": {way: one.scores() for way, one in every.items()}}
    write_json(path, found)
    return found


def train_all(jobs: Sequence[Job], parallel: int) -> None:
    """Train every job that is not complete; each in this process, or `parallel` at a time in processes of their own."""
    waiting = [job for job in jobs if _step(job.folder) < job.config.training.steps]
    if parallel == 1:
        for job in waiting:
            if train_run(job.config, job.folder, start=_start(job.folder)).stopped_by is not None:
                raise KeyboardInterrupt  # what is written goes on when the same command is given again
        return
    with contextlib.ExitStack() as stack:
        workers = [stack.enter_context(_Worker(slot, parallel)) for slot in range(parallel)]
        total = sum(job.config.training.steps for job in jobs)
        bar = stack.enter_context(tqdm(total=total, desc=f"train {len(jobs)} runs", unit="step"))
        while waiting or any(worker.job for worker in workers):
            for worker in workers:
                if worker.job is None and waiting:
                    others = {task for other in workers if other is not worker for task in other.tasks}
                    # A worker goes on with models that it has compiled; with another's when nothing else is left.
                    chosen = next((job for job in waiting if job.config.task not in others - worker.tasks), waiting[0])
                    waiting.remove(chosen)
                    worker.begin(chosen)
            time.sleep(1.0)
            bar.update(sum(min(_step(job.folder), job.config.training.steps) for job in jobs) - bar.n)
            for worker in workers:
                worker.check()


class _Worker:
    """A process on its own cores that trains one job after the other, and compiles every model once."""

    def __init__(self, slot: int, parallel: int) -> None:
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        context = multiprocessing.get_context("spawn")
        self._pipe, far = context.Pipe()
        self._process: Any = context.Process(target=_train_jobs, args=(far, cores[slot::parallel]), daemon=True)
        self.job: Job | None = None
        self.tasks: set[Any] = set()

    def __enter__(self) -> _Worker:
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.job is None and self._process.exitcode is None:
            self._pipe.send(None)
        else:  # an error is on its way: what is written goes on when the same command is given again
            self._process.terminate()
        self._process.join()

    def begin(self, job: Job) -> None:
        """Let the process train a job."""
        self.job = job
        self.tasks.add(job.config.task)
        job.log.parent.mkdir(parents=True, exist_ok=True)
        self._pipe.send(job)

    def check(self) -> None:
        """Take note of a job that is done; raise UserError where it failed."""
        if self.job is None:
            return
        if not self._pipe.poll():
            return
        try:
            well = self._pipe.recv()
        except (EOFError, OSError):  # the process is no more
            well = False
        if not well:
            raise UserError(f"training {self.job.folder} failed: its messages are in {self.job.log}")
        self.job = None


def _train_jobs(pipe: Any, cores: list[int]) -> None:
    """Train what comes through the pipe and answer whether that went well: on its own cores, messages in a file."""
    if cores:
        os.sched_setaffinity(0, cores)  # XLA sizes its thread pool by this
    while (job := pipe.recv()) is not None:
        with job.log.open("a") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
            configure_jax()
            try:
                result = train_run(job.config, job.folder, start=_start(job.folder), progress=False)
                well = result.stopped_by is None
                if well:
                    _measured(job)
            except UserError as error:
                print(f"tflane: {error}")
                well = False
            except Exception:
                traceback.print_exc()
                well = False
        pipe.send(well)


def _start(folder: Path):
    return "resume" if (folder / "config.json").is_file() else "new"


def _step(folder: Path) -> int:
    """Return how far a run's records reach, 0 where there are none."""
    try:
        lines = (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        return int(json.loads(lines[-1])["step"])
    except (FileNotFoundError, IndexError, ValueError):
        return 0


def _report(
    system: System,
    variants: list[Variant],
    remarks: dict[str, dict[str, str]],
    protocol: str,
    out: Path,
    picture: Path | None,
    seeds: Sequence[int],
) -> Path:
    """Print the tables and save them beside the pictures."""
    title = f"{protocol}, test split, {len(seeds)} seed{'s' if len(seeds) > 1 else ''}, percent (mean ± std)"
    every = [scores for variant in variants for scores in variant.scores]
    metrics = [name for name in system.compared if all(name in scores for scores in every)]
    rows = [row | remarks.get(row["model"], {}) for row in compact(variants, metrics)] + system.quoted()
    print("\n" + format_table(rows, title=title))
    markdown, _ = save_table(out / "table", rows, {"protocol": protocol, "seeds": list(seeds)}, title=title)
    written = [markdown]
    if len(seeds) > 1:
        rows = summarise(variants, metrics, system.errors)
        title = f"{protocol}: paired differences to {variants[0].name}, two-sided t-test over {len(seeds)} seeds"
        print("\n" + format_table(rows, title=title, digits=4))
        written.append(save_table(out / "paired", rows, {"protocol": protocol}, title=title, digits=4)[0])
    write_json(out / "scores.json", {variant.name: list(variant.scores) for variant in variants})
    written += [out / "scores.json"] + ([picture] if picture else [])
    print("\nwritten:", *written, sep="\n  ")
    return markdown


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name.lower()).strip("_")
