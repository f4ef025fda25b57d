"""`tflane compare`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from tflane_jax.ablations.declaration import Claim, Declaration
from tflane_jax.config import load_config, loaded_once
from tflane_jax.config_files import split_reference
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder
from tflane_jax.limits import LARGEST_SEED
from tflane_jax.training.notices import print_notices
from tflane_jax.training.runtime import configure_jax

# A single seed up to this may be meant as a number of seeds, as `tflane tables` takes it.
_MOST_MEANT = 20


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Train, evaluate and compare."""
    from tflane_jax.ablations.compare import compare

    rows = [_named(argument) for argument in options.configs]
    references = {name: (reference, settings) for name, reference, settings in rows}
    if len(references) < len(options.configs):
        raise UserError("two of the configurations have the same name: write NAME=FILE to tell them apart")
    if len(set(options.seeds)) < len(options.seeds):
        raise UserError(f"--seeds {' '.join(map(str, options.seeds))}: the seeds must differ")
    if wrong := [seed for seed in options.seeds if not 0 <= seed <= LARGEST_SEED]:
        raise UserError(f"--seeds {wrong[0]}: a seed is a whole number from 0 to {LARGEST_SEED}")
    if len(rows) > 1 and len(options.seeds) == 1 and (seed := options.seeds[0]) > 0:
        several = f"; for {seed} seeds give --seeds {' '.join(map(str, range(seed)))}" if seed <= _MOST_MEANT else ""
        print_notices([f"--seeds {seed} is seed {seed} alone, with which nothing can be tested{several}"])
    if options.jobs < 1:
        raise UserError(f"--jobs {options.jobs}: at least one training runs at a time")
    given = [*overrides, *(setting for _, _, settings in rows for setting in settings)]
    if any(setting.partition("=")[0] == "--training.seeds" for setting in given):
        raise UserError("--training.seeds is of `tflane train`: give compare its seeds by --seeds, such as --seeds 7 8")
    check_folder(options.out)
    configure_jax()
    with loaded_once():
        configs = {
            name: apply_overrides(load_config(reference), [*overrides, *settings])
            for name, (reference, settings) in references.items()
        }
    compare(
        configs,
        options.seeds,
        options.out,
        parallel=options.jobs,
        tests=_test_sets(options.test),
        retrain=options.retrain,
        declaration=_declaration(options, list(configs)),
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
        tests[name] = _split(settings, f"--test {argument}")
    return tests


def _declaration(options: argparse.Namespace, names: Sequence[str]) -> Declaration | None:
    """Return what is tested, from --primary and the options that belong to it; None without --primary."""
    if options.primary is None:
        for option in ("treatment", "negative_control", "secondary", "alpha"):
            if getattr(options, option) is not None:
                raise UserError(f"--{option.replace('_', '-')} belongs to a declared comparison: add --primary")
        return None
    if options.treatment is None and len(names) != 2:
        raise UserError("--treatment NAME: say which configuration's effect --primary tests")
    treatment = names[1] if options.treatment is None else options.treatment
    alpha = 0.05 if options.alpha is None else options.alpha
    return Declaration(options.primary, (Claim(treatment),), options.negative_control, alpha, options.secondary)


def _named(argument: str) -> tuple[str, str, list[str]]:
    """Return name, reference and settings of [NAME=]FILE[:ABLATION][ --setting value ...].

    The default name is that of the ablation or file.
    """
    row, dashes, settings = argument.partition(" --")
    name, separator, reference = row.partition("=")
    if not separator:
        path, ablation = split_reference(row)
        name, reference = ablation or Path(path).stem, row
    elif not name:
        raise UserError(f"{argument}: the name before = is empty")
    return name, reference.strip(), _split(dashes + settings, argument)


def _split(settings: str, argument: str) -> list[str]:
    """Return settings one by one, as a shell splits them; raises UserError, with the argument, for an open quote."""
    try:
        return shlex.split(settings)
    except ValueError as error:
        raise UserError(f"{argument}: {str(error).lower()}") from error
