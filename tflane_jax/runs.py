"""Runs as a whole: train a configuration, open a trained run, evaluate and predict with it.

This is the Python side of `tflane train`, `eval` and `predict`; notebooks and the demo use it too.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.config import RunConfig, Source, Split
from tflane_jax.config_io import from_json, to_json, to_text
from tflane_jax.datasets.argoverse2 import Argoverse2Dataset
from tflane_jax.datasets.base import Dataset
from tflane_jax.datasets.cache import cached
from tflane_jax.datasets.loading import TRAINING_PARTS, load_arrays
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.errors import UserError
from tflane_jax.scene import Example, LanePrediction, stack_examples
from tflane_jax.training.checkpoint import Checkpoints, Which
from tflane_jax.training.evaluate import evaluate_lanes, predictions, scores
from tflane_jax.training.lane_graph import LaneGraphTask
from tflane_jax.training.loop import Draw, TrainingResult, train
from tflane_jax.training.records import Record
from tflane_jax.training.run_folder import Start, check_start, read_config
from tflane_jax.training.state import per_seed
from tflane_jax.training.task import Params


@dataclass(frozen=True)
class Run:
    """A trained run.

    Attributes:
        folder: of the run.
        config: resolved configuration, as the checkpoint carries it.
        step: updates made.
        params: averaged parameters of each seed, in the order of `config.training.seeds`.
    """

    folder: Path
    config: RunConfig
    step: int
    params: tuple[Params, ...]


def train_run(config: RunConfig, folder: Path, *, start: Start = "new", progress: bool = True) -> TrainingResult:
    """Train a configuration into a folder: data, evaluation on the validation split, curves and pictures included.

    Raises UserError as `training.loop.train` and the datasets do.
    """
    check_start(folder, start)  # before data is made, which may take long
    arrays = load_split(config, "train", progress=progress)
    validation = load_split(config, "val", progress=progress)

    def evaluate(params: Params) -> dict[str, float]:
        return scores(evaluate_lanes(config.task, params, validation, config.evaluation.batch_size))

    return train(
        config.task, arrays, folder, config=config.training, optim=config.optim,
        resolved=to_json(config), resolved_text=to_text(config), start=start,
        evaluate=evaluate, draw=_drawing(config), progress=progress,
    )  # fmt: skip


def resumable_config(folder: Path) -> RunConfig:
    """Return the configuration that a run was started with; raises UserError where there is no run."""
    return from_json(RunConfig, read_config(folder))


def open_run(folder: Path, which: Which | None = None) -> Run:
    """Return a run's averaged parameters and configuration from one of its checkpoints, which needs nothing else.

    Args:
        folder: of the run.
        which: a step, "last" or "best"; None is the best where there was an evaluation, else the last.

    Raises:
        UserError: there is no such checkpoint, it is damaged, or of a version that this one cannot read.
    """
    plain = Checkpoints(folder / "checkpoints")
    config = from_json(RunConfig, plain.manifest(plain.find("last")).config)
    checkpoints = Checkpoints(folder / "checkpoints", best_metric=config.training.best_metric)
    if which is None:
        which = "last" if checkpoints.best_step() is None else "best"
    step = checkpoints.find(which)
    params = per_seed(checkpoints.params(step), config.training.seeds)
    return Run(folder, from_json(RunConfig, checkpoints.manifest(step).config), step, tuple(params))


def open_dataset(source: Source, *, progress: bool = True) -> Dataset:
    """Return the dataset of a source; the built-in world is built once and then read from its cache."""
    if isinstance(source, ProceduralConfig):
        return cached(ProceduralDataset(source), progress=progress)
    return Argoverse2Dataset(source)


def load_split(config: RunConfig, split: Split, *, progress: bool = True) -> Example:
    """Return what a model and its evaluation look at of a split, in memory."""
    dataset = open_dataset(config.data.source(split), progress=progress)
    return load_arrays(dataset, parts=TRAINING_PARTS, progress=progress)


def limit_instances(task: LaneGraphTask, count: int) -> LaneGraphTask:
    """Return the task with at most `count` instances of traffic flow, the heaviest; 0 is inference without.

    The parameters stay the same. Raises UserError where the model takes no traffic flow or has fewer slots.
    """
    traffic = task.model.traffic_flow
    if traffic is None:
        raise UserError("this run is a baseline without traffic flow: --max-instances has nothing to limit")
    if not 0 <= count <= traffic.prior.max_instances:
        raise UserError(f"--max-instances {count} is outside 0 to {traffic.prior.max_instances}, the model's slots")
    prior = replace(traffic.prior, top_instances=count)
    return replace(task, model=replace(task.model, traffic_flow=replace(traffic, prior=prior)))


def evaluate_run(
    run: Run, source: Source, *, max_instances: int | None = None, progress: bool = True
) -> tuple[str, list[dict[str, Any]]]:
    """Evaluate every seed of a run.

    Args:
        run: see `open_run`.
        source: the examples.
        max_instances: limit on traffic flow, see `limit_instances`; None leaves it as trained.
        progress: show bars while data is made.

    Returns:
        The metric's protocol with its version, and rows for a table: one per group of lanes and seed; with several
        seeds, their means and standard deviations (n - 1) follow.
    """
    task = run.config.task if max_instances is None else limit_instances(run.config.task, max_instances)
    arrays = load_arrays(open_dataset(source, progress=progress), parts=TRAINING_PARTS, progress=progress)
    every = [evaluate_lanes(task, params, arrays, run.config.evaluation.batch_size) for params in run.params]
    computed = [metrics.compute() for metrics in every]
    seeds = run.config.training.seeds
    rows: list[dict[str, Any]] = []
    for group in computed[0]:
        values = [one[group] for one in computed]
        rows += [{"lanes of": group, "seed": seed, **one} for seed, one in zip(seeds, values, strict=True)]
        if len(seeds) > 1:
            table = {name: np.array([one[name] for one in values]) for name in values[0]}
            rows.append({"lanes of": group, "seed": "mean"} | {k: float(v.mean()) for k, v in table.items()})
            rows.append({"lanes of": group, "seed": "std"} | {k: float(v.std(ddof=1)) for k, v in table.items()})
    return every[0].protocol, rows


def spread(dataset: Dataset, count: int) -> list[int]:
    """Return the indices of `count` examples spread evenly over a dataset (all of them if it has fewer)."""
    return np.unique(np.linspace(0, len(dataset) - 1, min(count, len(dataset))).round().astype(int)).tolist()


def predict_examples(
    task: LaneGraphTask, params: Params, dataset: Dataset, indices: Sequence[int]
) -> tuple[Example, LanePrediction]:
    """Return some examples whole, with truth and all, and the lanes predicted for them; both stacked, numpy."""
    examples = stack_examples([dataset.example(index) for index in indices])
    (_, answer), = predictions(task, params, examples, len(indices))  # fmt: skip
    return examples, answer.lanes


def _drawing(config: RunConfig) -> Draw | None:
    """Return the function that draws curves and a few validation examples, or None where matplotlib is missing."""
    if importlib.util.find_spec("matplotlib") is None:
        print("no pictures: matplotlib is missing (pip install 'tflane_jax[plot]')", file=sys.stderr)
        return None
    from tflane_jax.plots import save_curves, save_examples

    source = config.data.source("val")
    dataset = open_dataset(source)
    indices = spread(dataset, config.evaluation.pictures)

    def draw(folder: Path, step: int, params: Params, records: list[Record]) -> None:
        save_curves(folder / "curves.png", records)
        if indices:
            examples, lanes = predict_examples(config.task, params, dataset, indices)
            save_examples(
                folder / "pictures" / f"step_{step:08d}.png", examples, {f"step {step}": lanes},
                titles=titles(dataset, indices), ground=source.example.sensor.grid.range, view=source.example.range,
            )  # fmt: skip

    return draw


def titles(dataset: Dataset, indices: Sequence[int]) -> list[str]:
    """Return a title for the picture of each example."""
    infos = [dataset.info(index) for index in indices]
    return [f"{info.scene} at {info.timestamp_ns / 1e9:.1f} s" for info in infos]
