"""`tflane sweep`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from tflane_jax.errors import UserError
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Evaluate trained models for each value of a setting."""
    from tflane_jax.ablations.sweep import sweep

    if empty := [reference for reference in options.runs if reference.startswith("=")]:
        raise UserError(f"{empty[0]}: the name before = is empty")
    pairs = [reference.partition("=") for reference in options.runs]
    models = {name if path else Path(name).resolve().name: Path(path or name) for name, _, path in pairs}
    if len(models) < len(pairs):
        raise UserError("two of the folders have the same name: write NAME=FOLDER to tell them apart")
    configure_jax()
    sweep(
        models,
        options.setting,
        options.values,
        options.out,
        overrides,
        metrics=options.metrics,
        which=options.checkpoint,
    )
    return 0
