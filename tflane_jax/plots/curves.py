"""Training curves from the records of `metrics.jsonl`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.plots.figure import hide_unused, new_figure, save_figure


def save_curves(path: Path, records: Iterable[Mapping[str, Any]], *, step: str = "step") -> Path:
    """Write one panel per group of values over the step, and return the path.

    Args:
        path: .png, .pdf or .svg.
        records: each has the step and any of the values, numbers or one list per seed; nested ones and those
            named "group/part" (losses by part, evaluation by protocol) share a panel. Text and None are
            passed over.
        step: name of the step.

    Raises UserError where no record holds a number to draw.
    """
    series = curves(records, step=step)
    if not series:
        raise UserError("nothing to draw: the records hold no numbers")
    groups: dict[str, list[str]] = {}
    for name in series:
        groups.setdefault(name.rpartition("/")[0] or name, []).append(name)
    columns = min(3, len(groups))
    figure, axes = new_figure(-(-len(groups) // columns), columns, panel=(4.6, 3.2))
    for ax, (group, names) in zip(axes.flat, groups.items(), strict=False):
        for number, name in enumerate(names):
            steps, values = series[name]
            colour = f"C{number % 10}"
            ax.plot(steps, values.mean(1), color=colour, lw=1.4, label=name.rpartition("/")[2],
                    marker="o" if len(steps) == 1 else None)  # fmt: skip
            if values.shape[1] > 1:
                ax.fill_between(steps, values.min(1), values.max(1), color=colour, alpha=0.2, lw=0)
        _scale(ax, [series[name][1] for name in names])
        ax.set_title(group, fontsize=9, loc="left")
        ax.set_xlabel(step, fontsize=8)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3, lw=0.5)
        if len(names) > 1:
            ax.legend(fontsize=7, frameon=False)
    hide_unused(axes, len(groups))
    return save_figure(figure, path)


def curves(records: Iterable[Mapping[str, Any]], *, step: str = "step") -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return for each value its steps (n,) and numbers (n, seeds), in order of appearance and of step."""
    found: dict[str, dict[int, np.ndarray]] = {}
    for record in records:
        for name, value in _flat(record):
            if name != step:
                # The last record of a step counts: a resumed run repeats the steps since its last checkpoint.
                found.setdefault(name, {})[int(record[step])] = value
    series = {}
    for name, by_step in found.items():
        steps = sorted(by_step)
        series[name] = np.asarray(steps), np.stack([by_step[s] for s in steps])
    return series


def _flat(record: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yield the numbers of a nested record with names joined by "/", each as (seeds,)."""
    for name, value in record.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}/")
        elif isinstance(value, (int, float, np.number, np.ndarray)) or _is_numbers(value):
            yield f"{prefix}{name}", np.atleast_1d(np.asarray(value, np.float64)).reshape(-1)


def _is_numbers(value: object) -> bool:
    return isinstance(value, Sequence) and len(value) > 0 and all(isinstance(v, (int, float)) for v in value)


def _scale(ax, values: list[np.ndarray]) -> None:
    """Use a logarithmic axis where positive values span more than a factor of thirty."""
    seen = np.concatenate([v.reshape(-1) for v in values])
    seen = seen[np.isfinite(seen)]
    if len(seen) and seen.min() > 0.0 and seen.max() > 30.0 * seen.min():
        ax.set_yscale("log")
