"""Starting from the parameters of another run: all of them, or those that both models have."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import unflatten_dict

from tflane_jax.errors import UserError
from tflane_jax.migrations import migrate, value_at
from tflane_jax.models.parameters import Params
from tflane_jax.progress import write
from tflane_jax.training.array_files import flat
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.run_folder import read_config
from tflane_jax.training.state import TrainState, per_seed


def starting_params(
    reference: str, states: Sequence[TrainState], seeds: Sequence[int], *, partly: bool, frozen: Sequence[str] = ()
) -> list[Params]:
    """Return the parameters that each seed starts from: the averaged ones of a run's best checkpoint.

    The last checkpoint counts as best if none was evaluated. Of a run with several seeds, each seed starts from itself,
    and one that the run has not from the run's first.

    Args:
        reference: run folder; `{seed}` in it is replaced by the seed, so that each seed can have its own run.
        states: fresh, of each seed.
        seeds: of the run.
        partly: keep fresh parameters where the run's model has none, and ignore those that only that model has.
        frozen: paths of modules that are not trained, which the run's model must have.

    Raises:
        UserError: no such run, or a run of another model; with `partly`, a model without common parameters or with
            a parameter of another shape, or without a frozen module.
    """
    return [
        _params_of_run(folder, fresh.params, seed, partly=partly, frozen=frozen)
        for folder, fresh, seed in zip(origin_folders(reference, seeds), states, seeds, strict=True)
    ]


def check_origin_params(
    reference: str,
    shapes: Params,
    seeds: Sequence[int],
    *,
    resolved: dict[str, Any],
    partly: bool,
    frozen: Sequence[str],
) -> None:
    """Raise UserError as `starting_params` does, given the shapes of the fresh parameters.

    With the configuration (JSON) of the new run, `resolved`, the message names both models if their classes differ.
    """
    for folder, seed in zip(origin_folders(reference, seeds), seeds, strict=True):
        theirs, ours = _kind(migrate(read_config(folder))[0]), _kind(resolved)
        saved, wanted = _saved(folder, seed), flat(shapes)
        _differences(folder, saved, wanted, partly=partly, frozen=frozen, theirs=theirs, ours=ours)


def check_origins(reference: str, seeds: Sequence[int]) -> None:
    """Raise UserError if a run to start from is missing or has no checkpoint; nothing is restored."""
    for folder in origin_folders(reference, seeds):
        try:
            _starting_checkpoint(folder)
        except UserError as error:
            remedy = "make that run first (tflane train, or tflane convert for published weights), or name another"
            if reference.lower() == "none":
                remedy = "write None to start from no run"
            raise UserError(f"training.init_from is {reference}: {error}; {remedy}") from error


def origins(reference: str, seeds: Sequence[int], *, hash_parameters: bool = False) -> list[dict[str, Any]]:
    """Return folder, step, seed and "content" of the checkpoint that each seed starts from, see `starting_params`.

    "content" is a hash of the checkpoint's files, in which two equal trainings differ. With `hash_parameters`, which
    reads the arrays, "parameters" is a hash of their values; equal trainings have the same.
    """
    found = []
    for folder, seed in zip(origin_folders(reference, seeds), seeds, strict=True):
        checkpoints, step, theirs = _starting_checkpoint(folder)
        place = {"run": str(folder), "step": step, "seed": theirs[_place(seed, theirs)]}
        values = {"parameters": _digest(checkpoints.params(step))} if hash_parameters else {}
        found.append(place | {"content": checkpoints.digest(step)} | values)
    return found


def _digest(params: Params) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(flat(params).items()):
        digest.update(f"{name} {value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()


def origin_folders(reference: str, seeds: Sequence[int]) -> list[Path]:
    """Return the run folder that each seed starts from, see `starting_params`."""
    return [Path(reference.replace("{seed}", str(seed))) for seed in seeds]


def _starting_checkpoint(folder: Path) -> tuple[Checkpoints, int, list[int]]:
    """Return the checkpoints of a run, the step to start from, and the run's seeds."""
    settings = migrate(read_config(folder))[0].get("training")
    metric, seeds = (settings.get(name) if isinstance(settings, dict) else None for name in ("best_metric", "seeds"))
    if not isinstance(metric, str) or not isinstance(seeds, list) or not seeds:
        raise UserError(f"{folder / 'config.json'} is damaged: it lacks training.best_metric or training.seeds")
    checkpoints = Checkpoints(folder / "checkpoints", best_metric=metric)
    step = checkpoints.best_step()
    return checkpoints, checkpoints.find("last") if step is None else step, seeds


def _place(seed: int, of_run: Sequence[int]) -> int:
    """Return which of a run's seeds a seed starts from."""
    return of_run.index(seed) if seed in of_run else 0


def _params_of_run(folder: Path, fresh: Params, seed: int, *, partly: bool, frozen: Sequence[str]) -> Params:
    saved, wanted = _saved(folder, seed), flat(fresh)
    added, dropped = _differences(folder, saved, wanted, partly=partly, frozen=frozen)
    for names, what in ((added, "start afresh"), (dropped, "are left out")):
        if names:
            write(f"from {folder}: {_modules(names)} {what}")
    return unflatten_dict({name: saved.get(name, value) for name, value in wanted.items()}, sep="/")


def _saved(folder: Path, seed: int) -> dict[str, Any]:
    """Return the parameters of a run that a seed starts from, by name."""
    checkpoints, step, seeds = _starting_checkpoint(folder)
    return flat(per_seed(checkpoints.params(step), seeds)[_place(seed, seeds)])


@dataclass(frozen=True)
class _Kind:
    """Names of the classes of a task and of its model; "" where they are not known."""

    task: str = ""
    model: str = ""


def _differences(
    folder: Path,
    saved: Mapping[str, Any],
    wanted: Mapping[str, Any],
    *,
    partly: bool,
    frozen: Sequence[str],
    theirs: _Kind = _Kind(),
    ours: _Kind = _Kind(),
) -> tuple[list[str], list[str]]:
    """Return the names of parameters that only the new model has, and only the run's; raise UserError for a misfit.

    Args:
        folder: of the run to start from.
        saved, wanted: its parameters and those of the new model, by name.
        partly, frozen: see `starting_params`.
        theirs, ours: classes of the run and of the new one, where they are known.
    """
    other = f"training.init_from: {folder} holds another model"
    instead = ""
    if theirs.model and theirs.model != ours.model:
        other = f"training.init_from: {folder} is a run of {theirs.model}, not of {ours.model}"
        instead = f": name a run of {ours.model}"
    for name in sorted(saved.keys() & wanted.keys()):
        if _shape(saved[name]) != _shape(wanted[name]):
            raise UserError(f"{other} ({name}: {_shape(saved[name])} there, {_shape(wanted[name])} here){instead}")
    added, dropped = sorted(wanted.keys() - saved.keys()), sorted(saved.keys() - wanted.keys())
    if len(added) == len(wanted):
        raise UserError(f"{other} (it has no parameter of this one){instead}")
    if (added or dropped) and not partly:
        where = "is only here" if added else "is only there"
        total, common = _count(wanted, wanted), _count(wanted, wanted.keys() - set(added))
        if theirs.task == ours.task:
            fraction = f"{common:,} of {total:,} parameters ({100 * common / total:.0f} %)"
            instead += f"; training.init_partly takes over the {fraction} that both have"
            if added:
                instead += ", and the others start at random"
        raise UserError(f"{other} ({(added or dropped)[0]} {where}){instead}")
    for module in frozen:
        if any(name.startswith(f"{module}/") for name in added):
            raise UserError(
                f"training.init_from: {folder} has no {module}, which this configuration freezes: it would stay random"
            )
    return added, dropped


def _kind(config: dict[str, Any]) -> _Kind:
    """Return the classes that a configuration (JSON) names."""
    task, model = (value_at(config, name) for name in ("task.class", "task.model.class"))
    return _Kind(task, model) if isinstance(task, str) and isinstance(model, str) else _Kind()


def _count(params: Mapping[str, Any], names: Iterable[str]) -> int:
    """Return how many numbers the named parameters hold."""
    return sum(math.prod(params[name].shape) for name in names)


def _shape(leaf: jax.Array) -> tuple[tuple[int, ...], str]:
    return leaf.shape, str(leaf.dtype)


def _modules(names: Sequence[str]) -> str:
    """Return the modules, two levels deep, that parameters belong to."""
    return ", ".join(dict.fromkeys("/".join(name.split("/")[:-1][:2]) for name in names))
