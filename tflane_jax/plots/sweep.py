"""Curves of several models' scores over the values of a data setting."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tflane_jax.files.wording import counted
from tflane_jax.metrics.directions import unit_of
from tflane_jax.plots import style
from tflane_jax.plots.figure import TITLE_WIDTH, columns_for, hide_unused, new_figure, save_figure
from tflane_jax.plots.names import score_title

Scores = Mapping[str, Sequence[Sequence[Mapping[str, float]]]]
"""By model: for each value of the setting, for each seed, metrics by name."""


def save_sweep(
    path: Path, scores: Scores, setting: str, values: Sequence[str], metrics: Sequence[str], *, meaning: str = ""
) -> Path:
    """Write one panel per metric: for each model the mean of its seeds and a band of one standard deviation.

    The legend says what the bands are, and how many seeds a model has.

    Args:
        path: .png, .pdf or .svg.
        scores: fractions, shown as percent, and distances in metres; see `Scores`.
        setting, values: name and values of the horizontal axis; values that are no numbers are evenly spaced.
        metrics: names of the metrics to draw.
        meaning: of the setting, in words, below its name.
    """
    try:
        places, ticks = np.array([float(value) for value in values]), None
    except ValueError:
        places, ticks = np.arange(len(values), dtype=float), values
    order = np.argsort(places, kind="stable")
    columns = columns_for(len(metrics))
    figure, axes = new_figure(-(-len(metrics) // columns), columns, panel=(3.7, 2.7), footer=0.5)
    for ax, metric in zip(axes.flat, metrics, strict=False):
        factor, unit = unit_of(metric)
        for number, (model, by_value) in enumerate(scores.items()):
            shown = [factor * np.array([each[metric] for each in seeds]) for seeds in by_value]
            mean = np.array([seeds.mean() for seeds in shown])[order]
            spread = np.array([seeds.std(ddof=1) if len(seeds) > 1 else 0.0 for seeds in shown])[order]
            look = style.curve_style(number)
            label = f"{model} ({counted(max(map(len, by_value)), 'seed')})"
            ax.plot(places[order], mean, **look, marker="o", ms=3, lw=1.4, label=label)
            ax.fill_between(places[order], mean - spread, mean + spread, color=look["color"], alpha=0.15, lw=0)
        ax.set_title(textwrap.fill(f"{score_title(metric)}, {unit}", TITLE_WIDTH), fontsize=9, loc="left")
        ax.set_xlabel("\n".join([setting, *textwrap.wrap(meaning, 52)]), fontsize=8)
        if ticks is not None:
            ax.set_xticks(places, ticks)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3, lw=0.5)
    hide_unused(axes, len(metrics))
    figure.legend(
        handles=axes.flat[0].lines,
        title="line: mean over seeds; band: one standard deviation up and down",
        loc="outside lower center",
        ncols=min(len(scores), 4),
        fontsize=8,
        title_fontsize=8,
        frameon=False,
    )
    return save_figure(figure, path)
