"""`tflane compare`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from tflane_jax.config import apply_overrides, load_config
from tflane_jax.config_files import split_reference
from tflane_jax.errors import UserError
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Train, evaluate and compare."""
    from tflane_jax.ablations.compare import compare

    references = dict(_named(reference) for reference in options.configs)
    if len(references) < len(options.configs):
        raise UserError("two of the configurations have the same name: write NAME=FILE to tell them apart")
    if options.jobs < 1:
        raise UserError(f"--jobs {options.jobs}: at least one training runs at a time")
    configure_jax()
    configs = {name: apply_overrides(load_config(path), overrides) for name, path in references.items()}
    compare(configs, options.seeds, options.out, jobs=options.jobs)
    return 0


def _named(reference: str) -> tuple[str, str]:
    """Split NAME=FILE[:ABLATION]; without a name it is that of the file or ablation."""
    name, separator, path = reference.partition("=")
    if separator:
        return name, path
    path, ablation = split_reference(reference)
    return ablation or Path(path).stem, reference
