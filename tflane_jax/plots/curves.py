"""Training curves from the records of a run's `metrics.jsonl`."""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.files.wording import counted
from tflane_jax.metrics.directions import lower_is_better, unit_of
from tflane_jax.plots import style
from tflane_jax.plots.figure import TITLE_WIDTH, columns_for, hide_unused, new_figure, save_figure
from tflane_jax.plots.names import score_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Fields of a record that are not curves.
_NOT_DRAWN = ("step", "split", "seconds", "waiting")

Series = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n seeds"]]


def save_curves(path: Path, records: Iterable[Mapping[str, Any]]) -> Path:
    """Write one panel per split and group of values ("loss", "loss/points": group "loss"), and return the path.

    Of scores, errors and losses have panels of their own, because they are metres or larger than 1.
    The loss comes first, then the scores, then the rest of the training's records. Several seeds are drawn as their
    mean and a band from minimum to maximum. Scores at single thresholds
    ("recall@1.0") are left out. Values of training have a logarithmic axis if they span more than a factor of 30.
    The line has a gap where the value of a seed is not finite; the band is that of the other seeds.

    Args:
        path: .png, .pdf or .svg.
        records: `step`, optionally `split`, and values by name: a number, or a list of one per seed.

    Raises UserError without records.
    """
    series = {key: values for key, values in curves(records).items() if "@" not in key[1]}
    if not series:
        raise UserError("no curves to draw: the run has no records yet")
    groups: dict[tuple[str, str, str], list[str]] = {}
    for split, name in sorted(series, key=_place):
        groups.setdefault((split, name.split("/")[0], _kind(split, name)), []).append(name)
    seeds = max(values.shape[1] for _, values in series.values())
    columns = columns_for(len(groups))
    footer = 0.2 if seeds > 1 else 0.0
    figure, axes = new_figure(-(-len(groups) // columns), columns, panel=(4.6, 3.2), footer=footer)
    if seeds > 1:
        figure.supxlabel(bands(f"{seeds} seeds"), fontsize=8)
    # A score has one colour in all panels.
    scores = _styles(dict.fromkeys(name.partition("/")[2] for split, name in series if split == "val"))
    for ax, ((split, group, kind), names) in zip(axes.flat, groups.items(), strict=False):
        ax.set_title((f"{split}: {group}" if split else group) + kind, fontsize=9, loc="left")
        found = {name.removeprefix(f"{group}/"): series[split, name] for name in names}
        own = scores if scores.keys() >= found.keys() else _styles(found)
        _draw_panel(ax, found, own, log=split == "train")
        if list(found) != [group]:
            # Beside the panel, because there are curves everywhere in it.
            ax.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    hide_unused(axes, len(groups))
    return save_figure(figure, path)


def save_comparison_curves(
    path: Path, records: Mapping[str, Sequence[Iterable[Mapping[str, Any]]]], names: Sequence[str]
) -> Path | None:
    """Write a panel for each score with a curve for each model: the mean over its runs, a band from least to most.

    Where every model was validated once, at the same step, each run is a point beside the mean of its model instead.

    Scores are drawn in percent, distances in metres, as the tables show them. The legend says what lines and bands
    are, and how many runs a model has.

    Args:
        path: .png, .pdf or .svg.
        records: fractions, of the validation split, by model and run; only steps that all runs of a model have are
            drawn.
        names: scores, such as "all/recall"; those without records are left out.

    Returns:
        The path; None if there is nothing to draw.
    """
    found = {model: [curves(run) for run in runs] for model, runs in records.items()}
    panels: dict[str, dict[str, Series]] = {}
    for name in names:
        for model, runs in found.items():
            if runs and all(("val", name) in run for run in runs):
                validated, values = _joined([run["val", name] for run in runs])
                panels.setdefault(name, {})[model] = validated, unit_of(name)[0] * values
    if not panels:
        return None
    columns = columns_for(len(panels))
    size = (3.7, 2.7)  # three fit beside each other on a page whose text can still be read
    figure, axes = new_figure(-(-len(panels) // columns), columns, panel=size, footer=0.3 + 0.1 * len(found))
    styles = _styles(found)  # the same in all panels
    schedules = {tuple(steps.tolist()) for series in panels.values() for steps, _ in series.values()}
    once = [len(steps) for steps in schedules] == [1]
    draw = _draw_points if once else _draw_panel
    for ax, (name, series) in zip(axes.flat, panels.items(), strict=False):
        title = f"validation: {score_title(name)}, {unit_of(name)[1]}"
        ax.set_title(textwrap.fill(title, TITLE_WIDTH), fontsize=9, loc="left")
        draw(ax, series, styles)
    hide_unused(axes, len(panels))
    lines = {str(line.get_label()): line for ax in axes.flat for line in ax.lines}
    number = {model: values.shape[1] for series in panels.values() for model, (_, values) in series.items()}
    figure.legend(
        lines.values(),
        [f"{model} ({counted(number[model], 'run')})" for model in lines],
        title="bar: mean; points: runs" if once else bands("runs"),
        loc="outside lower center",
        ncols=min(len(lines), 2),
        fontsize=8,
        title_fontsize=8,
        frameon=False,
    )
    return save_figure(figure, path)


def bands(of: str) -> str:
    """Return the words that explain a curve and its band; `of` says what they were drawn from, such as "8 seeds"."""
    return f"line: mean over {of}; band: from the least to the greatest"


def _place(key: tuple[str, str]) -> int:
    """Return a number by which curves are sorted: first the loss, then scores, then what explains a bad training."""
    split, name = key
    if split != "train":
        return 1
    return 0 if name.split("/")[0] == "loss" else 2


def _kind(split: str, name: str) -> str:
    """Return what the title of a panel says of the kind of a score: nothing where higher is better."""
    score = name.rpartition("/")[2]
    if split != "val":
        return ""
    return ", loss" if score == "loss" else ", errors (lower is better)" if lower_is_better(score) else ""


def _joined(runs: Sequence[Series]) -> Series:
    """Return the values of several runs at the steps that all of them have."""
    steps = functools.reduce(np.intersect1d, (steps for steps, _ in runs))
    return steps, np.concatenate([values[np.isin(own, steps)] for own, values in runs], axis=1)


def curves(records: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], Series]:
    """Return steps (n,) and numbers (n, seeds) by split and name, in order of step."""
    found: dict[tuple[str, str], dict[int, np.ndarray]] = {}
    for record in records:
        for name, value in record.items():
            if name not in _NOT_DRAWN:
                by_step = found.setdefault((record.get("split", ""), name), {})
                by_step[record["step"]] = np.atleast_1d(np.asarray(value, np.float64))
    return {
        key: (np.asarray(sorted(by_step)), np.stack([by_step[step] for step in sorted(by_step)]))
        for key, by_step in found.items()
    }


def _styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    return {name: style.curve_style(number) for number, name in enumerate(names)}


def _draw_points(ax: Axes, series: Mapping[str, Series], styles: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw the runs of each model in a column of its own, with a bar at their mean; all are of one step."""
    for column, name in enumerate(styles):
        if name in series:
            values = series[name][1]
            ax.plot([column - 0.3, column + 0.3], [values.mean()] * 2, **styles[name], lw=2.4, label=name)
            ax.scatter(np.full(values.size, column), values, color=styles[name]["color"], s=14, alpha=0.6, linewidths=0)
    (step,) = next(iter(series.values()))[0].tolist()
    ax.set_xlabel(f"after {step:,} steps", fontsize=8)
    ax.set_xlim(-0.7, len(styles) - 0.3)
    ax.set_xticks([])
    ax.tick_params(labelsize=7)
    ax.grid(alpha=0.3, lw=0.5, axis="y")


def _draw_panel(
    ax: Axes, series: Mapping[str, Series], styles: Mapping[str, Mapping[str, Any]], *, log: bool = False
) -> None:
    from matplotlib.ticker import MaxNLocator

    for name, (steps, values) in series.items():
        # Infinite values would leave the axis without limits.
        known = np.isfinite(values)
        mean = np.where(known.all(1), np.where(known, values, 0.0).mean(1), np.nan)
        alone = _without_neighbours(~np.isnan(mean))
        look = {"marker": "o", "markevery": alone.tolist()} if alone.any() else {}
        ax.plot(steps, mean, **styles[name], **look, lw=1.4, label=name)
        if values.shape[1] > 1:
            ax.fill_between(steps, *_bounds(values, known), color=styles[name]["color"], alpha=0.2, lw=0.8)
    seen = np.concatenate([values.reshape(-1) for _, values in series.values()])
    seen = seen[np.isfinite(seen)]
    if log and len(seen) and seen.min() > 0.0 and seen.max() > 30.0 * seen.min():
        ax.set_yscale("log")
    if not seen.any():
        ax.set_ylim(0.0, 1.0)  # nothing found: zero is at the bottom, not in the middle
    ax.set_xlabel("step", fontsize=8)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.tick_params(labelsize=7)
    ax.grid(alpha=0.3, lw=0.5)


def _bounds(values: Float[np.ndarray, "n seeds"], known: Bool[np.ndarray, "n seeds"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest known value of each step, NaN where none is known."""
    some = known.any(1)
    least = np.where(some, values.min(1, where=known, initial=np.inf), np.nan)
    return least, np.where(some, values.max(1, where=known, initial=-np.inf), np.nan)


def _without_neighbours(known: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return which points of a line are known and stand alone: without a marker, nothing of them is seen."""
    padded = np.pad(known, 1)
    return known & ~padded[:-2] & ~padded[2:]
