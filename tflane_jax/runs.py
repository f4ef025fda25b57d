"""Whole runs: train a configuration, open a trained run or published weights, evaluate.

The Python interface behind `tflane train`, `eval` and `predict`, also for notebooks and the demo.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from flax.errors import FlaxError

from tflane_jax.config import RunConfig
from tflane_jax.config_io import added_settings, from_json, to_json, to_text
from tflane_jax.datasets.batches import in_workers
from tflane_jax.datasets.data_source import loading_of
from tflane_jax.datasets.sources import check_labelled, source_of
from tflane_jax.devices import training_mesh
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import in_all_versions
from tflane_jax.files.atomic import write_json, write_text
from tflane_jax.limits import check_settings
from tflane_jax.migrations import migrate
from tflane_jax.models.parameters import Params
from tflane_jax.own_modules import own_code
from tflane_jax.plots import save_curves
from tflane_jax.plots.figure import can_draw
from tflane_jax.processes import agreed, from_first, is_first
from tflane_jax.run_checks import agree_on_settings, check_model, check_origin_model, check_rate_factors, check_run
from tflane_jax.startup import showing, stage
from tflane_jax.training.checkpoint import Checkpoints, Which
from tflane_jax.training.fine_tuning import check_origins, origin_folders
from tflane_jax.training.loop import Draw, TrainingResult, train
from tflane_jax.training.manifest import Manifest
from tflane_jax.training.provenance import add_provenance
from tflane_jax.training.records import Record, by_name
from tflane_jax.training.resumption import check_resumable
from tflane_jax.training.run_folder import Start, check_start, check_unchanged, claimed, read_config, unused_changes
from tflane_jax.training.schedule import make_optimizer, scaled_to_batch
from tflane_jax.training.state import per_seed, state_of

# In `Manifest.progress`: the only module that a folder holds.
_PART = "part"

Drawn = Literal["evaluations", "end"]
"""When a training draws curves and pictures: at every evaluation, or at its last step alone."""


@dataclass(frozen=True)
class Run:
    """A trained model.

    Attributes:
        name: the run's folder, or the file of published weights.
        config: resolved configuration, as stored in the checkpoint.
        step: number of optimizer updates.
        params: averaged parameters of each seed, in the order of `config.training.seeds`.
        chosen: whether the step was chosen among several by their scores in the validation split.
    """

    name: str
    config: RunConfig
    step: int
    params: tuple[Params, ...]
    chosen: bool = False


def train_run(
    config: RunConfig,
    folder: Path | str,
    *,
    start: Start = "new",
    progress: bool = True,
    drawn: Drawn = "evaluations",
) -> TrainingResult:
    """Train a configuration into a folder, with data, evaluation on the validation split, curves and pictures.

    Args:
        config: what to train.
        folder: of the run.
        start: see `training.run_folder.claimed`.
        progress: show a bar with rate and time left.
        drawn: when to draw. Nobody looks at the pictures of a comparison while it trains, and those of a small model
            take as long as twenty updates.

    Raises UserError like `training.loop.train` and the datasets, and `Interrupted` like that.
    """
    folder = Path(folder)
    # All this before building data, which may take long.
    from_first(lambda: check_start(folder, start))
    agree_on_settings(config)
    with agreed():
        check_run(config)
        training_mesh(config.training.batch_size, config.training.accumulate)
        check_rate_factors(config)
    if start == "resume":
        from_first(lambda: check_unchanged(folder, to_json(config), current_form))
        from_first(lambda: check_resumable(Checkpoints(folder / "checkpoints")))
    else:
        from_first(lambda: check_origin(config, replaced=folder if start == "overwrite" else None))
        from_first(lambda: check_origin_model(config))
    with showing(progress and is_first()):
        return _train(config, folder, start=start, progress=progress, drawn=drawn)


def _train(config: RunConfig, folder: Path, *, start: Start, progress: bool, drawn: Drawn) -> TrainingResult:
    task = config.task
    with agreed(), stage("reading the training data"):
        train_split = config.data.source("train")
        content = source_of(train_split).content(train_split)
        source: Any = task.training_form(train_split, config.data)
        data: Any = task.load(source, progress=progress)
        task.check(config.data, data)
        arrays, prepare = task.examples(data), task.prepare(config.data)
        if prepare is not None:
            arrays = in_workers(arrays, loading_of(config.data))
    with agreed(), stage("reading the validation data"):
        validation: Any = task.load(config.data.source("val"), progress=progress)
        task.check_evaluation(validation, config.evaluation)

    def evaluate(params: Params) -> dict[str, float]:
        return task.evaluate(params, validation, config.evaluation).recorded()

    return train(
        config.task,
        arrays,
        folder,
        config=config.training,
        optim=config.optim,
        resolved=to_json(config),
        resolved_text=to_text(config),
        current_form=current_form,
        start=start,
        prepare=prepare,
        evaluate=evaluate,
        draw=_drawing(config, drawn),
        frozen=task.frozen,
        content=content,
        own_code=own_code(config),
        progress=progress,
    )


def check_origin(config: RunConfig, *, replaced: Path | None = None) -> None:
    """Raise UserError if the run to start from is missing, or frozen modules would start from no weights.

    `replaced` is a run that is going to be deleted: none may start from it.
    """
    if (origin := config.training.init_from) is not None:
        check_origins(origin, config.training.seeds)
        folders = [folder.resolve() for folder in origin_folders(origin, config.training.seeds)]
        if replaced is not None and replaced.resolve() in folders:
            raise UserError(f"training.init_from is {replaced}, which --overwrite deletes: choose another --out")
    if config.task.frozen and config.training.init_from is None:
        raise UserError(
            f"{', '.join(config.task.frozen)} would stay random: this configuration freezes them "
            "(task.model.encoder.images.frozen_stages) and starts from no weights. Convert ImageNet's from a "
            "torchvision file (tflane convert --config FILE --weights resnet50.pth --out runs/imagenet) and set "
            "training.init_from=runs/imagenet and training.init_partly; or train them, with "
            "--task.model.encoder.images.frozen-stages 0 and --task.model.encoder.images.backbone.no-frozen-norms"
        )


def build_data(source: Any) -> None:
    """Generate the examples of a source that are not in the cache yet; no-op for data read from a folder."""
    build = source_of(source).build
    if build is not None:
        build(source, True)


def resumable_config(folder: Path) -> RunConfig:
    """Return the configuration that a run was started with; raises UserError if the folder holds no run."""
    return _read_config(folder / "config.json", read_config(folder))[0]


def _read_config(path: Path, saved: dict[str, Any]) -> tuple[RunConfig, list[str]]:
    """Return a saved configuration (JSON) and notices of its migration; raises UserError that names the file."""
    try:
        migrated, notices = migrate(saved)
        config = from_json(RunConfig, migrated)
        check_settings(config)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return config, notices


def current_form(saved: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return a saved configuration (JSON) in the present format, and a notice for the user for each change.

    Raises UserError for a setting that this version cannot read.
    """
    migrated, notices = migrate(saved)
    current = to_json(from_json(RunConfig, migrated))
    return current, notices + added_settings(migrated, current)


def open_run(folder: Path | str, which: Which | None = None) -> Run:
    """Return a run's averaged parameters and configuration from one of its checkpoints alone.

    Args:
        folder: the run folder.
        which: a step, "last" or "best"; None: the best checkpoint, or the last one of a run without evaluations.

    Raises:
        UserError: the checkpoint is missing, damaged, or of an unreadable version.
    """
    folder = Path(folder)
    plain = Checkpoints(folder / "checkpoints")
    last = plain.find("last")
    config, notices = _read_config(plain.path(last) / "manifest.json", plain.manifest(last).config)
    for notice in [*notices, *unused_changes(folder, to_json(config), current_form)]:
        print(notice, file=sys.stderr)
    checkpoints = Checkpoints(folder / "checkpoints", best_metric=config.training.best_metric)
    if which is None:
        which = "last" if checkpoints.best_step() is None else "best"
    step = checkpoints.find(which)
    if (part := checkpoints.manifest(step).progress.get(_PART)) is not None:
        raise UserError(
            f"{folder} holds the weights of {part} alone: train a model from it (training.init_from={folder}, "
            "training.init_partly), and use that"
        )
    averaged, seeds = checkpoints.params(step), config.training.seeds
    if len(seeds) > 1 and any(leaf.shape[:1] != (len(seeds),) for leaf in jax.tree.leaves(averaged)):
        raise UserError(f"{checkpoints.path(step)} has not the parameters of {len(seeds)} seeds (training.seeds)")
    params = per_seed(averaged, seeds)
    if _is_edited(plain, last, folder):
        check_model(config, params[0], str(checkpoints.path(step)))
    return Run(str(folder), config, step, tuple(params), chosen=which == "best" and last > config.training.eval_every)


def _is_edited(checkpoints: Checkpoints, step: int, folder: Path) -> bool:
    """Return whether a checkpoint's configuration was changed; of an older version's, whether config.json differs."""
    if (edited := checkpoints.is_edited(step)) is not None:
        return edited
    with contextlib.suppress(UserError):
        return read_config(folder) != checkpoints.manifest(step).config
    return False


def open_weights(config: RunConfig) -> Run:
    """Return a configuration's model with the published PyTorch weights that it names.

    Raises UserError if it names none, or if the file does not match the model.
    """
    from tflane_jax.convert.published import load_weights

    if config.weights is None:
        raise UserError("this configuration names no published weights (weights): give a trained run instead")
    params, _ = load_weights(config.weights, config.task)
    return Run(str(config.weights), replace(config, training=replace(config.training, seeds=(0,))), 0, (params,))


def save_weights(config: RunConfig, params: Params, folder: Path | str) -> None:
    """Write a run folder at step 0 with the given parameters, usable like a trained run.

    Raises UserError if the folder is not empty, a parameter is not finite, or they are not those of the configuration's
    model (not checked without the data of the configuration, which the shapes of some parameters depend on).
    """
    if (Path(folder) / "config.json").exists():
        raise UserError(f"{folder} already holds a run: choose another folder, or delete that one")
    check_model(config, params)
    write_weights(config, params, folder)


def write_weights(config: RunConfig, params: Params, folder: Path | str, *, part: str | None = None) -> None:
    """Write a run folder like `save_weights`, of parameters that are known to fit the model.

    With `part`, the path of a module, they are that module's alone, and the folder is one to start training from.
    """
    folder = Path(folder)
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not np.isfinite(leaf).all():
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise UserError(f"parameter {name} holds a number that is not finite: no model can be used with that")
    config = replace(config, training=replace(config.training, seeds=(0,)))
    optimizer = make_optimizer(scaled_to_batch(config.optim, config.training.batch_size), config.training.steps)
    state = state_of(params, optimizer, jax.random.key(0))
    with claimed(folder, "new"):
        add_provenance(folder)
        write_text(folder / "config.txt", to_text(config))
        Checkpoints(folder / "checkpoints").save(
            state, Manifest(step=0, config=to_json(config), progress={} if part is None else {_PART: part})
        )
        write_json(folder / "config.json", to_json(config))  # last: this file marks a complete run


def evaluate_run(
    run: Run, source: Any, *, task: Any = None, progress: bool = True, frame_groups: Sequence[str] = ()
) -> tuple[str, list[dict[str, Any]]]:
    """Evaluate every seed of a run.

    Args:
        run: as from `open_run`.
        source: configuration of the examples.
        task: a variant of the run's task, such as from `limit_instances`; None: the run's task.
        progress: show progress bars and stages.
        frame_groups: a further group for each example, measured on its own.

    Returns:
        The metric's protocol with its version, and rows of a table, one per group and seed; with several seeds, their
        means and standard deviations (n - 1) follow.
    """
    check_labelled(source, "an evaluation")
    task = run.config.task if task is None else task
    further = {"frame_groups": frame_groups} if frame_groups else {}
    seeds, every = run.config.training.seeds, []
    with showing(progress):
        with stage("reading the data"):
            arrays = task.load(source, progress=progress)
        for seed, params in zip(seeds, run.params, strict=True):
            with stage("evaluating" if len(seeds) == 1 else f"evaluating seed {seed}"):
                try:
                    every.append(task.evaluate(params, arrays, run.config.evaluation, **further))
                except FlaxError:
                    check_model(run.config, params, run.name)
                    raise
    rows: list[dict[str, Any]] = []
    for group in every[0].groups:
        values = [one.shown(group) for one in every]
        rows += [{"lanes of": group, "seed": seed, **one} for seed, one in zip(seeds, values, strict=True)]
        if len(seeds) > 1:
            table = {name: np.array(numbers) for name, numbers in by_name(values).items()}
            rows.append({"lanes of": group, "seed": "mean"} | {k: float(v.mean()) for k, v in table.items()})
            rows.append({"lanes of": group, "seed": "std"} | {k: float(v.std(ddof=1)) for k, v in table.items()})
    columns = in_all_versions(task.columns)
    return every[0].protocol, [{name: row[name] for name in columns if name in row} for row in rows]


def _drawing(config: RunConfig, drawn: Drawn) -> Draw | None:
    """Return the function that draws curves and a few validation examples, or None without matplotlib.

    See `train_run` for `drawn`.
    """
    if not can_draw():
        return None
    draw_examples = config.task.drawing(config.data, config.evaluation)

    def draw(folder: Path, step: int, params: Params, records: list[Record]) -> None:
        if drawn == "end" and step < config.training.steps:
            return
        save_curves(folder / "curves.png", records)
        draw_examples(folder, step, params)

    return draw
