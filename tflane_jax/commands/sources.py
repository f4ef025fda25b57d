"""The model and the data selected by a command's options."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.store import is_key
from tflane_jax.config import RunConfig, load_config
from tflane_jax.datasets import argoverse2, openlane_v2
from tflane_jax.datasets.base import SPLITS, Split, TrafficRateWarning
from tflane_jax.datasets.data_source import Choice, DataSource
from tflane_jax.datasets.sources import (
    SOURCES,
    history_hz,
    is_shipped,
    named_source,
    sample,
    source_name,
    source_names,
    source_of,
)
from tflane_jax.errors import UserError
from tflane_jax.files.folders import named_folder
from tflane_jax.geometry import PerceptionRange
from tflane_jax.models.host import HostConfig
from tflane_jax.run_checks import EXAMPLE_NAMES, check_kind
from tflane_jax.runs import Run, open_run, open_weights
from tflane_jax.scene import Example, RoadImage
from tflane_jax.tasks.fit import check_raster, check_settings_fit, reads_traffic
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.tasks.traffic import limit_instances


def opened(options: argparse.Namespace) -> tuple[Run, list[Path]]:
    """Return the model and the remaining inputs.

    The model is that of --config (published weights), or else the first input (a run folder).
    """
    if options.config is not None:
        if options.checkpoint is not None:
            raise UserError(f"--checkpoint {options.checkpoint} is of a run: published weights (--config) have but one")
        if options.inputs and (options.inputs[0] / "config.json").is_file():
            raise UserError(f"{options.inputs[0]} is a run, which has its own configuration: leave --config out")
        config = load_config(options.config)
        return open_weights(replace(config, weights=options.weights or config.weights)), options.inputs
    if options.weights is not None:
        raise UserError("--weights are those of a configuration: add --config FILE")
    if not options.inputs:
        raise UserError("no model: give a run folder, or --config FILE with published weights")
    if not options.inputs[0].is_dir():
        what = "is a file" if options.inputs[0].exists() else "does not exist"
        raise UserError(
            f"{options.inputs[0]} {what}: the first argument is a run folder, unless --config FILE names a model with "
            "published weights"
        )
    return open_run(options.inputs[0], options.checkpoint), options.inputs[1:]


def model_title(run: Run) -> str:
    """Return name and step of a model for pictures: the folder's name, or class and parts of a model in a store."""
    name = Path(run.name).resolve().name if run.name in (".", "..") else Path(run.name).name
    if is_key(name):
        model: Any = run.config.task.model
        parts = model.priors.configured if isinstance(model, HostConfig) else [_class_name(model.encoder)]
        name = " + ".join([_class_name(model), *(part.replace("_", " ") for part in parts)])
    return f"{name}, step {run.step}"


def _class_name(config: Any) -> str:
    return type(config).__name__.removesuffix("Config")


def limited_task(run: Run, options: argparse.Namespace) -> Any:
    """Return the run's task limited to --max-instances road users; None without that option."""
    if options.max_instances is None:
        return None
    if not isinstance(run.config.task, LaneGraphTask):
        raise UserError("--max-instances limits traffic flow, and this model takes none")
    return limit_instances(run.config.task, options.max_instances)


def chosen_source(config: RunConfig, options: argparse.Namespace, split: Split | None = None) -> Any:
    """Return the data selected by --split, --data, --root, --openlane and --data-dict.

    It is a configuration of `datasets.sources`.

    Without --data and --root, this is the configuration's split. With --data, sizes of examples stay as configured; the
    presets of the built-in world have their own box, history and capacities.

    Args:
        config: of the run; its task determines the type of examples.
        options: of the command line.
        split: overrides --split: one of --splits.

    Raises:
        UserError: the source has another type of examples, --root is missing or not supported, or the folder does not
            have the split.
    """
    given, option = (options.split, "--split") if split is None else (split, "--splits")
    chosen: Split = given or options.default_split
    configured = config.data.source(chosen)
    kind = RoadImage if isinstance(config.task, LaneShapeTask) else Example
    check_kind(config)
    source = source_of(configured) if options.data is None else named_source(options.data)
    if options.openlane is not None and (options.root is None or source is not argoverse2.SOURCE):
        raise UserError("--openlane chooses the frames of --data argoverse2 with --root: other data do not read it")
    found = configured
    if options.data is not None or options.root is not None:
        _check_choice(source, kind, options)
        # The name of a folder may be that of a split.
        root = None if options.root is None else named_folder(options.root)
        openlane = None if options.openlane is None else Path(options.openlane)
        truth = getattr(getattr(config.task, "model", None), "truth", ("lanes",))
        found = source.choose(Choice(chosen, given is not None, configured, root, openlane, option, truth))
    if options.data_dict is None:
        return found
    if source is not openlane_v2.SOURCE:
        raise UserError("--data-dict chooses the frames of OpenLane-V2: other data do not read it")
    return replace(found, data_dict=options.data_dict)


def check_used(
    overrides: Sequence[str], before: RunConfig, config: RunConfig, choose: Callable[[RunConfig], Any], data: str | None
) -> None:
    """Raise UserError for a setting of the configuration's data that --data leaves without effect.

    Args:
        overrides: `--name value`, as given.
        before: the configuration without them.
        config: the configuration with them.
        choose: returns what is chosen by --data from a configuration.
        data: of --data; without it, the data are the configuration's.
    """
    if data is None:
        return
    chosen = choose(config)
    for text in overrides:
        if not text.startswith("--data."):
            continue
        option = text.partition("=")[0]
        without = _with_part(config, before, option.removeprefix("--").replace("-", "_").split("."))
        if without != config and choose(without) == chosen:
            raise UserError(f"{option} changes the configuration's data, not --data {data}: leave one of them out")


def _with_part(config: Any, other: Any, path: Sequence[str]) -> Any:
    """Return a configuration with the setting at `path` (or flag, `a.no_b`) as another one has it."""
    name = path[0] if hasattr(config, path[0]) else path[0].removeprefix("no_")
    own, its = getattr(config, name), getattr(other, name)
    whole = len(path) == 1 or type(own) is not type(its)
    return replace(config, **{name: its if whole else _with_part(own, its, path[1:])})


def source_for(run: Run, options: argparse.Namespace) -> Any:
    """Return `chosen_source` for a trained model; raise UserError for a world that does not fit the model.

    Other boxes would give numbers all the same: evidence would lie in the wrong place, and lanes that the model cannot
    perceive would count as missed.
    """
    source = chosen_source(run.config, options)
    _check_world(run, source, options)
    _check_traffic(run, source)
    return source


def _check_world(run: Run, source: Any, options: argparse.Namespace) -> None:
    """Raise UserError for a world that does not fit the model."""
    task = run.config.task
    if options.data is None or not isinstance(task, LaneGraphTask):
        return
    if (named := named_source(options.data)).root is not None and is_shipped(named):  # it takes the run's sizes
        return
    images = source.example.cameras or getattr(source, "image", None)
    try:
        check_settings_fit(task.model, source.example, image_scale=None if images is None else images.scale)
    except UserError as error:
        why = str(error).rpartition(": ")[0]  # without the remedy, which is for trainings
        raise UserError(f"--data {options.data} does not fit this model: {why}; choose data like its own") from None
    if named.root is not None:
        check_raster(source, sample(source))
        return
    box, own = source.example.range, run.config.data.source(options.split or options.default_split).example.range
    if box != own:
        raise UserError(
            f"--data {options.data} does not fit this model: its lanes lie within {_box(box)}, those of the run's own "
            f"data within {_box(own)}; choose data like its own"
        )


def _box(range_: PerceptionRange) -> str:
    return f"x {range_.x}, y {range_.y}, z {range_.z}"


def _check_traffic(run: Run, source: Any) -> None:
    """Warn of data that lack the traffic flow that a model reads, or have it at another rate than it learned with."""
    task = run.config.task
    if not isinstance(task, LaneGraphTask) or not reads_traffic(task.model) or run.config.evaluation.traffic == "none":
        return
    found, learned = history_hz(source), history_hz(run.config.data.source("train"))
    if found == 0.0:
        said = "these data have no traffic flow, which this model reads: it sees none"
    elif found and learned and abs(found - learned) > 0.05 * learned:
        said = f"past frames of the traffic flow are at {found:g} Hz in these data, and this model learned at "
        said += f"{learned:g} Hz"
    else:
        return
    warnings.warn(said, TrafficRateWarning, stacklevel=4)


def data_name(source: Any, options: argparse.Namespace) -> str:
    """Return the name of the data of `chosen_source` for titles and files.

    Other worlds, folders and splits have other names, so that one table does not replace another.
    """
    name = source_name(source)
    if options.data is not None and named_source(options.data).root is None:  # presets are one kind of data
        return f"{options.data}-{options.split or options.default_split}"
    if options.split is not None and not set(SPLITS) & set(name.split("-")):
        name = f"{name}-{options.split}"
    if options.data_dict is not None:
        name = f"{name}-{Path(options.data_dict).stem}"
    folder = "" if options.root is None else Path(options.root).resolve().name
    return name if f"-{folder}-" in f"-{name}-" or not folder else f"{name}-{folder}"


def _check_choice(source: DataSource[Any], kind: type[Any], options: argparse.Namespace) -> None:
    """Raise UserError if a source has another type of examples, or --root is missing or not supported."""
    if source.example is not kind:
        names = source_names(kind)
        raise UserError(
            f"--data {source.name} are no {EXAMPLE_NAMES[kind]}: "
            f"this model takes {', '.join(names[:-1])} or {names[-1]}"
        )
    if options.data is None and source.root is None:
        rooted = [f"--data {one.name}" for one in SOURCES if one.root is not None and one.example is kind]
        raise UserError(f"--root is the folder of real data: add {' or '.join(rooted)}")
    if source.root is None and options.root is not None:
        raise UserError(f"--data {source.name} takes no --root: its examples are not read from a folder")
    if source.root is not None and options.root is None:
        raise UserError(f"--data {source.name} needs --root PATH, {source.root}")


def make_folder(folder: Path) -> None:
    """Create the output folder of a command; raise UserError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror or error}") from error
