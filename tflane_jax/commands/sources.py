"""The data that a command's options name."""

from __future__ import annotations

import argparse
from pathlib import Path

from tflane_jax.config import RunConfig, Source
from tflane_jax.datasets.argoverse2 import Argoverse2Config
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.errors import UserError


def chosen_source(config: RunConfig, options: argparse.Namespace) -> Source:
    """Return the source that --split, --data, --root and --openlane name; capacities stay as configured."""
    configured: Source = config.data.source(options.split)
    if options.data is None and options.root is not None and not isinstance(configured, Argoverse2Config):
        raise UserError("--root is the folder of real logs: add --data argoverse2")
    if options.data == "procedural":
        if isinstance(configured, ProceduralConfig):
            return configured
        return ProceduralConfig(split=options.split, scenes=100, example=configured.example)
    if options.data == "argoverse2" or options.root is not None:
        if options.root is None:
            raise UserError("--data argoverse2 needs --root PATH, a log or a folder of logs")
        openlane = None if options.openlane is None else Path(options.openlane)
        return Argoverse2Config(Path(options.root), openlane=openlane, example=configured.example)
    return configured


def source_name(source: Source) -> str:
    """Return a name for titles and files."""
    if isinstance(source, ProceduralConfig):
        return f"procedural-{source.split}"
    return "argoverse2"
