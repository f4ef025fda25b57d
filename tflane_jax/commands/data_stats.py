"""`tflane data stats`: how many lanes and map lines a split has, by evidence and traffic, and how much traffic."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from tflane_jax.commands.data_beside import beside
from tflane_jax.commands.sources import check_used, chosen_source, data_name
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets import sources
from tflane_jax.datasets.base import spread
from tflane_jax.errors import UserError
from tflane_jax.evaluation.example_statistics import example_stats
from tflane_jax.files.wording import counted
from tflane_jax.plots import format_table
from tflane_jax.scene import RoadImage


def stats(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Print the means and quantiles over examples spread evenly over a split."""
    before = RunConfig() if options.config is None else load_config(options.config)
    config = apply_overrides(before, overrides)
    own = argparse.Namespace(**vars(options) | ({"openlane": None} if options.beside else {}))  # that may be of others
    check_used(overrides, before, config, lambda given: chosen_source(given, own), options.data)
    if options.beside:
        return beside(config, options)
    if options.out is not None:
        raise UserError("--out is the file of --beside: add data to compare with, or leave it out")
    source = chosen_source(config, options)
    if sources.source_of(source).example is RoadImage:
        raise UserError("these data are images: `tflane data stats` counts lane graphs")
    dataset = sources.make_dataset(source)
    indices = spread(len(dataset), options.count)
    if not indices:
        raise UserError(f"nothing to count: {dataset.name} has {len(dataset)} examples, {options.count} asked for")
    found = [example_stats(dataset.example(index), source.example) for index in indices]
    names = dict.fromkeys(name for one in found for name in one)
    rows = [_row(name, np.array([one[name] for one in found if name in one])) for name in names]
    print(format_table(rows, title=f"{data_name(source, options)}: {counted(len(indices), 'example')}"))
    return 0


def _row(quantity: str, values: np.ndarray) -> dict[str, Any]:
    low, middle, high = np.quantile(values.astype(float), (0.1, 0.5, 0.9))
    row = {"quantity": quantity, "examples": len(values), "mean": values.mean()}
    return row | {"10 %": low, "median": middle, "90 %": high}
