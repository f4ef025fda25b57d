"""`tflane data stats --beside`: distributions of several datasets side by side, as a table and a picture."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.commands.outputs import check_table, folders_of
from tflane_jax.commands.sources import chosen_source
from tflane_jax.config import RunConfig
from tflane_jax.datasets import argoverse2, recorded_logs, sources
from tflane_jax.datasets.base import ExampleConfig, spread
from tflane_jax.datasets.recorded_logs import RECORDED_EXAMPLE
from tflane_jax.errors import UserError
from tflane_jax.evaluation.example_statistics import example_stats
from tflane_jax.evaluation.scene_statistics import frame_quantities, lane_quantities, pooled
from tflane_jax.plots import format_table, save_table
from tflane_jax.plots.distributions import save_distributions
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.tables import written_to
from tflane_jax.scene import Example, RoadImage

_CAPACITIES = ("lanes", "segments", "areas", "tracks", "elements")
_READS_OPENLANE = argoverse2.SOURCE.name
_QUANTILES = (0.1, 0.5, 0.9)
# Entries of `example_stats` that are taken over, by their starts.
_TRAFFIC = ("road users in range", "- ", "fraction of lane length driven on")


def beside(config: RunConfig, options: argparse.Namespace) -> int:
    """Print and write the distributions of the chosen data and of those of --beside.

    All have the box, the history and at least the capacities of the chosen data, so that they can be compared.
    """
    if options.out is not None:
        check_table(options.out)
    others = [text.partition("=")[0] for text in options.beside]
    is_for_others = options.data != _READS_OPENLANE and _READS_OPENLANE in others
    first = chosen_source(config, _with(options, openlane=None) if is_for_others else options)
    _check(first)
    chosen = {options.data or sources.source_name(first): first}
    for text in options.beside:
        name, _, root = text.partition("=")
        if not root and sources.named_source(name).root is not None:
            raise UserError(f"--beside {name} needs its folder: --beside {name}=PATH")
        openlane = options.openlane if name == _READS_OPENLANE else None
        split = None if name == recorded_logs.SOURCE.name else options.split  # a folder of recordings has no splits
        source = chosen_source(
            config, _with(options, data=name, root=root or None, openlane=openlane, split=split, data_dict=None)
        )
        _check(source)
        chosen[_unused(name, chosen)] = replace(source, example=_same(first.example, source))
    if options.out is not None:
        check_table(options.out, folders_of(*chosen.values()))
    values, counts = {}, {}
    for name, source in chosen.items():
        values[name] = _values(source, options.count)
        counts[f"{name} ({len(values[name]['lanes'])} frames)"] = name
    rows = [
        {"quantity": quantity}
        | {title: _cell(values[name].get(quantity, np.zeros(0))) for title, name in counts.items()}
        for quantity in dict.fromkeys(q for found in values.values() for q in found)
    ]
    title = "mean (10 % to 90 %) over frames, and over lanes from `length` on"
    paths: list[Path] = []
    if options.out is not None:
        paths += save_table(options.out, rows, {"values": _summary(values)}, title=title)
        if can_draw():
            paths.append(save_distributions(options.out.with_name(f"{options.out.name}.png"), values))
    print(format_table(rows, title=title))
    if paths:
        print(f"\n{written_to(paths)}")
    return 0


def _with(options: argparse.Namespace, **other: Any) -> argparse.Namespace:
    return argparse.Namespace(**(vars(options) | other))


def _check(source: Any) -> None:
    if sources.source_of(source).example is RoadImage:
        raise UserError("these data are images: `tflane data stats` counts lane graphs")


def _unused(name: str, taken: dict[str, Any]) -> str:
    number = sum(other == name or other.startswith(f"{name} #") for other in taken)
    return f"{name} #{number + 1}" if number else name


def _same(first: ExampleConfig, source: Any) -> ExampleConfig:
    """Return the first data's examples with room for what the others hold; images are not looked at."""
    wanted = (first, source.example, RECORDED_EXAMPLE)
    room = {name: max(getattr(one, name) for one in wanted) for name in _CAPACITIES}
    return replace(first, cameras=None, **room)


def _values(source: Any, count: int) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the values of every quantity over examples spread evenly over the data."""
    dataset = sources.make_dataset(source)
    indices = spread(len(dataset), count)
    if not indices:
        raise UserError(f"nothing to count: {dataset.name} has {len(dataset)} examples, {count} asked for")
    frames, lanes = [], []
    for index in indices:
        example: Example = dataset.example(index)
        traffic = {
            name: np.array([value], float)
            for name, value in example_stats(example, source.example).items()
            if name.startswith(_TRAFFIC)
        }
        frames.append(frame_quantities(example) | traffic)
        lanes.append(lane_quantities(example))
    return pooled(frames) | pooled(lanes)


def _cell(values: Float[np.ndarray, " n"]) -> str:
    if not len(values):
        return "-"
    low, _, high = np.quantile(values, _QUANTILES).round(3)
    return f"{values.mean():.3g} ({low:.3g} to {high:.3g})"


def _summary(values: dict[str, dict[str, Float[np.ndarray, " n"]]]) -> dict[str, dict[str, dict[str, float]]]:
    names = ("10 %", "median", "90 %")
    return {
        dataset: {
            quantity: {"values": len(one), "mean": float(one.mean())}
            | dict(zip(names, np.quantile(one, _QUANTILES).tolist(), strict=True))
            for quantity, one in found.items()
            if len(one)
        }
        for dataset, found in values.items()
    }
