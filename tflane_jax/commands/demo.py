"""`tflane demo`."""

from __future__ import annotations

import argparse

from tflane_jax.files.atomic import check_folder
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Train with and without traffic flow, evaluate, and draw the comparison."""
    from tflane_jax.demo import main  # pyright: ignore[reportMissingImports]

    check_folder(options.out)
    configure_jax()
    return main(options.out)
