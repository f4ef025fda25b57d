"""`tflane compare`."""

from __future__ import annotations

import argparse
import shlex
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
    if len(set(options.seeds)) < len(options.seeds):
        raise UserError(f"--seeds {' '.join(map(str, options.seeds))}: the seeds must differ")
    if options.jobs < 1:
        raise UserError(f"--jobs {options.jobs}: at least one training runs at a time")
    configure_jax()
    configs = {name: apply_overrides(load_config(path), overrides) for name, path in references.items()}
    compare(
        configs,
        options.seeds,
        options.out,
        jobs=options.jobs,
        tests=_test_sets(options.test),
        retrain=options.retrain,
    )
    return 0


def _test_sets(arguments: Sequence[str]) -> dict[str, list[str]]:
    """Return the settings by test set, from arguments NAME=SETTINGS."""
    tests: dict[str, list[str]] = {}
    for argument in arguments:
        name, _, settings = argument.partition("=")
        if not name or name.startswith("-") or not settings:
            raise UserError(f"--test {argument}: write --test NAME='--data.setting value ...'")
        if name in tests:
            raise UserError(f"two test sets have the name {name}")
        tests[name] = shlex.split(settings)
    return tests


def _named(reference: str) -> tuple[str, str]:
    """Return name and reference of [NAME=]FILE[:ABLATION]; the default name is that of the ablation or file."""
    name, separator, path = reference.partition("=")
    if separator:
        return name, path
    path, ablation = split_reference(reference)
    return ablation or Path(path).stem, reference
