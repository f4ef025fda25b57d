"""What is checked of a run before its data are built and its programs compiled: settings, names of scores, files."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

import jax

from tflane_jax.config import RunConfig
from tflane_jax.config_io import first_difference, settings, to_json
from tflane_jax.datasets.sources import check_labelled, source_of
from tflane_jax.errors import UserError
from tflane_jax.limits import SettingError, check_settings
from tflane_jax.metrics.directions import lower_is_better
from tflane_jax.models.parameters import Params, first_misfit, split_statistics
from tflane_jax.own_modules import own_code
from tflane_jax.processes import agreed, from_first
from tflane_jax.scene import Example, RoadImage, shapes_of
from tflane_jax.tasks.base import AnyTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.fine_tuning import check_origin_params
from tflane_jax.training.rate_factors import factor_of_leaves
from tflane_jax.training.run_folder import without_workers
from tflane_jax.training.vectors import layout_of

EXAMPLE_NAMES = {Example: "lane graphs", RoadImage: "images"}
"""Kinds of examples, in words."""


def agree_on_settings(config: RunConfig) -> None:
    """Raise UserError, in all processes, where one has other settings, or other code of own modules, than the first.

    Each would take part in every update with a program of its own, or wait for ever for an evaluation of the others.
    """
    mine = {"settings": without_workers(to_json(config)), "code": own_code(config)}
    first = from_first(lambda: mine)
    with agreed():
        if difference := first_difference(first["settings"], mine["settings"]):
            raise UserError(
                f"its settings are not those of the first process ({difference}): give all processes the same command"
            )
        if mine["code"] != first["code"]:
            raise UserError("its own modules have other code than those of the first process: give all the same files")


def check_run(config: RunConfig) -> None:
    """Raise UserError, naming the setting, where a run with this configuration must fail.

    A limit is broken, data and model do not fit together, a score is named that the evaluation does not compute, a file
    or folder of the training or validation data is missing, or these data have no truth.
    """
    check_settings(config)
    check_kind(config)
    config.task.check_settings(config.data)
    _check_scores(config)
    _check_files(config)
    check_labelled(config.data.source("train"), "training")
    check_labelled(config.data.source("val"), "validation")


def check_rate_factors(config: RunConfig) -> None:
    """Raise UserError for a pattern in `optim.lr_factors` that matches no parameter.

    It traces the model. No-op without patterns, and without the data that shapes of parameters depend on.
    """
    if config.optim.lr_factors and (shapes := _known_shapes(config)) is not None:
        factor_of_leaves(layout_of(split_statistics(shapes)[0]), config.optim.lr_factors)


def check_kind(config: RunConfig) -> None:
    """Raise UserError if the task takes examples of another kind than the data give."""
    given = source_of(config.data.source("train")).example
    taken = RoadImage if isinstance(config.task, LaneShapeTask) else Example
    if given is not taken:
        raise UserError(
            f"this configuration's data are {EXAMPLE_NAMES[given]} (data is {type(config.data).__name__}), "
            f"but its task takes {EXAMPLE_NAMES[taken]} (task is {type(config.task).__name__}): change either"
        )


def shapes_of_params(task: AnyTask, example: Any) -> Any:
    """Return the shapes of a task's parameters; raises what the model raises for an example that does not fit."""
    return jax.eval_shape(task.init, jax.random.key(0), training_shapes(task, example))


def training_shapes(task: AnyTask, example: Any) -> Any:
    """Return the shapes of one training input: the example, or a clip of examples."""
    return example if task.frames == 1 else shapes_of(example, task.frames)


def check_model(config: RunConfig, params: Params, checkpoint: str | None = None) -> None:
    """Raise UserError, naming the first difference, if parameters are not those of the model of a configuration.

    No-op without the data of the configuration, which the shapes of some parameters depend on.

    Args:
        config: of the model.
        params: with running statistics.
        checkpoint: that holds both; None for parameters of the caller.
    """
    shapes = _known_shapes(config)
    if shapes is None or not (difference := first_misfit(params, shapes)):
        return
    if checkpoint is None:
        raise UserError(f"the parameters are not those of this configuration's model: {difference}")
    raise UserError(
        f"{checkpoint}: {difference}. Its configuration was changed after the training: undo that (config.txt in the "
        "run folder has the settings that the run was started with), or train the other model"
    )


def check_origin_model(config: RunConfig) -> None:
    """Raise UserError if the run to start from, which is there, holds another model.

    It traces the model. No-op without such a run, and without the data that shapes of parameters depend on.
    """
    training = config.training
    if training.init_from is not None and (shapes := _known_shapes(config)) is not None:
        check_origin_params(
            training.init_from,
            shapes,
            training.seeds,
            resolved=to_json(config),
            partly=training.init_partly,
            frozen=config.task.frozen,
        )


def _known_shapes(config: RunConfig) -> Any:
    """Return the shapes of the parameters; None without the data, which the shapes of some depend on."""
    try:
        example = config.task.shapes(config.data)
    except UserError:
        return None
    return shapes_of_params(config.task, example)


def _check_scores(config: RunConfig) -> None:
    known = config.task.score_names(config.data, config.evaluation)
    adaptive = None if config.optim.restarts is None else config.optim.restarts.adaptive
    named = {"training.best_metric": config.training.best_metric}
    if adaptive is not None:
        named["optim.restarts.adaptive.metric"] = adaptive.metric
    for setting, name in named.items():
        if name not in known:
            listed = ", ".join(sorted(score for score in known if "@" not in score))
            close = difflib.get_close_matches(name, sorted(known), 3)
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise SettingError(setting, name, f"a score that the evaluation computes: choose one of {listed}{hint}")
    if lower_is_better(config.training.best_metric, config.task.errors):
        raise SettingError("training.best_metric", config.training.best_metric, "a score where higher is better")
    if adaptive is not None:
        mode = "min" if lower_is_better(adaptive.metric, config.task.errors) else "max"
        if adaptive.mode != mode:
            raise SettingError("optim.restarts.adaptive.mode", adaptive.mode, f'"{mode}" for {adaptive.metric}')


def _check_files(config: RunConfig) -> None:
    for name, value in settings(config.data, "data."):
        # Training does not read the test split.
        if isinstance(value, Path) and name != "data.test" and not value.exists():
            raise SettingError(name, str(value), "a file or folder that exists")
