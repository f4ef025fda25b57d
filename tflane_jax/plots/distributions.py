"""Distributions of quantities in several datasets, one panel a quantity."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tflane_jax.plots import style
from tflane_jax.plots.figure import hide_unused, new_figure, save_figure

_BINS = 24
# A quantity of fewer values than this, all whole numbers, has a tick for each: 0 and 1, and nothing between them.
_TICKS = 8
# The axis ends at this quantile of all values, so that a few large ones do not squeeze the others.
_SHOWN = 0.99


def save_distributions(path: Path, values: Mapping[str, Mapping[str, Float[np.ndarray, " _"]]]) -> Path:
    """Write a picture with a histogram of each dataset in each panel, as fractions of the dataset's finite values.

    Args:
        path: .png, .pdf or .svg.
        values: by dataset, by quantity; quantities that a dataset lacks or has no finite value of are left out.
    """
    from matplotlib.lines import Line2D

    finite = {
        dataset: {name: numbers[np.isfinite(numbers)] for name, numbers in found.items()}
        for dataset, found in values.items()
    }
    names = list(dict.fromkeys(name for found in finite.values() for name in found))
    columns = min(4, max(len(names), 1))
    figure, axes = new_figure(max(-(-len(names) // columns), 1), columns, panel=(3.2, 2.3), footer=0.3)
    for ax, name in zip(axes.flat, names, strict=False):
        every = np.concatenate([found[name] for found in finite.values() if name in found])
        low, high = (float(every.min()), float(np.quantile(every, _SHOWN))) if len(every) else (0.0, 1.0)
        whole = bool(np.all(every == np.round(every)))
        edges = _edges(low, high, whole=whole)
        for number, found in enumerate(finite.values()):
            if len(found.get(name, ())):
                count, _ = np.histogram(np.clip(found[name], edges[0], edges[-1]), edges)
                ax.stairs(count / len(found[name]), edges, color=style.curve_style(number)["color"], lw=1.3)
        ax.set_title(name.removeprefix("- "), fontsize=8, loc="left")  # the dash indents a row of a table
        if set(every.tolist()) == {0.0, 1.0}:
            ax.set_xticks([0, 1], ["no", "yes"])
        elif whole and high - low < _TICKS:
            ax.set_xticks(np.arange(low, high + 1))
        ax.tick_params(labelsize=6)
        ax.grid(alpha=0.3, lw=0.5)
    for ax in axes[:, 0]:
        ax.set_ylabel("fraction", fontsize=7)
    hide_unused(axes, len(names))
    entries = [Line2D([], [], **style.curve_style(number), label=name) for number, name in enumerate(values)]
    figure.legend(handles=entries, loc="outside lower center", ncols=len(values), fontsize=9, frameon=False)
    return save_figure(figure, path)


def _edges(low: float, high: float, *, whole: bool) -> Float[np.ndarray, " _"]:
    """Return the edges of at most `_BINS` bins; each of whole numbers holds as many of them as the others."""
    if not whole:
        return np.linspace(low, max(high, low + 1e-6), _BINS + 1)
    each = max(1, int(np.ceil((high - low + 1) / _BINS)))
    return np.arange(low - 0.5, high + each + 0.5, each)
