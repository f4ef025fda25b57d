"""`tflane carry-over`."""

from __future__ import annotations

import argparse

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Leave each log out once, train on the others, test on it."""
    for name in ("seeds", "jobs", "cores", "steps", "scenes"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise UserError(f"--{name} {value}: at least one")
    check_folder(options.out)
    configure_jax()
    from tflane_jax.ablations.carry_over import carry_over
    from tflane_jax.ablations.carry_over_plan import Settings

    settings = Settings(
        maps=options.maps,
        logs=tuple(options.logs),
        rows=tuple(options.models),
        seeds=tuple(range(options.seeds)),
        steps=options.steps,
        scenes=options.scenes,
        folds=options.folds,
        parallel=options.jobs,
        cores=options.cores,
        quick=options.quick,
    )
    carry_over(settings, options.out)
    return 0
