"""Evaluate trained models while one setting of their test data changes: score against occlusion, noise, density."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from tflane_jax.ablations.comparison import Variant, compact
from tflane_jax.config import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import Run, load_test_data, open_run


def sweep(
    models: Mapping[str, Path],
    setting: str,
    values: Sequence[str],
    out: Path,
    overrides: Sequence[str] = (),
    *,
    metrics: Sequence[str] | None = None,
) -> Path:
    """Evaluate every run of every model with each value of the setting; print and save a table and a plot.

    Args:
        models: run folder by name, or a folder that holds a run folder for each seed.
        setting: of the configuration, by its dotted name; of the data, for it changes nothing in a trained model.
        values: of the setting, as on the command line.
        out: folder for `sweep.md`, `sweep.json` and `sweep.png`.
        overrides: other settings, `--name value`, for all.
        metrics: "group/name" of those to show; None shows all that `tflane compare` does. The JSON file has every one.

    Returns:
        The Markdown file.

    Raises:
        UserError: no run, a setting that is none of the data's, or a metric that there is not.
    """
    if not setting.startswith("data."):
        raise UserError(f"--setting {setting}: give a setting of the data (data...), the models are trained already")
    runs = {name: runs_below(folder) for name, folder in models.items()}
    scores: dict[str, list[list[dict[str, float]]]] = {name: [] for name in runs}
    protocol = ""
    total = len(values) * sum(map(len, runs.values()))
    with tqdm(total=total, unit="run") as bar:
        for value in values:
            for name, trained in runs.items():
                found = []
                for run in trained:
                    bar.set_description(f"{setting} = {value}: {name}")
                    changed = apply_overrides(run.config, [f"--{setting}", value, *overrides])
                    task, data = run.config.task, load_test_data(changed)
                    for params in run.params:
                        evaluation = task.evaluate(params, data, changed.evaluation)
                        found.append(evaluation.scores())
                    protocol = evaluation.protocol
                    bar.update()
                scores[name].append(found)
    every = [each for by_value in scores.values() for found in by_value for each in found]
    known = [name for name in every[0] if all(name in each for each in every)]
    if unknown := set(metrics or ()) - set(known):
        raise UserError(f"no metric {min(unknown)}, only {', '.join(known)}")
    metrics = metrics or [name for name in task.compared if name in known]
    rows = []
    for i, value in enumerate(values):
        variants = [Variant(name, tuple(by_value[i])) for name, by_value in scores.items()]
        rows += [{setting: value} | row for row in compact(variants, metrics)]
    title = f"{protocol}, test split, percent (mean ± std over seeds)"
    print("\n" + format_table(rows, title=title))
    out.mkdir(parents=True, exist_ok=True)
    meta = {"protocol": protocol, "setting": setting, "values": list(values), "scores": scores}
    written = list(save_table(out / "sweep", rows, meta, title=title))
    if importlib.util.find_spec("matplotlib") is not None:
        from tflane_jax.plots.sweep import save_sweep

        written.append(save_sweep(out / "sweep.png", scores, setting, values, metrics))
    print("\nwritten:", *written, sep="\n  ")
    return written[0]


def runs_below(folder: Path) -> list[Run]:
    """Return the run of a folder, or those of its subfolders, at their last step; raises UserError for none."""
    folders = [folder] if (folder / "config.json").is_file() else sorted(p.parent for p in folder.glob("*/config.json"))
    if not folders:
        raise UserError(f"{folder} is no run folder, and holds none")
    return [open_run(each, "last") for each in folders]
