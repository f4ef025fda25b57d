"""Evaluate trained models over the values of one setting of their test data, such as occlusion, noise or density."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from tflane_jax.ablations.comparison import compact
from tflane_jax.ablations.held_out import load_test_data
from tflane_jax.ablations.results import mixed_protocols
from tflane_jax.ablations.scores import with_settings
from tflane_jax.config import RunConfig
from tflane_jax.config_help import meaning
from tflane_jax.config_io import first_difference, to_json
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder
from tflane_jax.files.wording import counted
from tflane_jax.migrations import value_at
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.progress import progress_bar
from tflane_jax.runs import Run, open_run


def sweep(
    models: Mapping[str, Path],
    setting: str,
    values: Sequence[str],
    out: Path,
    overrides: Sequence[str] = (),
    *,
    metrics: Sequence[str] | None = None,
    which: Literal["last", "best"] = "last",
) -> Path:
    """Evaluate every run of every model with each value of the setting; print and save a table and a plot.

    Args:
        models: run folder by name, or a folder that holds a run folder for each seed.
        setting: dotted name of a setting of the data; the others cannot change in a trained model.
        values: of the setting, as on the command line; True and False of a flag.
        out: folder for `sweep.md`, `sweep.json` and `sweep.png`.
        overrides: other settings, `--name value`, for all.
        metrics: names ("group/name") of the scores to show; None shows those of `tflane compare`. The JSON file has
            all of them.
        which: checkpoint of each run: the last, or the best by `training.best_metric` on the validation split.

    Returns:
        The Markdown file.

    Raises:
        UserError: no run, a setting that is not of the data, a value or override that cannot be set, an unknown
            metric, or models with different test data; before anything is evaluated.
    """
    if not setting.startswith("data."):
        raise UserError(f"--setting {setting}: give a setting of the data (data...), the models are trained already")
    check_folder(out)
    _check_not_given(setting, overrides)
    if twice := [value for value in values if list(values).count(value) > 1]:
        raise UserError(f"--values has {twice[0]} twice: once is enough")
    runs = {name: runs_below(folder, which) for name, folder in models.items()}
    unfinished = _tell_unfinished([run for each in runs.values() for run in each]) if which == "last" else 0
    tested = {
        value: {
            name: [_tested(run, *overrides, *_given(run.config, setting, value)) for run in runs[name]] for name in runs
        }
        for value in values
    }
    _check_values(setting, {value: next(iter(by_name.values()))[0] for value, by_name in tested.items()})
    for value, by_name in tested.items():
        _check_same_data(f"{setting} = {value}", by_name)
        for config in (config for each in by_name.values() for config in each):
            _check_metrics(metrics or (), config.task.score_names(config.data, config.evaluation))
    scores: dict[str, list[list[dict[str, float]]]] = {name: [] for name in runs}
    protocols: dict[str, dict[str, None]] = {name: {} for name in runs}
    total = len(values) * sum(map(len, runs.values()))
    with progress_bar(total=total, unit="run") as bar:
        for value in values:
            for name, trained in runs.items():
                found = []
                for run, changed in zip(trained, tested[value][name], strict=True):
                    bar.set_description(f"{setting} = {value}: {name}")
                    task, data = run.config.task, load_test_data(changed)
                    for params in run.params:
                        evaluation = task.evaluate(params, data, changed.evaluation)
                        found.append(evaluation.scores())
                    protocols[name][evaluation.protocol] = None
                    bar.update()
                scores[name].append(found)
    every = [each for by_value in scores.values() for found in by_value for each in found]
    known = [name for name in every[0] if all(name in each for each in every)]
    _check_metrics(metrics or (), known)
    metrics = metrics or [name for name in task.shown or task.compared if name in known]
    rows = []
    for i, value in enumerate(values):
        found = compact({name: by_value[i] for name, by_value in scores.items()}, metrics)
        rows += [{setting: value} | row for row in found]
    by_model = {name: " / ".join(found) for name, found in protocols.items()}
    protocol = " / ".join(dict.fromkeys(one for found in protocols.values() for one in found))
    title = f"{protocol}, test split, {which} checkpoint, percent (mean ± std over seeds)"
    if unfinished:
        title += f"; {counted(unfinished, 'run')} not finished"
    if mixed := mixed_protocols(by_model):
        title += f"\n\n{mixed}"
    meta = {"protocol": protocol, "checkpoint": which, "setting": setting, "values": list(values), "scores": scores}
    written = list(save_table(out / "sweep", rows, meta, title=title))
    print("\n" + format_table(rows, title=title))
    if can_draw():
        from tflane_jax.plots.sweep import save_sweep

        first = next(iter(runs.values()))[0].config
        written.append(save_sweep(out / "sweep.png", scores, setting, values, metrics, meaning=meaning(first, setting)))
    print("\nwritten:", *written, sep="\n  ")
    return written[0]


def _tell_unfinished(runs: Sequence[Run]) -> int:
    """Write a line for each run that stopped amid its updates, and return how many these are."""
    found = [run for run in runs if 0 < run.step < run.config.training.steps]  # converted weights made none here
    for run in found:
        print(f"{run.name} made {run.step} of {run.config.training.steps} updates so far", file=sys.stderr)
    return len(found)


def _given(config: RunConfig, setting: str, value: str) -> tuple[str, ...]:
    """Return the arguments that give a setting its value; flags take none."""
    part, dot, last = setting.rpartition(".")
    flag = {"True": (f"--{setting}",), "False": (f"--{part}{dot}no-{last}",)}.get(value)
    is_flag = isinstance(value_at(to_json(config), setting.replace("-", "_"), default=True), bool)
    return flag if flag is not None and is_flag else (f"--{setting}", value)


def _check_not_given(setting: str, overrides: Sequence[str]) -> None:
    """Raise UserError for an override of the swept setting, or of a part of it."""
    swept = setting.replace("-", "_")
    for text in overrides:
        part, dot, last = text.partition("=")[0].removeprefix("--").replace("-", "_").rpartition(".")
        name = f"{part}{dot}{last.removeprefix('no_')}"
        if text.startswith("--") and f"{name}.".startswith(f"{swept}."):
            raise UserError(f"{text.partition('=')[0]} is what --setting {setting} sweeps: leave it out")


def _check_values(setting: str, tested: Mapping[str, RunConfig]) -> None:
    """Raise UserError for two values with which a run is evaluated on the same data in the same way."""
    seen: list[tuple[str, RunConfig]] = []
    for value, config in tested.items():
        for other, before in seen:
            if before.data.source("test") == config.data.source("test") and before.evaluation == config.evaluation:
                raise UserError(
                    f"{setting} = {other} and {value} are the same test: give values that change the test split"
                )
        seen.append((value, config))


def _tested(run: Run, *arguments: str) -> RunConfig:
    """Return a run's configuration with other settings of data and evaluation; raises UserError for others."""
    config = run.config
    common = _without_seed(config)
    try:
        changed = with_settings(common, arguments)
    except UserError as error:
        raise UserError(f"{run.name}: {error}") from None
    if replace(changed, data=common.data, evaluation=common.evaluation) != common:
        given = ", ".join(argument for argument in arguments if argument.startswith("--"))
        raise UserError(
            f"a sweep changes settings of the data and the evaluation (--data..., --evaluation...), the models are "
            f"trained already: got {given}"
        )
    config.task.check_settings(changed.data)
    return replace(config, data=changed.data, evaluation=changed.evaluation)


def _check_same_data(of: str, tested: Mapping[str, Sequence[RunConfig]]) -> None:
    named = [(name, config.data.source("test")) for name, configs in tested.items() for config in configs]
    first, source = named[0]
    if other := [name for name, each in named if each != source]:
        raise UserError(
            f"runs of {first} and {other[0]} have different test data ({of}): their numbers cannot be compared. Give "
            "the settings that differ to all (such as --data.test 200), or sweep them apart"
        )


def _check_metrics(metrics: Collection[str], known: Collection[str]) -> None:
    if unknown := set(metrics) - set(known):
        listed = ", ".join(sorted(name for name in known if "@" not in name))
        raise UserError(f"no metric {min(unknown)}, only {listed}")


def runs_below(folder: Path, which: Literal["last", "best"] = "last") -> list[Run]:
    """Return the run of a folder, or those of its subfolders, one a seed.

    Raises UserError if there is none, or if they differ in more than the seed.
    """
    folders = [folder] if _is_run(folder) else sorted(filter(_is_run, folder.glob("*")))
    if not folders:
        raise UserError(f"{folder} is no run folder, and holds none")
    runs = [open_run(each, which) for each in folders]
    seeds = [seed for run in runs for seed in run.config.training.seeds]
    first, *others = (_without_seed(run.config) for run in runs)
    for run, config in zip(runs[1:], others, strict=True):
        if difference := first_difference(to_json(first), to_json(config)):
            raise UserError(
                f"{runs[0].name} and {run.name} are no seeds of one configuration ({difference}): name each by itself"
            )
    if len(set(seeds)) < len(seeds):
        raise UserError(f"two of the runs below {folder} have the same seed: name each by itself")
    return runs


def _is_run(folder: Path) -> bool:
    return (folder / "config.json").is_file() or (folder / "checkpoints").is_dir()


def _without_seed(config: RunConfig) -> RunConfig:
    """Return the configuration with what differs between the seeds of a comparison as a constant."""
    return replace(config, training=replace(config.training, seeds=(0,), init_from=None))
